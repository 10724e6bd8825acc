"""Structure projection: registered frames carry the map's points onto the scan, and the map follows.

Structure-projection paper, 2.4. Here the refinement weighs pairs by their own covariance and knows that all
pairs of a frame share its pose error. In the place of ICP comes the adjustment by the scan's surface.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray, joined
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.move import full_covariances
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame_registration import FrameRegistration
from ingest.register.outcome import Outcome
from ingest.register.structure.depth_filter import SurfaceHits, surface_at
from ingest.register.structure.similarity import Pairs, SimilarityFit, ransac_similarity, refine_similarity

Registered = Mapping[int, FrameRegistration]  # accepted, in the local frame of the cloud, by image id
StructureReason = Literal["TOO_FEW_PAIRS", "NO_SPREAD", "NO_SIMILARITY", "SCALE"]

# A pair further off, as a share of its distance from the camera, is an outlier of RANSAC: reconstructions
# bend by up to about a percent of the flying height.
_TOLERANCE_REL = 0.015
_MIN_TOLERANCE_M = 0.15  # but never less than the scan's own noise and spacing explain
# Inliers; the paper speaks of hundreds. Thirty fix a similarity to a fifth of a pair's sigma.
_MIN_PAIRS = 30
_MIN_INLIER_SHARE = 0.3  # of the pairs; with fewer the frame or the map is wrong
# Second singular value of the inliers' spread over their distance from the camera; pairs closer to a line
# leave the rotation about it open.
_MIN_SPREAD_REL = 0.02
# Of the map against its present placement, beyond the sigmas of both. GPS that was accepted knows the scale
# to a tenth or better.
_MAX_SCALE_CHANGE = 0.05
_SCALE_SIGMAS = 4.0  # how many sigmas of both placements the scale may differ
# Of the depth image; about the resolution at which airborne scans have a point in most pixels of a drone's
# photo. Hits come from keypoints and scan points, whatever the resolution: of 1000 px, the image takes two to
# three times as long, and maps lie within a fifth of their sigmas of where they do now.
_RENDER_WIDTH_PX = 600
# Standard deviation of a keypoint against the scan, as a share of the photo's longer side: a pixel in 2000,
# what lens models leave.
_PIXEL_SIGMA_REL = 0.0005
_SCAN_SIGMA_M = 0.03  # of the scan's points across their surface, beyond what the roughness shows
_MAX_POINT_SIGMA_REL = 0.05  # map points less certain than this share of their distance are left out
_CELLS = 6  # per side of the grid of neighbourhoods in a frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StructurePlacement(Outcome[StructureReason]):
    """Where structure projection puts a map, or why it does not.

    Attributes:
        new_from_old: similarity of the scan's local frame that moves the map from its present place to
            the new one, None when refused.
        covariance: (7, 7) of its left perturbation, None when refused.
    """

    new_from_old: Sim3 | None = None
    covariance: FloatArray | None = None


def project_structure(
    feature_map: FeatureMap, registered: Registered, cloud: PointCloud
) -> StructurePlacement:
    """Place a map on a scan by frames of the map, one or more, that were registered to it."""
    source = feature_map.points_local(cloud.frame)
    pairs = structure_pairs(feature_map, source, registered, cloud)
    if len(pairs) < _MIN_PAIRS:
        words = f"{len(pairs)} of the map's points meet the scan, at least {_MIN_PAIRS} are needed"
        return StructurePlacement(reason="TOO_FEW_PAIRS", message=words)
    centers = np.array([r.cam_from_local.center for r in registered.values()])  # type: ignore[union-attr]
    distances = np.linalg.norm(pairs.target - centers[pairs.frame_of], axis=1)
    tolerance = np.maximum(_MIN_TOLERANCE_M, _TOLERANCE_REL * distances)
    start = ransac_similarity(pairs.source, pairs.target, tolerance)
    if start is None:
        words = "the pairs lie on a line or coincide"
        return StructurePlacement(reason="NO_SIMILARITY", message=words)
    near = np.linalg.norm(pairs.target - start.act(pairs.source), axis=1) <= 2 * tolerance
    reason, message, figures = _gate_of_pairs(pairs, near, distances)
    if reason is not None:
        return StructurePlacement(reason=reason, message=message, figures=figures)
    fit = refine_similarity(start, pairs.of(near))
    figures |= {
        "inliers": int(fit.inliers.sum()),
        "residual_rms_m": float(np.sqrt((fit.residuals_m[fit.inliers] ** 2).sum(axis=1).mean())),
        "neighbours_factor": fit.neighbours_factor,
        "scale_change": fit.target_from_source.scale - 1.0,
        "scale_sigma": float(np.sqrt(fit.covariance[0, 0])),
        "previous_scale_sigma": float(np.sqrt(feature_map.placement.covariance[0, 0])),
    }
    reason, message = _gate_of_fit(fit, figures)
    placed = StructurePlacement(reason=reason, message=message, figures=figures)
    if reason is not None:
        return placed
    return replace(placed, new_from_old=fit.target_from_source, covariance=fit.covariance)


def _gate_of_pairs(
    pairs: Pairs, near: NDArray[np.bool_], distances: FloatArray
) -> tuple[StructureReason | None, str, dict[str, Any]]:
    """Whether RANSAC's inliers can carry a similarity."""
    used = int(near.sum())
    spread = 0.0
    if used >= 3:
        centred = pairs.target[near] - pairs.target[near].mean(axis=0)
        across = float(np.linalg.svd(centred, compute_uv=False)[1]) / np.sqrt(used)
        spread = across / float(np.median(distances[near]))
    figures: dict[str, Any] = {"pairs": len(pairs), "ransac_inliers": used, "spread_rel": spread}
    needed = f"at least {_MIN_PAIRS} and {_MIN_INLIER_SHARE:.0%} are needed"
    if used < _MIN_PAIRS or used < _MIN_INLIER_SHARE * len(pairs):
        words = f"{used} of {len(pairs)} pairs agree on a similarity, {needed}"
        return "TOO_FEW_PAIRS", words, figures
    if spread < _MIN_SPREAD_REL:
        words = f"the pairs lie along a line: {spread:.1%} of their distance across it"
        return "NO_SPREAD", f"{words}, at least {_MIN_SPREAD_REL:.0%} are needed", figures
    return None, "", figures


