"""Photos of a textured field and areas of its maps, for tests of localisation."""

from dataclasses import replace

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import build_area
from featuredb.maps.feature_map import FeatureMap
from reloc.localise.candidates import IndexedArea, indexed_together
from reloc.localise.result import LocaliseRequest, LocaliseResult
from tests.support.planar_map import CAMERA, EASTING, EPSG, HEIGHT, NORTHING, view

KNOWN = LocaliseRequest(camera=CAMERA)
POSE = view(5.0, -6.0, 40.0, 8.0, 33.0)


def indexed(*maps: FeatureMap) -> IndexedArea:
    made = build_area(maps)
    return indexed_together([made])[0]


def moved(feature_map: FeatureMap, map_id: str, east_m: float, sigma_m: float = 0.01) -> FeatureMap:
    """The same content, placed elsewhere, with that uncertainty."""
    frame = LocalFrame.from_utm(EASTING + east_m, NORTHING, HEIGHT, EPSG)
    points = feature_map.points
    local = feature_map.points_local()
    return replace(
        feature_map,
        map_id=map_id,
        frame=frame,
        points=replace(points, utm=frame.utm_from_enu(local, EPSG)),
        placement=replace(feature_map.placement, covariance=np.diag([1e-10] * 4 + [sigma_m**2] * 3)),
    )


def pose_errors(result: LocaliseResult, truth: Rigid3) -> tuple[float, float]:
    """Metres and degrees, in the frame that the map was made in."""
    assert result.pose is not None, (result.reason, result.detail)
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    found = result.pose.cam_from_local @ result.pose.frame.enu_from(frame)
    return float(np.linalg.norm(found.center - truth.center)), found.angle_to_deg(truth)
