"""Maps that overlap, adjusted together.

Growth holds fixed what it stands on: a first map of six photos that is bent stays so, and what grew on it
bends along. Once more photos are there they know better. Here all of them have a say: points that are the
same in several maps are joined, and one bundle adjustment moves poses, points and lenses of all maps, but
those that are held. Ids, parents, overlaps and the uncertainty of every map stay, and so does the place of
the anchors among them, as a whole.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints
from ingest.colmap_anchored import Anchored, AnchoredOptions, FixedPoints, adjust_anchored
from ingest.colmap_bridge import Model
from ingest.growth.map_graph import place_sigmas_m
from ingest.growth.refine import in_metres
from ingest.joint.joined import Joined, MapRows, join_maps
from ingest.joint.links import LinkOptions, find_links
from ingest.precision import linearise, point_covariances, residual_variance, upper_triangle
from ingest.register.gps import similarity_closed_form

JOINT = "joint"  # key of Placement.evidence
_AS_SURE = 2.0  # anchors up to so many times as uncertain as the surest hold the place of all


@dataclass(frozen=True, slots=True, kw_only=True)
class JointOptions:
    """The joint adjustment.

    Attributes:
        min_shared_points: two maps are connected from so many points on: an accepted pose has 15 inliers,
            and an overlap is measured by 60.
        min_observations: photos that keep fewer refuse the adjustment, if they had more.
        max_residual_growth: the residuals of a map after the adjustment over those before, or over
            `least_sigma_px` where they are smaller; more, and the maps contradict each other. On
            `sacre_coeur` they shrink.
        least_sigma_px: keypoints are not located better, at `reference_side_px`; below, residuals say how few
            photos a map has: one of three photos of `lewis` had 0.14 px alone and 0.30 px with the others,
            of 4,000.
        reference_side_px: longer sides of photos count as at least this.
        min_kept: share of a map's observations that must still fit. On `sacre_coeur`, whose first map was
            bent by a fiftieth of its viewing distance, 0.98 to 1 do; 0.83 where one of two maps shows a
            scene that is bent as much in truth.
        sigmas: of its placement that an anchor's photos may move by, or `least_move_m`.
    """

    min_shared_points: int = 30
    min_observations: int = 15
    max_residual_growth: float = 1.5
    least_sigma_px: float = 0.3
    reference_side_px: int = 1600
    min_kept: float = 0.9
    sigmas: float = 3.0
    least_move_m: float = 0.05
    links: LinkOptions = field(default_factory=LinkOptions)
    adjust: AnchoredOptions = field(default_factory=lambda: AnchoredOptions(rounds=3))


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
        return {
            "map_id": self.map_id,
            "held": self.held,
            "photos": self.photos,
            "shape_m": round(self.shape_m, 4),
            "move_m": round(self.move_m, 4),
            "sigma_before_px": round(self.sigma_before_px, 4),
            "sigma_px": round(self.sigma_px, 4),
            "kept": round(self.kept, 4),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointAdjustment:
    """Adjusted maps, or why there are none.

    Attributes:
        reason: None, or UNCONNECTED, PHOTO_LOST, RESIDUALS, OBSERVATIONS_LOST, ANCHOR_MOVED; `message` for
            people.
        maps: those that moved, new; empty where there is a reason.
        reports: of each map, as far as it came.
        shared_points: points that more than one map has.
        elsewhere: photos that other maps have elsewhere than their own; they were not heard.
    """

    reason: str | None
    message: str
    maps: tuple[FeatureMap, ...] = ()
    reports: tuple[AdjustedMap, ...] = ()
    shared_points: int = 0
    elsewhere: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "reason": self.reason,
            "message": self.message,
            "maps": [report.as_json() for report in self.reports],
            "shared_points": self.shared_points,
            "elsewhere": list(self.elsewhere),
        }


def adjust_together(
    maps: Sequence[FeatureMap],
    held: Collection[str] = (),
    options: JointOptions | None = None,
    *,
    free: Collection[str] = (),
) -> JointAdjustment:
    """Adjust maps that overlap, all at once.

    Args:
        maps: of one extractor and height datum.
        held: ids of those whose photos, points and lenses stay; they are not among the new ones.
        free: anchors that may move further than their placement's uncertainty explains.

    Raises:
        InvalidValueError: fewer than two maps, or of different extractors or datums.
    """
    options = options or JointOptions()
    _check(maps, held)
    # What comes first lends the others its photos' poses, its lenses and points.
    maps = sorted(maps, key=lambda m: (m.map_id not in held, m.generation, -len(m.images), m.map_id))
    frame = maps[0].frame
    links = find_links(maps, options.links)
    joined = join_maps(maps, links, frame)
    shared = int(np.triu(joined.shared, 1).sum())
    alone = _unconnected(maps, joined.shared, options.min_shared_points)
    if alone:
        return JointAdjustment(
            reason="UNCONNECTED",
            message=f"maps {', '.join(alone)} have fewer than {options.min_shared_points} points in common "
            f"with the others; {links.heard} photos were found in other maps",
            shared_points=shared,
            elsewhere=links.elsewhere,
        )
    kept = [a for a, m in enumerate(maps) if m.map_id in held]
    constant = _photos_of(joined, kept)
    result = adjust_anchored(
        joined.model,
        joined.keypoints,
        FixedPoints.none(),
        np.unique(joined.model.camera_of[constant]).tolist(),
        options.adjust,
        joined.known_focal_px,
        constant_photos=constant.tolist(),
        constant_points=np.unique(
            np.concatenate([np.zeros(0, np.int64), *(joined.maps[a].point_of for a in kept)])
        ).tolist(),
    )
    if not len(constant):
        result = replace(result, model=in_metres(result.model, _back(maps, joined, result.model)))
    return _judged(maps, held, free, joined, result, frame, shared, links.elsewhere, options)


def _photos_of(joined: Joined, maps: Sequence[int]) -> NDArray[np.int64]:
    """Rows of the photos of some maps."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(joined.maps[a].photos for a in maps)]))