def _gate_of_fit(fit: SimilarityFit, figures: dict[str, Any]) -> tuple[StructureReason | None, str]:
    """How far the pairs miss each other is no question here: the adjustment behind it straightens the map."""
    if figures["inliers"] < _MIN_PAIRS:
        return "TOO_FEW_PAIRS", (
            f"{figures['inliers']} pairs remain after refinement, at least {_MIN_PAIRS} are needed"
        )
    change = abs(float(np.log(fit.target_from_source.scale)))
    sigma = float(np.hypot(figures["scale_sigma"], figures["previous_scale_sigma"]))
    allowed = max(_MAX_SCALE_CHANGE, _SCALE_SIGMAS * sigma)
    if change > allowed:
        return "SCALE", (
            f"the map would change its size by {change:.1%}, at most {allowed:.1%} agrees with its present "
            "placement"
        )
    return None, "placed on the scan"


def structure_pairs(
    feature_map: FeatureMap, source: FloatArray, registered: Registered, cloud: PointCloud
) -> Pairs:
    """Pairs of all frames; `source` (n, 3): the map's points at their present place, in the cloud's frame."""
    images = {image.image_id: image for image in feature_map.images}
    uncertainty = full_covariances(feature_map.points.covariance)
    parts = [
        _pairs_of_frame(feature_map, source, uncertainty, images[image_id], registration, row, cloud)
        for row, (image_id, registration) in enumerate(registered.items())
    ]
    return joined(parts)


def _pairs_of_frame(
    feature_map: FeatureMap,
    source: FloatArray,
    uncertainty: FloatArray,
    image: MapImage,
    registration: FrameRegistration,
    row: int,
    cloud: PointCloud,
) -> Pairs:
    pose, covariance, camera = registration.cam_from_local, registration.covariance, registration.camera
    assert pose is not None
    assert covariance is not None
    assert camera is not None  # accepted
    width = min(_RENDER_WIDTH_PX, camera.width)
    small = camera.scaled_to(width, round(camera.height * width / camera.width))
    rendering = render(cloud, small, pose, RenderOptions(threads=1, attributes=False))
    xy = feature_map.observations.xy[feature_map.observations.image_id == image.image_id]
    pixels = xy.astype(np.float64) * (small.width / camera.width, small.height / camera.height)
    hits = surface_at(rendering, cloud, pixels)
    points = feature_map.points_in(image)[hits.rows]
    largest = np.linalg.eigvalsh(uncertainty[points])[:, -1]
    own, by_frame = _errors(hits, pose, camera)
    at = pixels[hits.rows] / (small.width, small.height)
    grid = np.minimum((at * _CELLS).astype(np.int64), _CELLS - 1)
    pairs = Pairs(
        frame_of=np.full(len(points), row, dtype=np.int64),
        source=source[points],
        target=hits.points,
        covariance=own + uncertainty[points],
        by_frame=by_frame,
        cell_of=row * _CELLS**2 + grid[:, 1] * _CELLS + grid[:, 0],
        frame_covariance=covariance[None],
    )
    distance = np.linalg.norm(hits.points - pose.center, axis=1)
    return pairs.of(largest <= (_MAX_POINT_SIGMA_REL * distance) ** 2)


def _errors(hits: SurfaceHits, pose: Rigid3, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Covariance (n, 3, 3) of each hit by its own errors, and derivative (n, 3, 6) by the frame's pose.

    A ray that turns or shifts by d meets the surface's plane at d - u (n.d)/(n.u), u being its direction.
    """
    rays = hits.points - pose.center
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.einsum("ij,ij->i", hits.normals, direction)
    slide = np.eye(3) - direction[:, :, None] * hits.normals[:, None, :] / facing[:, None, None]
    pixel_m = _PIXEL_SIGMA_REL * max(camera.width, camera.height) / camera.focal_px * hits.depths
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    shifted = slide @ across
    own = (pixel_m**2)[:, None, None] * shifted @ np.swapaxes(shifted, 1, 2)
    along = hits.sigma_ray_m**2 + (_SCAN_SIGMA_M / facing) ** 2
    own += along[:, None, None] * direction[:, :, None] * direction[:, None, :]
    # T_true = exp(xi) T moves the point at camera coordinates p by -R' (omega x p + nu).
    in_camera = pose.act(hits.points)
    by_pose = np.concatenate([skew(in_camera), np.broadcast_to(-np.eye(3), (len(rays), 3, 3))], axis=2)
    return own, slide @ (pose.rotation.T @ by_pose)
