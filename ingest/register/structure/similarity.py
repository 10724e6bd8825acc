"""Similarity between paired points: RANSAC, robust refinement on SIM(3), honest covariance.

Equation: scan_i = S map_i + e_i + J_i xi_f. The e_i belong to the pair (pixel, roughness of the surface, the
map point's own error); xi_f is the pose error of the frame that made the pair and is shared by all its pairs.
Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991;
structure-projection paper, 2.4 and eq. 7-9.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.geometry.similarity import similarity_closed_form

_CHI2_3_95 = 7.815  # 95 % of the squared Mahalanobis length of three normal coordinates
_CHI2_3_MEDIAN = 2.366
_SETTLED = 0.003  # standard deviations of a step; rounds that follow add up to a few times as much at most


_SAMPLES = 300  # of three pairs, at most. With half of the pairs wrong, these miss all-inlier samples
_MISSED = 1e-17  # so often; with fewer wrong pairs, fewer samples miss as rarely.
_SCORE_PAIRS = 800  # pairs that score a sample; more only take longer
_ROUNDS = 20  # of reweighting; the weights settle within ten
_SEED = 0  # of the samples


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """3D/3D pairs of a map and a scan, in the scan's local frame, metres.

    Attributes:
        frame_of: (n,) index of the registered frame.
        source: (n, 3) map point at its present place.
        target: (n, 3) where the frame sees it on the scan.
        covariance: (n, 3, 3) of the pair's own error, square metres.
        by_frame: (n, 3, 6) derivative of `target` by the left perturbation of the frame's pose.
        cell_of: (n,) neighbourhood of the pair; errors within one are correlated.
        frame_covariance: (f, 6, 6) of the frames' left perturbations.
    """

    frame_of: NDArray[np.int64]
    source: FloatArray
    target: FloatArray
    covariance: FloatArray
    by_frame: FloatArray
    cell_of: NDArray[np.int64]
    frame_covariance: FloatArray

    def __len__(self) -> int:
        return len(self.source)

    def of(self, rows: NDArray[np.bool_]) -> "Pairs":
        """Some of the pairs, of the same frames."""
        per_pair = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "frame_covariance"}
        return replace(self, **per_pair)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimilarityFit:
    """A robust similarity.

    Attributes:
        target_from_source: the similarity.
        covariance: (7, 7) of its left perturbation.
        inliers: (n,) bool.
        residuals_m: (n, 3) target, moved by its frame's correction, minus placed source.
        frame_corrections: (f, 6) left perturbations of the frames' poses that were estimated along.
        spread: how many times its claimed sigma the typical residual is.
        neighbours_factor: how many times larger the variance of cell means is than independence predicts.
    """

    target_from_source: Sim3
    covariance: FloatArray
    inliers: NDArray[np.bool_]
    residuals_m: FloatArray
    frame_corrections: FloatArray
    spread: float
    neighbours_factor: float


def ransac_similarity(source: FloatArray, target: FloatArray, tolerance: FloatArray) -> Sim3 | None:
    """The similarity of three pairs with the smallest truncated sum of squared distances, or None.

    Args:
        source, target: (n, 3). tolerance: (n,) distance beyond which a pair does not count.
    """
    n = len(source)
    if n < 3:
        return None
    generator = np.random.default_rng(_SEED)
    samples = generator.integers(0, n, (_SAMPLES, 3))
    rows = np.arange(n) if n <= _SCORE_PAIRS else generator.choice(n, _SCORE_PAIRS, replace=False)
    best: tuple[float, Sim3] | None = None
    for number, sample in enumerate(samples, start=1):
        sim = similarity_closed_form(source[sample], target[sample])
        if sim is None:
            continue
        squared = ((sim.act(source[rows]) - target[rows]) ** 2).sum(axis=1)
        cost = float(np.minimum(squared / tolerance[rows] ** 2, 1.0).sum())
        if best is None or cost < best[0]:
            best = (cost, sim)
        right = 1.0 - best[0] / len(rows)
        if number * np.log1p(-min(right**3, 1.0 - 1e-12)) < np.log(_MISSED):
            break
    return None if best is None else best[1]


def refine_similarity(start: Sim3, pairs: Pairs) -> SimilarityFit:
    """Robust least squares over the similarity (exp on the left) and, with their priors, the frames' poses.

    The frames' pose errors are estimated along with the similarity: pairs of one frame then count for no
    more than its pose allows, and the inverse of the normal equations is an honest covariance. Pairs carry
    Geman-McClure weights at their robust spread; how far neighbours err alike dilutes them all.
    """
    root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(pairs.covariance)), 1, 2)
    sim, frames = start, np.zeros((len(pairs.frame_covariance), 6))
    dilution = 1.0
    for _ in range(2):  # the dilution is known after the first
        for _ in range(_ROUNDS):
            residual = _whiten(root, _residuals(sim, frames, pairs))
            weights, spread = _weights(residual)
            normal, gradient = _equations(sim, frames, residual, pairs, root, weights / dilution)
            step = np.linalg.solve(normal, gradient)
            sim = Sim3.exp(step[:7]) @ sim
            frames = frames + step[7:].reshape(-1, 6)
            if step @ normal @ step < _SETTLED**2:
                break
        factor = _neighbours_factor(residual, weights, pairs, spread)
        dilution = max(spread, 1.0) ** 2 * factor
    normal, _ = _equations(sim, frames, residual, pairs, root, weights / dilution)
    covariance = np.linalg.inv(normal)[:7, :7]
    residual = _residuals(sim, frames, pairs)
    squared = (_whiten(root, residual) ** 2).sum(axis=1)
    return SimilarityFit(
        target_from_source=sim,
        covariance=np.asarray((covariance + covariance.T) / 2),
        inliers=squared <= 2 * _CHI2_3_95 * spread**2,  # 99.9 % of honest pairs
        residuals_m=residual,
        frame_corrections=frames,
        spread=spread,
        neighbours_factor=factor,
    )


def _residuals(sim: Sim3, frames: FloatArray, pairs: Pairs) -> FloatArray:
    """(n, 3) target, moved by its frame's correction, minus placed source."""
    moved = np.einsum("nij,nj->ni", pairs.by_frame, frames[pairs.frame_of])
    return np.asarray(pairs.target + moved - sim.act(pairs.source))


