"""Control points place a reconstruction that is no map yet, a map that has a place, and one that has none."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from featuredb.adjust.terms import Block
from featuredb.geo.datum import check_datum
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.feature_map import FeatureMap, GeoPrior, Placement
from featuredb.maps.move import placed_map
from featuredb.maps.unplaced_map import UnplacedMap
from ingest.register.block import block_of_map, map_of_block
from ingest.register.control.control_file import ControlFile
from ingest.register.control.fit import Vertical
from ingest.register.control.marks import meet
from ingest.register.control.placement import GcpOptions, GcpPlacement, place_by_gcp

# A local frame is good for tens of kilometres; a new one further away keeps coordinates small.
_MAX_FRAME_DISTANCE_M = 2_000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """A control point file and how it is used."""

    file: ControlFile
    options: GcpOptions = field(default_factory=GcpOptions)


def place_by_survey(
    block: Block,
    positions: Sequence[GeoPrior | None],
    frame: LocalFrame,
    vertical: Vertical | None,
    survey: Survey,
) -> GcpPlacement:
    """Place and adjust a block.

    Args:
        positions: of its photos by GPS. frame: of the placement.
        vertical: what is known of tilt and height from elsewhere.
    """
    control = meet(survey.file, block, frame)
    gps, sigma = _gps_in(frame, positions)
    return place_by_gcp(block, control, survey.options, vertical=vertical, gps_local=gps, gps_sigma_m=sigma)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GcpRegistration:
    """A map placed anew by control points, or why not.

    Attributes:
        placement: by the points.
        feature_map: to be committed in the old one's place, None where it was refused.
        moved_m: (3,) median of how far the map's points moved, east, north, up; None without a map, and where
            it had no place before.
    """

    placement: GcpPlacement
    feature_map: FeatureMap | None = None
    moved_m: FloatArray | None = None


def register_by_gcp(
    feature_map: FeatureMap, survey: Survey, height_datum: str = "unknown"
) -> GcpRegistration:
    """Place a map by control points; nothing is written.

    Args:
        height_datum: of the surveyed heights, where the file's reference system does not say it.
    """
    check_datum(height_datum)
    frame = _frame(feature_map, survey.file)
    block = block_of_map(feature_map)
    frame_from_map = Sim3.from_rigid3(frame.enu_from(feature_map.frame))
    vertical, method = None, feature_map.placement.method
    if method != "gcp":  # what control points have said would count twice
        covariance = frame_from_map.carried(feature_map.placement.covariance)
        source = f"the map's placement by {method}"
        vertical = vertical_of(frame_from_map, covariance, block.xyz, source)
    positions = [image.gps for image in feature_map.images]
    found = place_by_survey(block, positions, frame, vertical, survey)
    if not found.accepted:
        return GcpRegistration(placement=found)
    assert found.block is not None
    placement = found.map_placement(feature_map.placement.local_from_sfm)
    datum = found.height_datum(feature_map.height_datum, height_datum)
    return GcpRegistration(
        placement=found,
        feature_map=map_of_block(feature_map, found.block, frame, placement, datum),
        moved_m=np.median(found.block.xyz - frame_from_map.act(block.xyz), axis=0),
    )


def place_unplaced_by_gcp(
    unplaced: UnplacedMap, survey: Survey, height_datum: str = "unknown"
) -> GcpRegistration:
    """Place a map that has no place by control points; arguments as in `register_by_gcp`.

    The points say everything: its own frame only starts at them, and counts for nothing.
    """
    at_the_points = Placement(
        method="gcp",
        local_from_sfm=Sim3.identity(),
        covariance=np.zeros((7, 7)),
        residual_rms_m=0.0,
    )
    start = placed_map(unplaced, at_the_points, LocalFrame.amid(survey.file.lat_lon_h), "unknown")
    return replace(register_by_gcp(start, survey, height_datum), moved_m=None)


def vertical_of(
    local_from_block: Sim3, covariance: FloatArray, points_block: FloatArray, source: str
) -> Vertical:
    """What a placement says about tilt, and height in the middle of its points (n, 3)."""
    anchor = np.median(points_block, axis=0)
    by_rotation = np.array([[0.0, 1.0], [-1.0, 0.0]])  # a turn about east tilts north, and so on
    height = point_jacobian(local_from_block.act(anchor))[2]
    return Vertical(
        up_block=local_from_block.rotation.T @ [0.0, 0.0, 1.0],
        tilt_covariance=by_rotation @ covariance[1:3, 1:3] @ by_rotation.T + np.eye(2) * 1e-10,
        anchor_block=anchor,
        anchor_up_m=float(local_from_block.act(anchor)[2]),
        sigma_up_m=float(np.sqrt(height @ covariance @ height)) + 1e-4,
        source=source,
    )


def _gps_in(frame: LocalFrame, priors: Sequence[GeoPrior | None]) -> tuple[FloatArray, tuple[float, float]]:
    """The photos' own positions (k, 3) in a frame, NaN where not known, and the medians of their sigmas."""
    gps = np.full((len(priors), 3), np.nan)
    for row, prior in enumerate(priors):
        if prior is not None:
            height = frame.height_m if prior.height_m is None else prior.height_m
            gps[row] = frame.enu_from_geodetic((prior.latitude_deg, prior.longitude_deg, height))
            if prior.height_m is None:
                gps[row, 2] = np.nan
    sigmas = [(prior.sigma_horizontal_m, prior.sigma_vertical_m) for prior in priors if prior is not None]
    horizontal, vertical = np.median(sigmas, axis=0).tolist() if sigmas else (0.0, 0.0)
    return gps, (horizontal, vertical)


def _frame(feature_map: FeatureMap, file: ControlFile) -> LocalFrame:
    """The map's own frame unless its photos have no GPS and the control points lie elsewhere."""
    middle = LocalFrame.amid(file.lat_lon_h)
    away = np.linalg.norm(feature_map.frame.enu_from(middle).translation)
    has_gps = any(image.gps is not None for image in feature_map.images)
    return feature_map.frame if has_gps or away <= _MAX_FRAME_DISTANCE_M else middle