def _check(maps: Sequence[FeatureMap], held: Collection[str]) -> None:
    if len(maps) < 2:
        raise InvalidValueError(f"adjust_together: expected at least two maps, found {len(maps)}")
    if len({m.map_id for m in maps}) != len(maps):
        raise InvalidValueError("adjust_together: a map is named twice")
    for what, values in (
        ("extractor", {m.extractor_fingerprint for m in maps}),
        ("height datum", {m.height_datum for m in maps}),
    ):
        if len(values) > 1:
            raise InvalidValueError(f"adjust_together: expected one {what}, found {sorted(values)}")
    if all(m.map_id in held for m in maps):
        raise InvalidValueError("adjust_together: all maps are held, nothing could move")


def _unconnected(maps: Sequence[FeatureMap], shared: NDArray[np.int64], least: int) -> list[str]:
    """Maps outside the largest group of maps with enough points in common."""
    _, label = connected_components(sparse.csr_array((shared >= least).astype(np.int8)), directed=False)
    largest = int(np.argmax(np.bincount(label)))
    return [m.map_id for m, group in zip(maps, label.tolist(), strict=True) if group != largest]


def _back(maps: Sequence[FeatureMap], joined: Joined, adjusted: Model) -> Sim3:
    """The similarity that takes the photos of the surest anchors back to their places as a whole.

    Robust: the photo that the adjustment moved against the others is not what should hold them.
    """
    lowest = min(m.generation for m in maps)
    sigma = [_placement_sigma_m(m) if m.generation == lowest else np.inf for m in maps]
    rows = _photos_of(joined, [a for a in range(len(maps)) if sigma[a] <= _AS_SURE * min(sigma)])
    source, target = _reach(adjusted, rows), _reach(joined.model, rows)
    weights = np.ones(len(source), dtype=np.bool_)
    best = Sim3.identity()
    for _ in range(5):
        found = similarity_closed_form(source[weights], target[weights])
        if found is None:
            break
        best = found
        off = np.linalg.norm(best.act(source) - target, axis=1)
        weights = off <= 3.0 * max(float(np.median(off)), 1e-9)
    return best


