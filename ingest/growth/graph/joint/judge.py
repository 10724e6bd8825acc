"""Whether maps that were adjusted together agree: how far each moved and bent, and what still fits."""

from collections.abc import Collection, Sequence

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.anchored import Anchored
from ingest.colmap.bridge import Model
from ingest.growth.graph.joint.adjusted_map import kept_observations
from ingest.growth.graph.joint.joined import JoinedMaps, observed_pixels
from ingest.growth.graph.joint.values import AdjustedMap, JointOptions
from ingest.growth.map_places import place_sigmas_m


def describe(
    maps: Sequence[FeatureMap],
    held: Collection[str],
    joined: JoinedMaps,
    result: Anchored,
    frame: LocalFrame,
) -> list[AdjustedMap]:
    """What became of each map.

    Args:
        frame: of the result.
    """
    after = _sigmas_px(joined, result.model)
    reports = []
    for a, feature_map in enumerate(maps):
        new = result.model.centers()[joined.maps[a].photos]
        old = frame.enu_from(feature_map.frame).act(
            np.array([image.cam_from_local.center for image in feature_map.images])
        )
        kept, _ = kept_observations(joined.maps[a], result)
        reports.append(
            AdjustedMap(
                map_id=feature_map.map_id,
                held=feature_map.map_id in held,
                photos=len(feature_map.images),
                shape_m=_shape_m(old, new),
                move_m=float(np.linalg.norm(new - old, axis=1).max(initial=0.0)),
                sigma_before_px=_own_sigma_px(feature_map),
                sigma_px=after[a],
                kept=len(kept) / max(len(feature_map.observations), 1),
            )
        )
    return reports


def refusal(
    maps: Sequence[FeatureMap],
    free: Collection[str],
    joined: JoinedMaps,
    adjusted: Model,
    reports: Sequence[AdjustedMap],
    options: JointOptions,
) -> tuple[str | None, str]:
    """The first reason (see `JointAdjustment`) against the adjusted model, or None; and a message."""
    counts = [np.bincount(m.photo_of, minlength=len(m.rows)) for m in (joined.model, adjusted)]
    poor = np.flatnonzero((counts[0] >= options.min_observations) & (counts[1] < options.min_observations))
    if len(poor):
        return "PHOTO_LOST", (
            f"{len(poor)} photos keep fewer than {options.min_observations} of their observations: the maps "
            "contradict each other there"
        )
    for feature_map, report in zip(maps, reports, strict=True):
        side = max(max(camera.width, camera.height) for camera in feature_map.cameras)
        least = options.least_sigma_px * max(1.0, side / options.reference_side_px)
        limit = options.max_residual_growth * max(report.sigma_before_px, least)
        if report.sigma_px > limit:
            return "RESIDUALS", (
                f"map {report.map_id}: residuals of {report.sigma_before_px:.2f} px became "
                f"{report.sigma_px:.2f} px, at most {limit:.2f} px are expected"
            )
    poor_maps = [r for r in reports if r.kept < options.min_kept]
    if poor_maps:
        return "OBSERVATIONS_LOST", (
            f"map {poor_maps[0].map_id}: {poor_maps[0].kept:.0%} of its observations still fit, "
            f"{options.min_kept:.0%} are needed: the maps contradict each other"
        )
    for feature_map, report in zip(maps, reports, strict=True):
        if feature_map.parents or report.held or report.map_id in free:
            continue
        most = max(options.sigmas * placement_sigma_m(feature_map), options.least_move_m)
        if report.move_m > most:
            return "ANCHOR_MOVED", (
                f"map {report.map_id} would move by {report.move_m:.2f} m, its own placement allows "
                f"{most:.2f} m: anchors contradict each other; name it as free if it is the wrong one"
            )
    return None, f"{len(reports)} maps adjusted together"


def placement_sigma_m(feature_map: FeatureMap) -> float:
    """Largest standard deviation of a map's photos by its placement."""
    centers = np.array([image.cam_from_local.center for image in feature_map.images]).reshape(-1, 3)
    return float(place_sigmas_m(feature_map.placement.covariance, centers).max(initial=0.0))


def _own_sigma_px(feature_map: FeatureMap) -> float:
    """Robust standard deviation of a map's residuals, by its own poses, points and lenses."""
    seen, points = feature_map.observations, feature_map.points_local()
    off = [np.zeros((0, 2))]
    for image in feature_map.images:
        mine = np.flatnonzero(seen.image_id == image.image_id)
        places = image.cam_from_local.act(points[seen.point_index[mine]])
        off.append(feature_map.cameras[image.camera_id].project(places) - seen.xy[mine])
    return _sigma_px(np.concatenate(off))


def _sigma_px(off: FloatArray) -> float:
    return 1.4826 * float(np.nanmedian(np.abs(off))) if np.isfinite(off).any() else 0.0


def _sigmas_px(joined: JoinedMaps, model: Model) -> list[float]:
    """The same of the photos of each map in the model."""
    off = observed_pixels(joined, model)
    for k, pose in enumerate(model.cam_from_sfm):
        mine = np.flatnonzero(model.photo_of == k)
        off[mine] -= model.cameras[int(model.camera_of[k])].project(pose.act(model.xyz[model.point_of[mine]]))
    return [_sigma_px(off[np.isin(model.photo_of, rows.photos)]) for rows in joined.maps]


def _shape_m(before: FloatArray, after: FloatArray) -> float:
    fit = similarity_closed_form(before, after) if len(before) >= 3 else None
    if fit is None:
        return 0.0
    return float(np.sqrt(np.mean(np.sum((fit.act(before) - after) ** 2, axis=1))))
