"""The similarity that places a reconstruction by existing maps: hypotheses by photo, then a weighted fit.

What holds a new reconstruction are the pixels in which its photos see existing points. Localised poses and
pairs of a new and an existing point are made of them: they propose similarities and judge them, and the fit
itself is over the pixels,

    pixel_k = project(camera, cam_from_sfm S^-1 point_k) + noise,    S = local_from_sfm,

with noise of the pixel, of the existing point, and with what neighbours have in common.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import nearest_rotation
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.colmap.anchored import KEYPOINT_PX, pixel_scale
from ingest.colmap.bridge import Model
from ingest.colmap.precision import linearise
from ingest.growth.values import TOLERANCE_PX, LocalisedPhoto
from reloc.localise.pose import reprojection_errors

_CHI2_2_MEDIAN = 1.386  # of the squared length of two normal coordinates
_CHI2_2_95 = 5.991
_OPEN = np.array([10.0] * 4 + [1e4] * 3)  # log scale, radians, metres: what nothing holds; gates refuse it
_MOST_SCORED = 3000  # correspondences that judge a proposal; more only take longer
# A proposal rests on one photo, whose errors it carries far. What is of another place is hundreds of pixels
# off.
_LOOSE_PX = 2.0 * TOLERANCE_PX
_ROUNDS = 20  # of reweighting; weights settle within ten


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """Existing points seen by photos of a model, all in one local frame.

    Attributes:
        map_ids: the existing maps.
        photo_of: (m,) index into the model's photos. feature: (m,) row of that photo's features.
        pixels: (m, 2).
        points: (m, 3) metres. covariance: (m, 3, 3) relative to their map's gauge.
        map_of: (m,) index into the maps. point_of: (m,) row of that map's points.
        model_point: (m,) the model's own point that the same feature observes, -1 where it has none.
        carried: (m,) the match came along a track of the model, from a photo whose localisation found it.
    """

    map_ids: tuple[str, ...]
    photo_of: NDArray[np.int64]
    feature: NDArray[np.int64]
    pixels: FloatArray
    points: FloatArray
    covariance: FloatArray
    map_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    model_point: NDArray[np.int64]
    carried: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.photo_of)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Correspondences":
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})


_COLUMNS = Correspondences.__slots__[1:]


def find_correspondences(
    model: Model, localised: Mapping[int, LocalisedPhoto], keypoints: Sequence[FloatArray]
) -> Correspondences:
    """Correspondences of a model's photos, own and carried along its tracks.

    Args:
        localised: one of the model's photos at least, by place among them, all in one frame.
        keypoints: pixels (n, 2) of all features of each photo of the model.
    """
    map_ids = tuple(sorted({m for photo in localised.values() for m in photo.map_ids}))
    own = _joined(*(_own(model, k, photo, map_ids) for k, photo in localised.items()))
    return _joined(own, _carried(model, own, keypoints))


def _joined(*parts: Correspondences) -> Correspondences:
    columns: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS}
    return replace(parts[0], **columns)


def _own(model: Model, k: int, photo: LocalisedPhoto, map_ids: tuple[str, ...]) -> Correspondences:
    seen, count = model.photo_of == k, len(photo.feature_rows)
    points = dict(zip(model.keypoint_of[seen].tolist(), model.point_of[seen].tolist(), strict=True))
    return Correspondences(
        map_ids=map_ids,
        photo_of=np.full(count, k),
        feature=photo.feature_rows,
        pixels=photo.pixels,
        points=photo.points,
        covariance=photo.point_covariance,
        map_of=np.array([map_ids.index(m) for m in photo.map_ids], dtype=np.int64)[photo.map_of],
        point_of=photo.point_of,
        model_point=np.array([points.get(f, -1) for f in photo.feature_rows.tolist()], dtype=np.int64),
        carried=np.zeros(count, dtype=np.bool_),
    )


def _carried(model: Model, own: Correspondences, keypoints: Sequence[FloatArray]) -> Correspondences:
    """Where more than half of a track's matches with one map name one point, its other photos see it too."""
    linked = np.flatnonzero(own.model_point >= 0)
    triple = np.stack([own.model_point[linked], own.map_of[linked], own.point_of[linked]], axis=1)
    links, first, votes = np.unique(triple, axis=0, return_index=True, return_counts=True)
    pair, number = np.unique(links[:, :2], axis=0, return_inverse=True)
    total = np.bincount(number.reshape(-1), weights=votes, minlength=len(pair))
    sure = votes > 0.5 * total[number.reshape(-1)]
    links, example = links[sure], linked[first[sure]]
    start = np.searchsorted(model.point_of, np.arange(len(model.xyz) + 1))
    have = set(zip(own.photo_of.tolist(), own.feature.tolist(), own.map_of.tolist(), strict=True))
    found = [
        (o, row)
        for (point, map_row, _), row in zip(links.tolist(), example.tolist(), strict=True)
        for o in range(int(start[point]), int(start[point + 1]))
        if (int(model.photo_of[o]), int(model.keypoint_of[o]), map_row) not in have
    ]
    seen, source = np.array(found, dtype=np.int64).reshape(-1, 2).T
    return replace(
        own.take(source),
        photo_of=model.photo_of[seen],
        feature=model.keypoint_of[seen],
        pixels=model.pixels(keypoints)[seen],
        model_point=model.point_of[seen],
        carried=np.ones(len(seen), dtype=np.bool_),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedSimilarity:
    """
    Attributes:
        covariance: (7, 7) of the similarity's left perturbation.
        spread: how many times its claimed sigma the typical residual is.
        neighbours_factor: how many times the variance of what neighbours say exceeds that of independent
            errors.
    """

    local_from_sfm: Sim3
    covariance: FloatArray
    spread: float
    neighbours_factor: float


def agreed_similarity(
    model: Model, own: Mapping[int, LocalisedPhoto], keypoints: Sequence[FloatArray], more: Sequence[Sim3]
) -> tuple[FittedSimilarity, set[int], Correspondences] | None:
    """The fit to the photos that agree with it, these, and the correspondences that do; or None.

    Args:
        own, keypoints: as in `find_correspondences`.
        more: similarities that are tried beside those that single photos propose.
    """
    correspondences = find_correspondences(model, own, keypoints)
    best = _best_proposal(model, own, correspondences, more)
    if best is None or not best[1]:
        return None
    sim, chosen = best
    near = np.isin(correspondences.photo_of, list(chosen)) | correspondences.carried
    for _ in range(5):  # the set of photos settles in two or three rounds
        if near.sum() < 4:
            return None
        fit = fit_similarity(model, sim, correspondences.take(near))
        sim, before = fit.local_from_sfm, chosen
        errors_px = correspondence_errors(model, sim, correspondences)
        chosen = agreeing_photos(errors_px, TOLERANCE_PX, correspondences) & own.keys()
        if not chosen:
            return None
        held = np.isin(correspondences.photo_of, list(chosen)) | correspondences.carried
        near = held & (errors_px < 2.0 * TOLERANCE_PX)
        if chosen == before:
            break
    return fit, chosen, correspondences.take(held & (errors_px < TOLERANCE_PX))


def _best_proposal(
    model: Model, own: Mapping[int, LocalisedPhoto], correspondences: Correspondences, more: Sequence[Sim3]
) -> tuple[Sim3, set[int]] | None:
    """The similarity with which most photos agree, then that of least truncated errors; and these photos."""
    sims = [*more, *(_by_pose(model, correspondences, k, photo) for k, photo in own.items())]
    rows = np.flatnonzero(~correspondences.carried)
    if len(rows) > _MOST_SCORED:
        rows = np.sort(np.random.default_rng(0).choice(rows, _MOST_SCORED, replace=False))
    scored = correspondences.take(rows)
    ranked = []
    for sim in sims:
        if sim is not None:
            errors_px = correspondence_errors(model, sim, scored)
            agree = agreeing_photos(errors_px, _LOOSE_PX, scored)
            cost = float((np.minimum(errors_px / _LOOSE_PX, 1.0) ** 2).sum())
            ranked.append((-len(agree), cost, sim, agree))
    return min(ranked, key=lambda item: item[:2])[2:] if ranked else None


def _by_pose(model: Model, correspondences: Correspondences, k: int, photo: LocalisedPhoto) -> Sim3 | None:
    """Scale by the median ratio of the distances of existing and new points of one feature."""
    held = ~correspondences.carried & (correspondences.model_point >= 0)
    mine = correspondences.take(held & (correspondences.photo_of == k))
    if len(mine) < 5:  # a median of fewer is one point's opinion
        return None
    ours, center = model.cam_from_sfm[k], photo.cam_from_local.center
    here = np.linalg.norm(mine.points - center, axis=1)
    there = np.linalg.norm(model.xyz[mine.model_point] - ours.center, axis=1)
    scale = float(np.median(here / np.maximum(there, 1e-12)))
    if scale <= 0:
        return None
    rotation = nearest_rotation(photo.cam_from_local.rotation.T @ ours.rotation)
    return Sim3(scale=scale, rotation=rotation, translation=center - scale * rotation @ ours.center)


def correspondence_errors(model: Model, sim: Sim3, correspondences: Correspondences) -> FloatArray:
    """(m,) distance from where the placed model sees the existing point, pixels at 1600; inf if it cannot."""
    there, errors_px = sim.inverse().act(correspondences.points), np.full(len(correspondences), np.inf)
    for k in np.unique(correspondences.photo_of):
        rows = np.flatnonzero(correspondences.photo_of == k)
        camera, pixels = model.cameras[int(model.camera_of[k])], correspondences.pixels[rows]
        errors = reprojection_errors(pixels, there[rows], camera, model.cam_from_sfm[k])
        errors_px[rows] = errors * 1600.0 / max(camera.width, camera.height)
    return errors_px


def agreeing_photos(errors_px: FloatArray, tolerance_px: float, correspondences: Correspondences) -> set[int]:
    """Model's photos of whose own correspondences half lies within the tolerance."""
    own = ~correspondences.carried
    count = int(correspondences.photo_of.max(initial=-1)) + 1
    total = np.bincount(correspondences.photo_of[own], minlength=count)
    near = np.bincount(correspondences.photo_of[own & (errors_px < tolerance_px)], minlength=count)
    return set(np.flatnonzero((total > 0) & (2 * near >= total)).tolist())


def fit_similarity(model: Model, start: Sim3, correspondences: Correspondences) -> FittedSimilarity:
    """Robust least squares over the pixels of the correspondences, Gauss-Newton on SIM(3).

    Geman-McClure weights at the residuals' robust spread. The covariance is the inverse of the normal
    equations times the squared spread times how far neighbours err alike. What nothing holds (the scale,
    where all photos stand at one place) stays as in `start`, and has standard deviations of `_OPEN`.
    """
    sim, covariance, spread, factor = start, np.eye(7), 1.0, 1.0
    for _ in range(_ROUNDS):
        residual, jacobian, information = _equations(model, sim, correspondences)
        squared = np.einsum("mi,mij,mj->m", residual, information, residual)
        spread = float(np.sqrt(max(np.median(squared) / _CHI2_2_MEDIAN, 1e-8)))
        weights = 1.0 / (1.0 + squared / (_CHI2_2_95 * spread**2)) ** 2
        weighted = weights[:, None, None] * (np.swapaxes(jacobian, 1, 2) @ information)
        normal = np.einsum("mai,mib->ab", weighted, jacobian)
        score = np.einsum("mai,mi->ma", weighted, residual)
        inverse = np.linalg.inv(normal + np.diag(1.0 / _OPEN**2))
        step = -inverse @ score.sum(axis=0)
        factor = neighbours_factor(score, inverse, correspondences)
        covariance = inverse * max(spread, 1.0) ** 2 * factor
        sim = Sim3.exp(step) @ sim
        if step @ normal @ step < 1e-6:  # a thousandth of a sigma
            break
    return FittedSimilarity(
        local_from_sfm=sim,
        covariance=np.asarray((covariance + covariance.T) / 2),
        spread=spread,
        neighbours_factor=factor,
    )


def _equations(
    model: Model, sim: Sim3, correspondences: Correspondences
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (m, 2) observed minus projected, their derivatives (m, 2, 7), inverse covariances (m, 2, 2).

    exp(xi) S moves the cameras by exp(xi), which is as if the points moved by exp(-xi).
    """
    linear = linearise(
        model.cameras,
        model.camera_of,
        [sim.act_on_pose(pose) for pose in model.cam_from_sfm],
        correspondences.points,
        np.arange(len(correspondences)),
        correspondences.photo_of,
        correspondences.pixels,
    )
    by_point = np.where(np.isfinite(linear.by_point), linear.by_point, 0.0)
    residual = np.where(np.isfinite(linear.residual), linear.residual, 1e6)
    sigma_px = KEYPOINT_PX * np.array([pixel_scale(camera) for camera in model.cameras])
    noise = sigma_px[model.camera_of[correspondences.photo_of], None, None] ** 2 * np.eye(2)
    noise = noise + by_point @ correspondences.covariance @ np.swapaxes(by_point, 1, 2)
    jacobian = by_point @ point_jacobian(correspondences.points)
    return residual, np.asarray(jacobian), np.asarray(np.linalg.inv(noise))


def neighbours_factor(score: FloatArray, inverse: FloatArray, correspondences: Correspondences) -> float:
    """Design effect on the similarity: variance of sums of scores over groups, over that of single ones.

    Groups are photos, which share the model's bending, and places (cells of the existing points, a quarter of
    their extent wide), which share that of the existing map. At least 1.

    Args:
        score: (m, 7) derivative of each correspondence's cost. inverse: (7, 7) of the normal matrix.
    """
    alone = float(np.einsum("ma,ab,mb->", score, inverse, score))
    if alone <= 0.0:
        return 1.0
    largest = 1.0
    low, high = np.quantile(correspondences.points, (0.02, 0.98), axis=0)
    side = max(float((high - low).max()) / 4.0, 1e-6)
    cells = np.floor((correspondences.points - low) / side).astype(np.int64)
    places = np.column_stack([cells, correspondences.map_of])
    for group in (correspondences.photo_of[:, None], places):
        number = np.unique(group, axis=0, return_inverse=True)[1].reshape(-1)
        count = int(number.max(initial=-1)) + 1
        if count < 2:
            continue
        sums = np.stack([np.bincount(number, weights=score[:, a], minlength=count) for a in range(7)], axis=1)
        # The fit makes the sums add up to nothing, which takes one group's share of the freedom.
        together = float(np.einsum("ga,ab,gb->", sums, inverse, sums)) * count / (count - 1)
        largest = max(largest, together / alone)
    return largest
