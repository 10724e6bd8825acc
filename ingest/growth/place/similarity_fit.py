"""The similarity that places a reconstruction by existing maps: hypotheses by photo, then a weighted fit.

What holds a new reconstruction are the pixels in which its photos see existing points. A photo's localised
pose is made of them, and so are pairs of a new and an existing point: to add those as measurements of their
own would count the same pixels twice. Poses and point pairs therefore propose similarities and judge them;
the fit itself is over the pixels,

    pixel_k = project(camera, cam_from_sfm S^-1 point_k) + noise,    S = local_from_sfm,

with noise of the pixel, of the existing point, and with what neighbours have in common.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import nearest_rotation, skew
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.colmap.bridge import Model
from ingest.colmap.precision import linearise
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.values import LocalisedPhoto

_CHI2_2_MEDIAN = 1.386  # of the squared length of two normal coordinates
_CHI2_2_95 = 5.991
_OPEN = np.array([10.0] * 4 + [1e4] * 3)  # log scale, radians, metres: what nothing holds; gates refuse it


@dataclass(frozen=True, slots=True, kw_only=True)
class SimilarityFitOptions:
    """How the similarity is found.

    Attributes:
        pair_samples: pairs of photos that propose a similarity by their centres, beside one proposal from
            each photo; 300 hold a pair of right ones with a third of the photos right, 30 times over.
        max_scored: correspondences that judge a proposal; more only take longer.
        loose_rel: tolerance of a proposal as a share of the image's longer side (16 pixels at 1600): it
            rests on one or two photos, whose errors it carries far. What is of another place is hundreds of
            pixels off.
        tolerance_rel: the same for the fitted similarity (8 pixels at 1600): twice the inlier tolerance of
            a pose, since reconstructions of few photos are bent.
        least_share: a photo agrees if at least this share of its own correspondences is within the tolerance.
        rounds: of reweighting; weights settle within ten.
        seed: of the samples.
    """

    pair_samples: int = 300
    max_scored: int = 3000
    loose_rel: float = 0.01
    tolerance_rel: float = 0.005
    least_share: float = 0.5
    rounds: int = 20
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedSimilarity:
    """A fitted similarity.

    Attributes:
        local_from_sfm: the similarity. covariance: (7, 7) of its left perturbation.
        errors_px: (m,) distances of all pixels from where the placed model sees their points.
        weights: (m,) of the last round; 0 for correspondences that took no part.
        spread: how many times its claimed sigma the typical residual is.
        neighbours_factor: how many times the variance of what neighbours say exceeds that of independent
            errors; the larger of that by photo and that by place.
    """

    local_from_sfm: Sim3
    covariance: FloatArray
    errors_px: FloatArray
    weights: FloatArray
    spread: float
    neighbours_factor: float


def proposals(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    correspondences: Correspondences,
    options: SimilarityFitOptions,
) -> list[Sim3]:
    """Similarities that single photos (pose and depth of shared points) and pairs of photos propose."""
    at = {k: localised[int(r)] for k, r in enumerate(model.rows.tolist()) if int(r) in localised}
    found: list[Sim3] = []
    for k, photo in at.items():
        scale = _scale_by_depth(model, correspondences, k, photo)
        if scale is not None:
            found.append(_by_pose(model, k, photo, scale))
    photos = list(at)
    for i, j in _photo_pairs(len(photos), options):
        a, b = photos[i], photos[j]
        sim = _by_centres(model, (a, b), (at[a], at[b]))
        if sim is not None:
            found.append(sim)
    return found


def _photo_pairs(count: int, options: SimilarityFitOptions) -> list[tuple[int, int]]:
    every = [(i, j) for i in range(count) for j in range(i + 1, count)]
    if len(every) <= options.pair_samples:
        return every
    chosen = np.random.default_rng(options.seed).choice(len(every), options.pair_samples, replace=False)
    return [every[int(c)] for c in np.sort(chosen)]


def _by_pose(model: Model, k: int, photo: LocalisedPhoto, scale: float) -> Sim3:
    rotation = nearest_rotation(photo.cam_from_local.rotation.T @ model.cam_from_sfm[k].rotation)
    center = photo.cam_from_local.center
    return Sim3(
        scale=scale,
        rotation=rotation,
        translation=center - scale * rotation @ model.cam_from_sfm[k].center,
    )


def _scale_by_depth(
    model: Model, correspondences: Correspondences, k: int, photo: LocalisedPhoto
) -> float | None:
    """Median ratio of the distances from the camera of existing and of new points of the same features."""
    rows = np.flatnonzero(
        (correspondences.photo_of == k) & ~correspondences.carried & (correspondences.model_point >= 0)
    )
    if len(rows) < 5:  # a median of fewer is one point's opinion
        return None
    here = np.linalg.norm(correspondences.points[rows] - photo.cam_from_local.center, axis=1)
    there = np.linalg.norm(
        model.xyz[correspondences.model_point[rows]] - model.cam_from_sfm[k].center, axis=1
    )
    ratio = float(np.median(here / np.maximum(there, 1e-12)))
    return ratio if ratio > 0 else None


def _by_centres(
    model: Model, photos: tuple[int, int], poses: tuple[LocalisedPhoto, LocalisedPhoto]
) -> Sim3 | None:
    """Scale by the baseline of two photos, rotation by the mean of theirs."""
    ours = [model.cam_from_sfm[k] for k in photos]
    theirs = [p.cam_from_local for p in poses]
    base_sfm = float(np.linalg.norm(ours[1].center - ours[0].center))
    base = float(np.linalg.norm(theirs[1].center - theirs[0].center))
    sigma = float(np.sqrt(sum(np.linalg.eigvalsh(p.covariance[3:, 3:])[-1] for p in poses)))
    if base_sfm <= 0 or base < 5.0 * sigma:  # a scale to 20 %; what is shorter says nothing
        return None
    turns = [t.rotation.T @ o.rotation for t, o in zip(theirs, ours, strict=True)]
    rotation = nearest_rotation(turns[0] + turns[1])
    middle_sfm = 0.5 * (ours[0].center + ours[1].center)
    middle = 0.5 * (theirs[0].center + theirs[1].center)
    scale = base / base_sfm
    return Sim3(scale=scale, rotation=rotation, translation=middle - scale * rotation @ middle_sfm)


def correspondence_errors(model: Model, sim: Sim3, correspondences: Correspondences) -> FloatArray:
    """(m,) distance in pixels from where the placed model sees the existing point; inf if it cannot."""
    into_sfm = sim.inverse()
    errors = np.full(len(correspondences), np.inf)
    for k in np.unique(correspondences.photo_of):
        rows = np.flatnonzero(correspondences.photo_of == k)
        camera = model.cameras[int(model.camera_of[k])]
        pixels = camera.project(model.cam_from_sfm[k].act(into_sfm.act(correspondences.points[rows])))
        errors[rows] = np.linalg.norm(pixels - correspondences.pixels[rows], axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)


def tolerances_px(model: Model, correspondences: Correspondences, share: float) -> FloatArray:
    """(m,) that share of the longer side of each correspondence's photo."""
    sides = np.array([max(c.width, c.height) for c in model.cameras], dtype=np.float64)
    return np.asarray(share * sides[model.camera_of[correspondences.photo_of]])