def _placement_sigma_m(feature_map: FeatureMap) -> float:
    """Largest standard deviation of a map's photos by its placement."""
    centers = np.array([image.cam_from_local.center for image in feature_map.images]).reshape(-1, 3)
    return float(place_sigmas_m(feature_map.placement.covariance, centers).max(initial=0.0))


def _reach(model: Model, rows: NDArray[np.int64]) -> FloatArray:
    """Centres of photos and points one median viewing distance before them: a place and a direction each."""
    distance = 0.0
    if len(model.xyz):
        offsets = model.xyz[model.point_of] - model.centers()[model.photo_of]
        distance = float(np.median(np.linalg.norm(offsets, axis=1)))
    centers = model.centers()[rows]
    axes = np.array([model.cam_from_sfm[r].rotation for r in rows.tolist()])
    return np.concatenate([centers, *(centers + distance * axes[:, k] for k in range(3))])


def _judged(
    maps: Sequence[FeatureMap],
    held: Collection[str],
    free: Collection[str],
    joined: Joined,
    result: Anchored,
    frame: LocalFrame,
    shared: int,
    elsewhere: tuple[str, ...],
    options: JointOptions,
) -> JointAdjustment:
    after = _sigmas_px(joined, result.model)
    reports = []
    for a, feature_map in enumerate(maps):
        new = result.model.centers()[joined.maps[a].photos]
        old = frame.enu_from(feature_map.frame).act(
            np.array([image.cam_from_local.center for image in feature_map.images])
        )
        reports.append(
            AdjustedMap(
                map_id=feature_map.map_id,
                held=feature_map.map_id in held,
                photos=len(feature_map.images),
                shape_m=_shape_m(old, new),
                move_m=float(np.linalg.norm(new - old, axis=1).max(initial=0.0)),
                sigma_before_px=_own_sigma_px(feature_map),
                sigma_px=after[a],
                kept=len(_kept(joined.maps[a], result)[0]) / max(len(feature_map.observations), 1),
            )
        )
    reason, message = _refusal(maps, free, joined, result.model, reports, options)
    adjusted: list[FeatureMap] = []
    if reason is None:
        precision = _precision(joined, result.model)
        adjusted = [
            _adjusted_map(feature_map, joined.maps[a], result, precision, frame, maps, reports[a])
            for a, feature_map in enumerate(maps)
            if feature_map.map_id not in held
        ]
    return JointAdjustment(
        reason=reason,
        message=message,
        maps=tuple(adjusted),
        reports=tuple(reports),
        shared_points=shared,
        elsewhere=elsewhere,
    )


def _refusal(
    maps: Sequence[FeatureMap],
    free: Collection[str],
    joined: Joined,
    adjusted: Model,
    reports: Sequence[AdjustedMap],
    options: JointOptions,
) -> tuple[str | None, str]:
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
        most = max(options.sigmas * _placement_sigma_m(feature_map), options.least_move_m)
        if report.move_m > most:
            return "ANCHOR_MOVED", (
                f"map {report.map_id} would move by {report.move_m:.2f} m, its own placement allows "
                f"{most:.2f} m: anchors contradict each other; name it as free if it is the wrong one"
            )
    return None, f"{len(reports)} maps adjusted together"


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


def _sigmas_px(joined: Joined, model: Model) -> list[float]:
    """The same of the photos of each map in the model."""
    off = _pixels(joined, model)
    for k, pose in enumerate(model.cam_from_sfm):
        mine = np.flatnonzero(model.photo_of == k)
        off[mine] -= model.cameras[int(model.camera_of[k])].project(pose.act(model.xyz[model.point_of[mine]]))
    return [_sigma_px(off[np.isin(model.photo_of, rows.photos)]) for rows in joined.maps]


def _pixels(joined: Joined, model: Model) -> FloatArray:
    """(m, 2) of the model's observations."""
    pixels = np.zeros((len(model.point_of), 2))
    for k, keypoints in enumerate(joined.keypoints):
        mine = model.photo_of == k
        pixels[mine] = keypoints[model.keypoint_of[mine]]
    return pixels


