"""Localised photos as a query would have left them."""

from typing import Any

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from ingest.growth.values import LocalisedPhoto
from tests.support.scenes import CAMERA
from tests.support.service import not_localised


def localised_photo(cam_from_local: Rigid3, **values: Any) -> LocalisedPhoto:
    """A photo localised at that pose, without any inlier unless they are given."""
    of_points: dict[str, Any] = {
        "feature_rows": np.zeros(0, dtype=np.int64),
        "pixels": np.zeros((0, 2)),
        "map_ids": ("old",),
        "map_of": np.zeros(len(values.get("feature_rows", ())), dtype=np.int64),
        "point_of": np.zeros(0, dtype=np.int64),
        "points": np.zeros((0, 3)),
        "point_covariance": np.zeros((0, 3, 3)),
    }
    given: dict[str, Any] = {"covariance": np.eye(6) * 1e-6, "camera": CAMERA} | of_points | values
    return LocalisedPhoto(
        frame=LocalFrame(latitude_deg=49.0, longitude_deg=8.0, height_m=0.0),
        cam_from_local=cam_from_local,
        result=not_localised(snapshot=0),
        **given,
    )