def agreeing_photos(
    errors_px: FloatArray, tolerance_px: FloatArray, correspondences: Correspondences, least_share: float
) -> NDArray[np.int64]:
    """Model's photos of whose own correspondences at least that share lies within the tolerance."""
    own = ~correspondences.carried
    count = int(correspondences.photo_of.max(initial=-1)) + 1
    total = np.bincount(correspondences.photo_of[own], minlength=count)
    near = np.bincount(correspondences.photo_of[own & (errors_px < tolerance_px)], minlength=count)
    return np.flatnonzero((total > 0) & (near >= least_share * total))


def rank_proposals(
    model: Model, sims: Sequence[Sim3], correspondences: Correspondences, options: SimilarityFitOptions
) -> list[tuple[Sim3, NDArray[np.int64]]]:
    """Proposals with the photos that agree, most photos first, then by truncated squared errors."""
    scored = _thinned(correspondences, options)
    tolerance = tolerances_px(model, scored, options.loose_rel)
    ranked = []
    for sim in sims:
        errors = correspondence_errors(model, sim, scored)
        agree = agreeing_photos(errors, tolerance, scored, options.least_share)
        cost = float(np.minimum(errors / tolerance, 1.0).__pow__(2).sum())
        ranked.append((sim, agree, cost))
    ranked.sort(key=lambda item: (-len(item[1]), item[2]))
    return [(sim, agree) for sim, agree, _ in ranked]


