"""Answers of a map without a place: the photo's pose in the map's own frame, never on Earth.

Localisation computes in a local frame and needs a place only to word its answer. A map without one is
therefore searched as a map at a stand-in place, and what comes out is worded in its own frame here, before
anybody sees it.
"""

from dataclasses import replace

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.move import placed_map
from featuredb.maps.unplaced_map import UnplacedMap
from reloc.localise.result import LocalisedPose, LocaliseResult, PoseInMap

_STAND_IN = LocalFrame(latitude_deg=0.0, longitude_deg=3.0, height_m=0.0)


def at_stand_in(unplaced: UnplacedMap) -> FeatureMap:
    """The map at a place that means nothing, whose local frame is the map's own; exactly placed."""
    placement = Placement(
        method="map", local_from_sfm=Sim3.identity(), covariance=np.zeros((7, 7)), residual_rms_m=0.0
    )
    return placed_map(unplaced, placement, _STAND_IN, "unknown")


def in_own_frame(result: LocaliseResult, unplaced: UnplacedMap) -> LocaliseResult:
    """The result of a search of `at_stand_in(unplaced)`, without anything that could be taken for a place."""
    if result.pose is None:
        return replace(result, runner_up=None)
    return replace(result, pose=None, in_map=_pose(result.pose, unplaced), runner_up=None)


def _pose(pose: LocalisedPose, unplaced: UnplacedMap) -> PoseInMap:
    return PoseInMap(
        map_id=unplaced.map_id,
        frame=unplaced.frame,
        cam_from_map=pose.cam_from_local,
        covariance=pose.covariance,
        camera=pose.camera,
        camera_source=pose.camera_source,
        residual_rms_px=pose.residual_rms_px,
    )