def _shape_m(before: FloatArray, after: FloatArray) -> float:
    fit = similarity_closed_form(before, after) if len(before) >= 3 else None
    if fit is None:
        return 0.0
    return float(np.sqrt(np.mean(np.sum((fit.act(before) - after) ** 2, axis=1))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Precision:
    """Of all points of the model: covariances (n, 3, 3) in its frame, mean errors (n,) in pixels."""

    covariance: FloatArray
    error_px: FloatArray


def _precision(joined: Joined, model: Model) -> _Precision:
    linear = linearise(
        model.cameras,
        model.camera_of,
        model.cam_from_sfm,
        model.xyz,
        model.point_of,
        model.photo_of,
        _pixels(joined, model),
    )
    variance = residual_variance(linear, len(model.rows), len(model.xyz))
    errors = np.bincount(
        model.point_of, weights=np.linalg.norm(linear.residual, axis=1), minlength=len(model.xyz)
    )
    return _Precision(
        covariance=point_covariances(linear, len(model.xyz), variance),
        error_px=errors / np.maximum(model.track_lengths(), 1),
    )


def _adjusted_map(
    feature_map: FeatureMap,
    rows: MapRows,
    result: Anchored,
    precision: _Precision,
    frame: LocalFrame,
    together: Sequence[FeatureMap],
    report: AdjustedMap,
) -> FeatureMap:
    """The map with its photos, lenses and points as they are now; what no longer fits is gone."""
    model = result.model
    to_own = Sim3.from_rigid3(feature_map.frame.enu_from(frame))
    cameras = list(feature_map.cameras)
    images: list[MapImage] = []
    for image, k in zip(feature_map.images, rows.photos.tolist(), strict=True):
        cameras[image.camera_id] = model.cameras[int(model.camera_of[k])]
        images.append(replace(image, cam_from_local=to_own.act_on_pose(model.cam_from_sfm[k])))
    kept, joint_point = _kept(rows, result)
    seen, old = feature_map.observations, feature_map.points
    points, first, index = np.unique(seen.point_index[kept], return_index=True, return_inverse=True)
    index, joint = index.reshape(-1).astype(np.int64), joint_point[first]
    places = to_own.act(model.xyz[joint])
    move = similarity_closed_form(feature_map.points_local()[points], places) if len(points) >= 3 else None
    turned = to_own.rotation @ precision.covariance[joint] @ to_own.rotation.T
    placement = feature_map.placement
    evidence = {
        **placement.evidence,
        JOINT: {"with": sorted(m.map_id for m in together), **report.as_json()},
    }
    return replace(
        feature_map,
        cameras=tuple(cameras),
        images=tuple(images),
        points=MapPoints(
            utm=feature_map.frame.utm_from_enu(places, feature_map.epsg),
            rgb=old.rgb[points],
            track_length=np.bincount(index, minlength=len(points)).astype(np.int32),
            error_px=precision.error_px[joint].astype(np.float32),
            covariance=upper_triangle(turned),
        ),
        observations=MapObservations(
            point_index=index,
            image_id=seen.image_id[kept],
            xy=seen.xy[kept],
            scale=seen.scale[kept],
            angle=seen.angle[kept],
            has_descriptor=seen.has_descriptor[kept],
            descriptors=seen.descriptors[kept],
        ),
        placement=replace(
            placement,
            local_from_sfm=(move or Sim3.identity()) @ placement.local_from_sfm,
            evidence=evidence,
        ),
    )


def _kept(rows: MapRows, result: Anchored) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (k,) of a map's observations that still fit, and the model's points (k,) that they see."""
    model = result.model
    now = np.stack([result.old_point[model.point_of], model.photo_of, model.keypoint_of], axis=1)
    place = {tuple(key): int(point) for key, point in zip(now.tolist(), model.point_of, strict=True)}
    asked = np.stack([rows.point_of, rows.photo_of, rows.keypoint_of], axis=1).tolist()
    found = np.array([place.get(tuple(key), -1) for key in asked], dtype=np.int64).reshape(-1)
    kept = np.flatnonzero(found >= 0)
    return kept, found[kept]