def _thinned(correspondences: Correspondences, options: SimilarityFitOptions) -> Correspondences:
    """Own correspondences, at most so many, of each photo the same share."""
    own = np.flatnonzero(~correspondences.carried)
    if len(own) <= options.max_scored:
        return correspondences.take(own)
    chosen = np.random.default_rng(options.seed).choice(len(own), options.max_scored, replace=False)
    return correspondences.take(own[np.sort(chosen)])


def fit_similarity(
    model: Model,
    start: Sim3,
    correspondences: Correspondences,
    use: NDArray[np.bool_],
    options: SimilarityFitOptions,
) -> FittedSimilarity:
    """Robust least squares over the pixels of the correspondences in `use` (m,), Gauss-Newton on SIM(3).

    Geman-McClure weights at the residuals' robust spread. The covariance is the inverse of the normal
    equations times the squared spread times how far neighbours err alike: photos share the model's bending,
    places the existing map's. What nothing holds (the scale, where all photos stand at one place) stays as
    `start` has it, and has standard deviations of `_OPEN`.
    """
    chosen = correspondences.take(np.flatnonzero(use))
    sim, covariance = start, np.eye(7)
    weights, spread, factor = np.ones(len(chosen)), 1.0, 1.0
    for _ in range(options.rounds):
        residual, jacobian, information = _equations(model, sim, chosen)
        squared = np.einsum("mi,mij,mj->m", residual, information, residual)
        spread = float(np.sqrt(max(np.median(squared) / _CHI2_2_MEDIAN, 1e-8)))
        weights = 1.0 / (1.0 + squared / (_CHI2_2_95 * spread**2)) ** 2
        weighted = weights[:, None, None] * (np.swapaxes(jacobian, 1, 2) @ information)
        normal = np.einsum("mai,mib->ab", weighted, jacobian)
        score = np.einsum("mai,mi->ma", weighted, residual)
        inverse = np.linalg.inv(normal + np.diag(1.0 / _OPEN**2))
        step = -inverse @ score.sum(axis=0)
        factor = neighbours_factor(score, inverse, chosen)
        covariance = inverse * (max(spread, 1.0) ** 2 if spread > 0 else 1.0) * factor
        sim = Sim3.exp(step) @ sim
        if step @ normal @ step < 1e-6:  # a thousandth of a sigma
            break
    every = np.zeros(len(correspondences))
    every[np.flatnonzero(use)] = weights
    return FittedSimilarity(
        local_from_sfm=sim,
        covariance=np.asarray((covariance + covariance.T) / 2),
        errors_px=correspondence_errors(model, sim, correspondences),
        weights=every,
        spread=spread,
        neighbours_factor=factor,
    )


