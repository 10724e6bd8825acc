"""Models of which only who sees what matters."""

import numpy as np

from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.bridge import Model
from tests.support.scenes import CAMERA


def model_of(*photos: range) -> Model:
    """Photos that see the points of these numbers."""
    observations = sorted((point, k) for k, points in enumerate(photos) for point in points)
    point_of = np.array([p for p, _ in observations], dtype=np.int64)
    photo_of = np.array([k for _, k in observations], dtype=np.int64)
    return Model(
        cameras=(CAMERA,),
        rows=np.arange(len(photos)),
        camera_of=np.zeros(len(photos), dtype=np.int64),
        cam_from_sfm=tuple(Rigid3.identity() for _ in photos),
        xyz=np.zeros((point_of.max() + 1, 3)),
        point_of=point_of,
        photo_of=photo_of,
        keypoint_of=point_of,
    )
