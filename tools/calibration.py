"""Do reported uncertainties mean what they say? Errors of answers against their covariances, over placements.

One map has one bias of its receiver, and 68 % of one means nothing. So the same reconstruction is placed
again by many drawn positions of a survey's receiver, the answers move with it, and the errors of all draws
are counted. The reconstruction itself stays that of the exact positions.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.world import World
from ingest.register.gps import GpsOptions, place_by_gps
from reloc.localise.answer import placement_covariance
from reloc.localise.result import LocalisedPose

# An answer, and the true cam_from_local in the frame of the answer.
Pair = tuple[LocalisedPose, Rigid3]

_SIGMA_M = 0.02  # of each axis, as the demo ingests exact positions


def survey_positions(centers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Positions with 2 cm of error per axis, half of its variance shared by the flight."""
    part = _SIGMA_M / np.sqrt(2.0)
    return centers + rng.normal(0.0, part, 3) + rng.normal(0.0, part, centers.shape)


def inside_over_placements(
    answers: Sequence[Pair], area: Area, world: World, draws: int, seed: int
) -> dict[str, float]:
    """Shares of errors within the reported 68 % radii, and of how many draws: others a gate refused."""
    if len(area.maps) != 1:
        raise SystemExit(f"expected one map of the drone photos, found {len(area.maps)}")
    feature_map = area.maps[0]
    centers_sfm, true_centers = _flight(feature_map, world)
    rng = np.random.default_rng((seed, 31))
    sigmas = np.full(true_centers.shape, _SIGMA_M)
    measured = [measured_covariance(area, feature_map, pose) for pose, _ in answers]
    inside, placed = [], 0
    for _ in range(draws):
        again = place_by_gps(centers_sfm, survey_positions(true_centers, rng), sigmas, GpsOptions())
        if again.reason is not None or again.local_from_sfm is None or again.covariance is None:
            continue
        placed += 1
        moved_map = _placed_by(feature_map, again.local_from_sfm, again.covariance)
        motion = again.local_from_sfm @ feature_map.placement.local_from_sfm.inverse()
        turn = np.kron(np.eye(2), motion.rotation)
        for (pose, true), own in zip(answers, measured, strict=True):
            moved = motion.act_on_pose(pose.cam_from_local)
            covariance = turn @ own @ turn.T + placement_covariance(area, moved_map, moved.center)
            inside.append(_inside(pose_offset(moved, true), covariance))
    horizontal, orientation = np.mean(inside, axis=0)
    return {
        "placements": placed,
        "inside_horizontal": float(horizontal),
        "inside_orientation": float(orientation),
    }


def _flight(feature_map: FeatureMap, world: World) -> tuple[FloatArray, FloatArray]:
    """(n, 3) camera centres in the order of the flight: in the structure's frame, and true local ones."""
    images = sorted(feature_map.images, key=lambda image: image.name)
    true = [world.truth.images[f"drone/{image.name}"].cam_from_local.center for image in images]
    placed = np.array([image.cam_from_local.center for image in images])
    return (
        feature_map.placement.local_from_sfm.inverse().act(placed),
        feature_map.frame.enu_from(world.truth.frame).act(np.array(true)),
    )


def pose_offset(pose: Rigid3, true: Rigid3) -> FloatArray:
    """(6,) rotation (rad) before displacement of the camera (m), from a cam_from_local to the true one."""
    turn = so3_log(true.rotation.T @ pose.rotation)
    return np.concatenate([turn, true.center - pose.center])


def measured_covariance(area: Area, feature_map: FeatureMap, pose: LocalisedPose) -> FloatArray:
    """What an answer's covariance (6, 6) holds besides the map's placement, in the area's axes."""
    center = pose.cam_from_local.center
    back = np.kron(np.eye(2), pose.frame.true_enu_from_enu(center).T)
    return back @ pose.covariance @ back.T - placement_covariance(area, feature_map, center)


def _placed_by(feature_map: FeatureMap, local_from_sfm: Any, covariance: FloatArray) -> FeatureMap:
    placement = replace(feature_map.placement, local_from_sfm=local_from_sfm, covariance=covariance)
    return replace(feature_map, placement=placement)


def _inside(error: FloatArray, covariance: FloatArray) -> tuple[bool, bool]:
    """Whether the horizontal error and that of the orientation are within their 68 % radii."""
    return (
        bool(np.hypot(*error[3:5]) <= error_radius(covariance[3:5, 3:5])),
        bool(np.linalg.norm(error[:3]) <= error_radius(covariance[:3, :3])),
    )