def _equations(
    model: Model, sim: Sim3, correspondences: Correspondences
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (m, 2) observed minus projected, their derivatives (m, 2, 7), inverse covariances (m, 2, 2).

    exp(xi) S moves the cameras by exp(xi), which is as if the points moved by exp(-xi).
    """
    poses = [sim.act_on_pose(pose) for pose in model.cam_from_sfm]
    m = len(correspondences)
    linear = linearise(
        model.cameras,
        model.camera_of,
        poses,
        correspondences.points,
        np.arange(m),
        correspondences.photo_of,
        correspondences.pixels,
    )
    by_point = np.where(np.isfinite(linear.by_point), linear.by_point, 0.0)
    residual = np.where(np.isfinite(linear.residual), linear.residual, 1e6)
    # A SIFT keypoint is good to about half a pixel of the image of 1600 that it was found on.
    sigma = 0.5 * np.maximum(1.0, tolerances_px(model, correspondences, 1.0) / 1600.0)
    noise = sigma[:, None, None] ** 2 * np.eye(2) + by_point @ correspondences.covariance @ np.swapaxes(
        by_point, 1, 2
    )
    jacobian = by_point @ point_jacobian(correspondences.points)
    return residual, np.asarray(jacobian), np.asarray(np.linalg.inv(noise))


def neighbours_factor(score: FloatArray, inverse: FloatArray, correspondences: Correspondences) -> float:
    """Design effect on the similarity: variance of sums of scores over groups, over that of single ones.

    Groups are photos, and places: cells of the existing points, a quarter of their extent wide. At least 1.

    Args:
        score: (m, 7) derivative of each correspondence's cost. inverse: (7, 7) of the normal matrix.
    """
    alone = float(np.einsum("ma,ab,mb->", score, inverse, score))
    if alone <= 0.0:
        return 1.0
    largest = 1.0
    for group in (correspondences.photo_of, _cells(correspondences)):
        number = np.unique(group, return_inverse=True)[1].reshape(-1)
        count = int(number.max(initial=-1)) + 1
        if count < 2:
            continue
        sums = np.stack([np.bincount(number, weights=score[:, a], minlength=count) for a in range(7)], axis=1)
        # The fit makes the sums add up to nothing, which takes one group's share of the freedom.
        together = float(np.einsum("ga,ab,gb->", sums, inverse, sums)) * count / (count - 1)
        largest = max(largest, together / alone)
    return largest


def _cells(correspondences: Correspondences) -> NDArray[np.int64]:
    """Number of the cell (a quarter of the extent wide) and map of each correspondence's point."""
    low, high = np.quantile(correspondences.points, (0.02, 0.98), axis=0)
    side = max(float((high - low).max()) / 4.0, 1e-6)
    cells = np.floor((correspondences.points - low) / side).astype(np.int64)
    both = np.concatenate([cells, correspondences.map_of[:, None]], axis=1)
    return np.unique(both, axis=0, return_inverse=True)[1].reshape(-1)


_SHORT = 1.0  # entries of the adjoint below which the series has converged after a dozen terms


def small_adjoint(tangent: FloatArray) -> FloatArray:
    """(7, 7) matrix of the Lie bracket with (sigma, omega, nu), the derivative of Sim3.adjoint."""
    sigma, omega, nu = float(tangent[0]), tangent[1:4], tangent[4:]
    ad = np.zeros((7, 7))
    ad[1:4, 1:4] = skew(omega)
    ad[4:, 0] = -nu
    ad[4:, 1:4] = skew(nu)
    ad[4:, 4:] = sigma * np.eye(3) + skew(omega)
    return ad


def left_jacobian(tangent: FloatArray) -> FloatArray:
    """J (7, 7) with exp(x + dx) = exp(J dx) exp(x) to first order.

    The integral of exp(t ad) over t in [0, 1]: its series where that is short, else the corner of one matrix
    exponential (Van Loan 1978).
    """
    ad = small_adjoint(np.asarray(tangent, dtype=np.float64))
    size = float(np.abs(ad).max())
    if size < _SHORT:
        total = term = np.eye(7)
        for k in range(2, 30):
            term = term @ ad / k
            total = total + term
            if np.abs(term).max() < 1e-17 * max(1.0, size):
                break
        return total
    both = np.zeros((14, 14))
    both[:7, :7] = ad
    both[:7, 7:] = np.eye(7)
    return np.asarray(expm(both)[:7, 7:], dtype=np.float64)
