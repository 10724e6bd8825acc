"""What became of maps that were adjusted together: whether they agree, how each moved and bent; new maps."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.maps.feature_map import FeatureMap, MapImage, MapPoints
from featuredb.maps.subset import take_observations
from ingest.colmap.adjust import residuals_of
from ingest.colmap.anchored import Anchored
from ingest.colmap.bridge import Model
from ingest.colmap.precision import linearise, point_covariances, residual_variance, upper_triangle
from ingest.growth.gates import SIGMAS
from ingest.growth.graph.joint.joined import JoinedMaps, MapRows
from ingest.growth.map_places import place_sigmas_m
from ingest.growth.values import MAD, pixel_scale
from ingest.register.block import block_of_map

JOINT = "joint"  # key of Placement.evidence
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


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedMap:
    """What became of one map.

    Attributes:
        held: it was not to move.
        shape_m: root mean square of what its camera centres moved against each other: what no similarity of
            the map explains. move_m: largest way of a camera centre from where the map has it.
        sigma_before_px, sigma_px: of its reprojection errors, before and after.
        kept: share of its observations that still fit.
    """

    map_id: str
    held: bool
    photos: int
    shape_m: float
    move_m: float
    sigma_before_px: float
    sigma_px: float
    kept: float

    def as_json(self) -> dict[str, Any]:
        return {key: round(v, 4) if isinstance(v, float) else v for key, v in asdict(self).items()}


def describe(
    maps: Sequence[FeatureMap], held: Collection[str], joined: JoinedMaps, result: Anchored
) -> list[AdjustedMap]:
    """What became of each map; the result is in the first one's frame."""
    model = result.model
    after, _, photo_of = residuals_of(model.block(model.pixels(joined.keypoints)))
    reports = []
    for feature_map, rows in zip(maps, joined.maps, strict=True):
        before = block_of_map(feature_map)
        old, new = (
            maps[0].frame.enu_from(feature_map.frame).act(before.centers()),
            model.centers()[rows.photos],
        )
        reports.append(
            AdjustedMap(
                map_id=feature_map.map_id,
                held=feature_map.map_id in held,
                photos=len(old),
                shape_m=_shape_m(old, new),
                move_m=float(np.linalg.norm(new - old, axis=1).max(initial=0.0)),
                sigma_before_px=_sigma_px(residuals_of(before)[0]),
                sigma_px=_sigma_px(after[np.isin(photo_of, rows.photos)]),
                kept=len(kept_observations(rows, result)[0]) / max(len(before.xy), 1),
            )
        )
    return reports


def _sigma_px(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals (m, 2)."""
    return MAD * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def _shape_m(before: FloatArray, after: FloatArray) -> float:
    fit = similarity_closed_form(before, after) if len(before) >= 3 else None
    if fit is None:
        return 0.0
    return float(np.sqrt(np.mean(np.sum((fit.act(before) - after) ** 2, axis=1))))


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


def adjusted_maps(
    maps: Sequence[FeatureMap], joined: JoinedMaps, result: Anchored, reports: Sequence[AdjustedMap]
) -> tuple[FeatureMap, ...]:
    """Maps that are not held, with photos, lenses and points as they are now, without what no longer fits."""
    model, count = result.model, len(result.model.xyz)
    linear = linearise(
        model.cameras,
        model.camera_of,
        model.cam_from_sfm,
        model.xyz,
        model.point_of,
        model.photo_of,
        model.pixels(joined.keypoints),
    )
    covariances = point_covariances(linear, count, residual_variance(linear, len(model.rows), count))
    off = np.linalg.norm(linear.residual, axis=1)
    errors = np.bincount(model.point_of, weights=off, minlength=count) / np.maximum(model.track_lengths(), 1)
    together = sorted(m.map_id for m in maps)
    new = []
    for feature_map, rows, report in zip(maps, joined.maps, reports, strict=True):
        if report.held:
            continue
        to_own = Sim3.from_rigid3(feature_map.frame.enu_from(maps[0].frame))
        cameras = list(feature_map.cameras)
        images: list[MapImage] = []
        for image, k in zip(feature_map.images, rows.photos.tolist(), strict=True):
            cameras[image.camera_id] = model.cameras[int(model.camera_of[k])]
            images.append(replace(image, cam_from_local=to_own.act_on_pose(model.cam_from_sfm[k])))
        kept, joint_point = kept_observations(rows, result)
        seen = feature_map.observations
        points, first, index = np.unique(seen.point_index[kept], return_index=True, return_inverse=True)
        index, joint = index.reshape(-1).astype(np.int64), joint_point[first]
        places = to_own.act(model.xyz[joint])
        move = (
            similarity_closed_form(feature_map.points_local()[points], places) if len(points) >= 3 else None
        )
        placement = feature_map.placement
        told = {JOINT: {"with": together, **report.as_json()}}
        new.append(
            replace(
                feature_map,
                cameras=tuple(cameras),
                images=tuple(images),
                points=MapPoints(
                    utm=feature_map.frame.utm_from_enu(places, feature_map.epsg),
                    rgb=feature_map.points.rgb[points],
                    track_length=np.bincount(index, minlength=len(points)).astype(np.int32),
                    error_px=errors[joint].astype(np.float32),
                    covariance=upper_triangle(to_own.rotation @ covariances[joint] @ to_own.rotation.T),
                ),
                observations=replace(take_observations(seen, kept), point_index=index),
                placement=replace(
                    placement,
                    local_from_sfm=(move or Sim3.identity()) @ placement.local_from_sfm,
                    evidence={**placement.evidence, **told},
                ),
            )
        )
    return tuple(new)


def kept_observations(rows: MapRows, result: Anchored) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (k,) of a map's observations that still fit, and the model's points (k,) that they see."""
    model = result.model
    now = np.stack([result.old_point[model.point_of], model.photo_of, model.keypoint_of], axis=1)
    place = {tuple(key): int(point) for key, point in zip(now.tolist(), model.point_of, strict=True)}
    asked = np.stack([rows.point_of, rows.photo_of, rows.keypoint_of], axis=1).tolist()
    found = np.array([place.get(tuple(key), -1) for key in asked], dtype=np.int64).reshape(-1)
    kept = np.flatnonzero(found >= 0)
    return kept, found[kept]