def _weights(whitened: FloatArray) -> tuple[FloatArray, float]:
    """Weights (n,) of whitened residuals (n, 3), and their spread."""
    squared = (whitened**2).sum(axis=1)
    spread = float(np.sqrt(max(np.median(squared) / _CHI2_3_MEDIAN, 1e-12)))
    return 1.0 / (1.0 + squared / (_CHI2_3_95 * spread**2)) ** 2, spread


def _whiten(root: FloatArray, residual: FloatArray) -> FloatArray:
    return np.asarray((root @ residual[:, :, None])[:, :, 0])


def _equations(
    sim: Sim3, frames: FloatArray, residual: FloatArray, pairs: Pairs, root: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix and gradient over (similarity, frame 0, frame 1, ...), (7 + 6 f).

    Args:
        residual: (n, 3) whitened. root: (n, 3, 3) that whitens.
    """
    size = 7 + 6 * len(frames)
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    by_both = np.concatenate([point_jacobian(sim.act(pairs.source)), -pairs.by_frame], axis=2)
    weight = np.sqrt(weights)[:, None]
    design, wanted = root @ by_both * weight[:, :, None], residual * weight
    for frame, prior in enumerate(pairs.frame_covariance):
        own = pairs.frame_of == frame
        rows = design[own].reshape(-1, 13)
        at = np.r_[0:7, 7 + 6 * frame : 13 + 6 * frame]
        normal[np.ix_(at, at)] += rows.T @ rows
        gradient[at] += rows.T @ wanted[own].ravel()
        knowledge = np.linalg.inv(prior)
        normal[np.ix_(at[7:], at[7:])] += knowledge
        gradient[at[7:]] -= knowledge @ frames[frame]
    return normal, gradient


def _neighbours_factor(residual: FloatArray, weights: FloatArray, pairs: Pairs, spread: float) -> float:
    """Design effect: variance of weighted sums over cells, over that of independent errors; at least 1.

    Args:
        residual: (n, 3) whitened.
    """
    cell = np.unique(pairs.cell_of, return_inverse=True)[1]
    whitened = np.sqrt(weights)[:, None] * residual / spread
    sums = np.stack([np.bincount(cell, weights=whitened[:, k]) for k in range(3)], axis=1)
    expected = float((whitened**2).sum())
    cells = len(sums)
    if cells < 2 or expected <= 0:
        return 1.0
    # The fit takes seven of the cells' degrees of freedom.
    freedom = max(1.0 - 7.0 / (3.0 * cells), 0.2)
    return max(1.0, float((sums**2).sum()) / expected / freedom)
