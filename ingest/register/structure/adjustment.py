"""Final adjustment of a map by a scan: several registered frames and the scan's surface straighten it.

What the registered frames see of the scan (their correspondences) and the scan's surface under all points of
the map determine poses, lens and points together (docs/measurements/registration.md).
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from featuredb.adjust.problem import Problem
from featuredb.adjust.shared_noise import design_effect
from featuredb.adjust.terms import Block, LensPrior, Marks, Terms, surface_priors, whole_lens
from featuredb.features.exif.read import focal_of_key
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.lens_uncertainty import LensUncertainty, uncertainty_of_lenses
from featuredb.render.cloud import PointCloud
from ingest.colmap.adjust import AdjustOptions, lens_prior_of, longest_side, residuals_of
from ingest.colmap.precision import linearise
from ingest.register.block import block_of_map, map_of_block
from ingest.register.outcome import Outcome
from ingest.register.structure.projection import Registered, StructurePlacement
from ingest.register.structure.surface_fit import Surface, nearest_planes, surface_near

_FUNCTION_TOLERANCE = 1e-6  # of a round, relative
# Least standard deviation of keypoints and of correspondences with the scan, as a share of the photo's longer
# side: a pixel in 4000. Trusted to their noise, thousands of tracks outvote the frames' correspondences.
_MIN_SIGMA_REL = 0.00025
_MIN_SURFACE_M = 0.03  # of a scan's surface against map points; roughness of grass and pavement
# What is known of lenses, and how many times what they leave open counts in the poses' covariances.
_MAPPING = AdjustOptions()
_ROUNDS = 25  # of looking up the scan's planes; it ends earlier when points move by less than _SETTLED_M
_STEPS = 8  # of the solver in each round
_SETTLED_M = 1e-3  # see above; far below a scan's noise
_REACH_M = 1.0  # a plane further from a point says nothing of it
# How often correspondences that agree with the map would be refused: their spread about the adjusted map
# against that about each frame's own best pose, by F, as if the two had no residuals in common.
_CONTROL_RATE = 1e-4
_CONTROL_REL = 0.0017  # so much of the longer side is no contradiction (7 pixels in 4000); it has no rate
_MAD_EFFICIENCY = 0.37  # of a spread by the median, of normal residuals (Rousseeuw and Croux 1993)
_OWN_ROUNDS = 8  # of a frame's own pose
# Of the median reprojection error, or of that share of the longer side where it is smaller: to less, tracks
# are not trusted.
_MAX_REPROJECTION_GROWTH = 0.1
_REPROJECTION_FLOOR_REL = 0.00025
_MAX_SURFACE_POINTS = 250_000  # finer than for the similarity, since single points are moved
_LEAST_FURTHER_M = 0.03  # medians are of the points next to the scan, which are not the same before and after

AdjustReason = Literal["NO_SCAN", "LENS", "CONTROL", "REPROJECTION", "SURFACE"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LidarAdjustment(Outcome[AdjustReason]):
    """An adjusted map, or why scan and photos contradict each other.

    Attributes:
        block: the map in the cloud's local frame; None without a scan or a lens. A refused one may be the
            start of another round: frames that were registered with a wrong lens contradict the right one.
        poses: (6, 6) of each pose, with all that points and lenses leave open; none without a block.
        lenses: what is left open of the lenses; None without a block, or where no lens has OPENCV's
            parameters.
    """

    block: Block | None = None
    poses: tuple[FloatArray, ...] = ()
    lenses: LensUncertainty | None = None


def adjust_to_scan(
    feature_map: FeatureMap,
    structure: StructurePlacement,
    registered: Registered,
    cloud: PointCloud,
    begin: FeatureMap | None = None,
) -> LidarAdjustment:
    """Adjust a map that `structure` has placed, lens included.

    Args:
        structure: an accepted placement of this map on this cloud.
        registered: the frames with their correspondences, in the cloud's local frame.
        begin: the map as an earlier adjustment left it, from which the solver starts.
    """
    assert structure.new_from_old is not None  # accepted
    to_cloud = Sim3.from_rigid3(cloud.frame.enu_from(feature_map.frame))
    start = whole_lens(block_of_map(feature_map).moved(structure.new_from_old @ to_cloud))
    control = _control_of(feature_map, registered)
    low, high = np.percentile(start.xyz, [1, 99], axis=0)
    surface = surface_near(cloud, np.clip(start.xyz, low, high), _MAX_SURFACE_POINTS)
    if surface is None:
        return LidarAdjustment(reason="NO_SCAN", message="the scan has no points under the map")
    first = start if begin is None else block_of_map(begin).moved(to_cloud)
    keys = feature_map.camera_keys or ("",) * len(start.cameras)
    lenses = tuple(
        lens_prior_of(camera, focal_of_key(key), _MAPPING)
        for camera, key in zip(start.cameras, keys, strict=True)
    )
    block = _iterate(first, lenses, control, surface)
    before, after = (_state(one, surface) for one in (start, block))
    figures: dict[str, Any] = {"before": before, "after": after, "own": _own_spread(block, control)}
    reason, message = _gate(block, figures)
    if reason == "LENS":
        return LidarAdjustment(reason=reason, message=message, figures=figures)
    poses, uncertainty = _left_open(block, lenses, control, surface, structure)
    return LidarAdjustment(
        reason=reason, message=message, block=block, poses=poses, lenses=uncertainty, figures=figures
    )


def placed_map(
    feature_map: FeatureMap, structure: StructurePlacement, cloud: PointCloud, adjustment: LidarAdjustment
) -> FeatureMap:
    """The map at its new place: same ids, descriptors and local frame; the scan's height datum.

    The new placement's `local_from_sfm` is the old one followed by the move of structure projection; what is
    left over is the adjustment itself.

    Args:
        structure: an accepted one. adjustment: with a block.
    """
    assert structure.new_from_old is not None
    assert structure.covariance is not None  # accepted
    assert adjustment.block is not None
    map_from_cloud = Sim3.from_rigid3(feature_map.frame.enu_from(cloud.frame))
    move = map_from_cloud @ structure.new_from_old @ map_from_cloud.inverse()
    placement = Placement(
        method="lidar",
        local_from_sfm=move @ feature_map.placement.local_from_sfm,
        covariance=map_from_cloud.carried(structure.covariance),
        residual_rms_m=float(adjustment.figures["after"]["surface_rms_m"]),
        evidence={"adjustment": adjustment.figures, "replaces": feature_map.placement.method},
    )
    block = adjustment.block.moved(map_from_cloud)
    placed = map_of_block(feature_map, block, feature_map.frame, placement, cloud.height_datum)
    images = zip(placed.images, adjustment.poses, strict=True)
    uncertainty = {} if adjustment.lenses is None else adjustment.lenses.as_provenance()
    return replace(
        placed,
        images=tuple(replace(image, covariance=c) for image, c in images),
        provenance=placed.provenance | uncertainty,
    )


def _control_of(feature_map: FeatureMap, registered: Registered) -> Marks:
    """Scan points that the registered frames see, by their correspondences."""
    counts = [len(found.pixels) for found in registered.values()]
    return Marks(
        xyz=np.concatenate([found.points_local for found in registered.values()]),
        photo_of=np.repeat(feature_map.image_rows(np.array(list(registered), dtype=np.int32)), counts),
        xy=np.concatenate([found.pixels for found in registered.values()]),
    )


def _iterate(start: Block, lenses: tuple[LensPrior, ...], control: Marks, surface: Surface) -> Block:
    """Rounds of planes, standard deviations and solving until points and cameras settle."""
    block = start
    for _ in range(_ROUNDS):
        problem = Problem(block, _terms(block, lenses, control, surface, _MIN_SIGMA_REL, _MIN_SURFACE_M))
        problem.solve(_STEPS, _FUNCTION_TOLERANCE)
        before, block = block, problem.block()
        points_m = np.median(np.linalg.norm(block.xyz - before.xyz, axis=1))
        cameras_m = np.linalg.norm(block.centers() - before.centers(), axis=1).max()
        if max(points_m, cameras_m / 5.0) < _SETTLED_M:
            break
    return block


def _terms(
    block: Block,
    lenses: tuple[LensPrior, ...],
    control: Marks,
    surface: Surface,
    least_rel: float,
    least_m: float,
) -> Terms:
    """Each kind of residual weighs by its own spread as it is now, but by no less than the least.

    That is `least_rel` of the longer side in pictures, and `least_m` from the surface.
    """
    least_px = least_rel * longest_side(block.cameras)
    offset, normals = nearest_planes(surface, block.xyz, _REACH_M)
    control_px = max(least_px, _spread(_control_residuals(block, control)[0]))
    return Terms(
        keypoint_px=max(least_px, _spread(residuals_of(block)[0])),
        lenses=lenses,
        marks=replace(control, sigma_px=control_px),
        points=surface_priors(block.xyz, offset, normals, max(least_m, _spread(offset))),
    )


def _left_open(
    block: Block,
    lenses: tuple[LensPrior, ...],
    control: Marks,
    surface: Surface,
    structure: StructurePlacement,
) -> tuple[tuple[FloatArray, ...], LensUncertainty | None]:
    """(6, 6) of each pose with all that points and lenses leave open, and what is left open of the lenses.

    Residuals count with their spread as it is, and as neighbours err alike, by as much less as the keypoints
    or the pairs of structure projection do; what lens models leave over is common to whole photos besides.
    Priors of lenses are not residuals: they keep the widths that they state.
    """
    shared = design_effect(*residuals_of(block), longest_side(block.cameras))
    factor = max(float(structure.figures["neighbours_factor"]), shared)
    terms = _terms(block, lenses, control, surface, 1e-6, 1e-3)
    found = Problem(block, replace(terms, dilution=factor * _MAPPING.dilution)).marginals()
    open_lenses = [factor * _MAPPING.dilution * found.lens(c) for c in range(len(block.cameras))]
    photos = np.bincount(block.camera_of, minlength=len(lenses)).tolist()
    uncertainty = uncertainty_of_lenses(block.cameras, open_lenses, photos, _MAPPING.dilution)
    return tuple(factor * found.poses(_MAPPING.dilution)), uncertainty


def _spread(residuals: FloatArray) -> float:
    """Standard deviation by the median, NaN left out."""
    finite = np.abs(residuals[np.isfinite(residuals)])
    return 1.4826 * float(np.median(finite)) if len(finite) else 0.0


def _control_residuals(block: Block, control: Marks) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """`residuals_of` the correspondences that their photos can see."""
    rows = np.arange(len(control.xyz))
    return residuals_of(
        replace(block, xyz=control.xyz, point_of=rows, photo_of=control.photo_of, xy=control.xy)
    )


def _state(block: Block, surface: Surface) -> dict[str, Any]:
    tracks = np.linalg.norm(residuals_of(block)[0], axis=1)
    distances = nearest_planes(surface, block.xyz, _REACH_M)[0]
    near = np.abs(distances[np.isfinite(distances)])
    return {
        "reprojection_median_px": float(np.median(tracks)),
        "surface_points": len(near),
        "surface_median_m": float(np.median(near)) if len(near) else None,
        "surface_rms_m": float(np.sqrt((near**2).mean())) if len(near) else None,
    }


def _own_spread(block: Block, control: Marks) -> dict[str, float]:
    """Spread of a frame's correspondences about the map and about its own best pose, and what is allowed.

    Of the frame that contradicts the map most. Where map, scan and frames contradict each other, robust
    weights put the frames aside.
    """
    photos = np.unique(control.photo_of).tolist()
    poses = list(block.cam_from_block)
    for photo in photos:
        poses[photo] = _own_pose(block, control, photo)
    own, in_map = (
        _control_residuals(found, control) for found in (replace(block, cam_from_block=tuple(poses)), block)
    )
    shared = design_effect(*own, longest_side(block.cameras))
    frames = []
    for photo in photos:
        side_px = longest_side([block.camera(photo)])
        of_own, of_map = (residuals[photo_of == photo] for residuals, _, photo_of in (own, in_map))
        seen = 2 * len(of_map) >= np.count_nonzero(control.photo_of == photo)
        in_map_px = _spread(of_map) if seen else float("inf")
        own_px = min(max(_spread(of_own), _MIN_SIGMA_REL * side_px), in_map_px)
        free = max(_MAD_EFFICIENCY * of_own.size / shared, 1.0)
        by_chance = own_px * float(f_distribution.isf(_CONTROL_RATE / len(photos), free, free)) ** 0.5
        frames.append((in_map_px, own_px, max(by_chance, _CONTROL_REL * side_px)))
    in_map_px, own_px, allowed_px = max(frames, key=lambda one: one[0] / one[2])
    return {"own_px": own_px, "in_map_px": in_map_px, "allowed_px": allowed_px}


def _own_pose(block: Block, control: Marks, photo: int) -> Rigid3:
    """The pose that fits a frame's correspondences best (Cauchy's loss), from that of the map."""
    pose, rows = block.cam_from_block[photo], control.photo_of == photo
    xyz, xy, only = control.xyz[rows], control.xy[rows], np.zeros(int(rows.sum()), np.int64)
    for _ in range(_OWN_ROUNDS if len(only) else 0):
        found = linearise((block.camera(photo),), only[:1], [pose], xyz, np.arange(len(only)), only, xy)
        seen = np.isfinite(found.residual).all(axis=1)
        residual, by_pose = found.residual[seen], found.by_pose[seen]
        relative = (residual**2).sum(axis=1) / max(4.0 * _spread(residual) ** 2, 1e-12)
        root = 1.0 / np.sqrt(1.0 + relative)[:, None]
        weighed = (by_pose * root[:, None]).reshape(-1, 6)
        pose = Rigid3.exp(np.linalg.lstsq(weighed, (residual * root).ravel(), rcond=None)[0]) @ pose
    return pose


def _gate(block: Block, figures: dict[str, Any]) -> tuple[AdjustReason | None, str]:
    before, after = figures["before"], figures["after"]
    if any(_folds_inside(camera) for camera in block.cameras):
        return "LENS", "the adjusted lens would fold the picture's corners"
    limit = (1.0 + _MAX_REPROJECTION_GROWTH) * max(
        before["reprojection_median_px"], _REPROJECTION_FLOOR_REL * longest_side(block.cameras)
    )
    if after["reprojection_median_px"] > limit:
        return "REPROJECTION", (
            f"the scan would raise the median reprojection error from {before['reprojection_median_px']:.2f} "
            f"to {after['reprojection_median_px']:.2f} pixels"
        )
    if after["surface_median_m"] is None or _further(before, after):
        return "SURFACE", "the adjustment brings the map no closer to the scan"
    own = figures["own"]
    if not own["in_map_px"] <= own["allowed_px"]:
        return "CONTROL", (
            f"what a frame sees of the scan misses the map by {own['in_map_px']:.1f} pixels, and its own "
            f"best pose by {own['own_px']:.1f}; at most {own['allowed_px']:.1f} are believed"
        )
    return None, "adjusted to the scan"


def _folds_inside(camera: Camera) -> bool:
    """Whether the lens polynomial turns back before the corner of the image."""
    center = camera.to_pycolmap()
    reach = np.hypot(
        max(center.principal_point_x, camera.width - center.principal_point_x),
        max(center.principal_point_y, camera.height - center.principal_point_y),
    )
    return bool(camera.tan_of_fold < reach / camera.focal_px)


def _further(before: dict[str, Any], after: dict[str, Any]) -> bool:
    """Whether the median distance grew by more than three standard errors of two normal medians, and more."""
    if before["surface_median_m"] is None:
        return False
    errors = [1.858 * s["surface_median_m"] / np.sqrt(s["surface_points"]) for s in (before, after)]
    allowed = max(3.0 * float(np.hypot(*errors)), _LEAST_FURTHER_M)
    return bool(after["surface_median_m"] - before["surface_median_m"] > allowed)
