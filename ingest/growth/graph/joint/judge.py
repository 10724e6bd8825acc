"""Whether maps that were adjusted together agree: how far each moved and bent, and what still fits."""

from collections.abc import Collection, Sequence

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.anchored import Anchored
from ingest.colmap.bridge import Model
from ingest.growth.gates import SIGMAS
from ingest.growth.graph.joint.adjusted_map import AdjustedMap, kept_observations
from ingest.growth.graph.joint.joined import JoinedMaps, observed_pixels
from ingest.growth.map_places import place_sigmas_m
from ingest.growth.values import MAD, pixel_scale

_LEAST_OBSERVATIONS = 15  # photos that keep fewer refuse the adjustment, if they had more
# The residuals of a map after the adjustment over those before, or over the second where they are smaller;
# more, and the maps contradict each other. On `sacre_coeur` they shrink. Keypoints are not located better, at
# images of 1600; below, residuals say how few photos a map has: one of three photos of `lewis` had 0.14 px
# alone and 0.30 px with the others, of 4,000.
_MOST_GROWTH, _LEAST_SIGMA_PX = 1.5, 0.3
# Share of a map's observations that must still fit. On `sacre_coeur`, whose first map was bent by a fiftieth
# of its viewing distance, 0.98 to 1 do; 0.83 where one of two maps shows a scene that is bent as much in
# truth.
_LEAST_KEPT = 0.9
_LEAST_MOVE_M = 0.05  # that an anchor's photos may move by, or `SIGMAS` of its placement


def describe(
    maps: Sequence[FeatureMap], held: Collection[str], joined: JoinedMaps, result: Anchored, frame: LocalFrame
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
) -> tuple[str | None, str]:
    """The first reason (see `JointAdjustment`) against the adjusted model, or None; and a message."""
    counts = [np.bincount(m.photo_of, minlength=len(m.rows)) for m in (joined.model, adjusted)]
    poor = np.flatnonzero((counts[0] >= _LEAST_OBSERVATIONS) & (counts[1] < _LEAST_OBSERVATIONS))
    if len(poor):
        return "PHOTO_LOST", (
            f"{len(poor)} photos keep fewer than {_LEAST_OBSERVATIONS} of their observations: the maps "
            "contradict each other there"
        )
    for feature_map, report in zip(maps, reports, strict=True):
        least = _LEAST_SIGMA_PX * pixel_scale(*feature_map.cameras)
        limit = _MOST_GROWTH * max(report.sigma_before_px, least)
        if report.sigma_px > limit:
            return "RESIDUALS", (
                f"map {report.map_id}: residuals of {report.sigma_before_px:.2f} px became "
                f"{report.sigma_px:.2f} px, at most {limit:.2f} px are expected"
            )
    poor_maps = [r for r in reports if r.kept < _LEAST_KEPT]
    if poor_maps:
        return "OBSERVATIONS_LOST", (
            f"map {poor_maps[0].map_id}: {poor_maps[0].kept:.0%} of its observations still fit, "
            f"{_LEAST_KEPT:.0%} are needed: the maps contradict each other"
        )
    for feature_map, report in zip(maps, reports, strict=True):
        if feature_map.parents or report.held or report.map_id in free:
            continue
        most = max(SIGMAS * placement_sigma_m(feature_map), _LEAST_MOVE_M)
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
    return MAD * float(np.nanmedian(np.abs(off))) if np.isfinite(off).any() else 0.0


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
