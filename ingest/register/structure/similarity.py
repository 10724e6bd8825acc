"""Similarity between paired points: RANSAC, robust refinement on SIM(3), honest covariance.

Equation: scan_i = S map_i + e_i + J_i xi_f. The e_i belong to the pair (pixel, roughness of the surface, the
map point's own error); xi_f is the pose error of the frame that made the pair and is shared by all its pairs.
Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991;
structure-projection paper, 2.4 and eq. 7-9.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian, similarity_closed_form

_CHI2_3_95 = 7.815  # 95 % of the squared Mahalanobis length of three normal coordinates
_CHI2_3_MEDIAN = 2.366
_SETTLED = 0.003  # standard deviations of a step; rounds that follow add up to a few times as much at most

_SAMPLES = 300  # of three pairs, at most. With half of the pairs wrong, these miss all-inlier samples
_MISSED = 1e-17  # so often; with fewer wrong pairs, fewer samples miss as rarely.
_SCORE_PAIRS = 800  # pairs that score a sample; more only take longer

_ROUNDS = 100  # of reweighting: ten are usual, sixty where a wrong lens bends the map
# Steps of reweighting fall short, most where pairs say little; up to twice as far they still go downhill.
_STRIDE = 1.4
_SEED = 0  # of the samples


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """3D/3D pairs of a map and a scan, in the scan's local frame, metres.

    Attributes:
        frame_of: (n,) index of the registered frame, ascending.
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
        neighbours_factor: how many times larger the variance of cell means is than independence predicts.
    """

    target_from_source: Sim3
    covariance: FloatArray
    inliers: NDArray[np.bool_]
    residuals_m: FloatArray
    neighbours_factor: float


def ransac_similarity(source: FloatArray, target: FloatArray, tolerance: FloatArray) -> Sim3 | None:
    """The similarity of three pairs with the smallest truncated sum of squared distances, or None.

    Args:
        source, target: (n, 3). tolerance: (n,) distance beyond which a pair does not count.
    """
    n, generator = len(source), np.random.default_rng(_SEED)
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
    cell = np.unique(pairs.cell_of, return_inverse=True)[1]
    prior = block_diag(np.zeros((7, 7)), *np.linalg.inv(pairs.frame_covariance))  # of the frames' poses
    sim = start
    solution: FloatArray = np.zeros(len(prior))
    for _ in range(2):  # linear about the start, then about what that came to
        lines = _linearised(sim, pairs, root)
        solution[:7] = 0.0
        for _ in range(_ROUNDS):
            residual = _residuals(lines, solution)
            weights, spread = _weights(residual)
            factor = _neighbours_factor(residual, weights, cell, spread)
            normal, wanted = _equations(lines, weights / (max(spread, 1.0) ** 2 * factor))
            normal += prior
            solved = np.asarray(np.linalg.solve(normal, wanted), dtype=np.float64)
            step = solved - solution
            if step @ normal @ step < _SETTLED**2:
                break
            solution = solution + _STRIDE * step
        solution = solved
        sim = Sim3.exp(solution[:7]) @ sim
    covariance = np.linalg.inv(normal)[:7, :7]
    moved = np.einsum("nij,nj->ni", pairs.by_frame, solution[7:].reshape(-1, 6)[pairs.frame_of])
    residual = pairs.target + moved - sim.act(pairs.source)
    squared = ((root @ residual[:, :, None]) ** 2).sum(axis=(1, 2))
    return SimilarityFit(
        target_from_source=sim,
        covariance=np.asarray((covariance + covariance.T) / 2),
        inliers=squared <= 2 * _CHI2_3_95 * spread**2,  # 99.9 % of honest pairs
        residuals_m=residual,
        neighbours_factor=factor,
    )


def _linearised(sim: Sim3, pairs: Pairs, root: FloatArray) -> list[FloatArray]:
    """(14, 3 m) of each frame's m pairs, whitened by `root` (n, 3, 3): derivatives, what they are to explain.

    Derivatives of placed source minus moved target, by the similarity (7) and by the frame (6); then target
    minus placed source.
    """
    placed = sim.act(pairs.source)
    columns = [point_jacobian(placed), -pairs.by_frame, (pairs.target - placed)[:, :, None]]
    whitened = root @ np.concatenate(columns, axis=2)
    frames = range(len(pairs.frame_covariance))
    return [np.ascontiguousarray(whitened[pairs.frame_of == f].reshape(-1, 14).T) for f in frames]


def _residuals(lines: list[FloatArray], solution: FloatArray) -> FloatArray:
    """(n, 3) whitened, target, moved by its frame's correction, minus placed source."""
    parts = []
    for frame, of in enumerate(lines):
        own = np.concatenate([solution[:7], solution[7 + 6 * frame : 13 + 6 * frame]])
        parts.append(of[13] - own @ of[:13])
    return np.concatenate(parts).reshape(-1, 3)


def _weights(whitened: FloatArray) -> tuple[FloatArray, float]:
    """Weights (n,) of whitened residuals (n, 3), and their spread."""
    squared = (whitened**2).sum(axis=1)
    spread = float(np.sqrt(max(np.median(squared) / _CHI2_3_MEDIAN, 1e-12)))
    return 1.0 / (1.0 + squared / (_CHI2_3_95 * spread**2)) ** 2, spread


def _equations(lines: list[FloatArray], weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal matrix and right side over (similarity, frame 0, frame 1, ...), (7 + 6 f), of the pairs."""
    size = 7 + 6 * len(lines)
    normal, wanted = np.zeros((size, size)), np.zeros(size)
    root = np.repeat(np.sqrt(weights), 3)
    first = 0
    for frame, of in enumerate(lines):
        rows = of * root[first : first + of.shape[1]]
        product = rows @ rows.T
        first += of.shape[1]
        shared, own = slice(0, 7), slice(7 + 6 * frame, 13 + 6 * frame)
        normal[shared, shared] += product[:7, :7]
        normal[shared, own] = product[:7, 7:13]
        normal[own, shared] = product[7:13, :7]
        normal[own, own] = product[7:13, 7:13]
        wanted[shared] += product[:7, 13]
        wanted[own] = product[7:13, 13]
    return normal, wanted


def _neighbours_factor(
    residual: FloatArray, weights: FloatArray, cell: NDArray[np.int64], spread: float
) -> float:
    """Design effect: variance of weighted sums over cells, over that of independent errors; at least 1.

    Args:
        residual: (n, 3) whitened. cell: (n,) of each, numbered from 0 without gaps.
    """
    whitened = np.sqrt(weights)[:, None] * residual / spread
    sums = np.stack([np.bincount(cell, weights=whitened[:, k]) for k in range(3)], axis=1)
    expected = float((whitened**2).sum())
    cells = len(sums)
    if cells < 2 or expected <= 0:
        return 1.0
    # The fit takes seven of the cells' degrees of freedom.
    freedom = max(1.0 - 7.0 / (3.0 * cells), 0.2)
    return max(1.0, float((sums**2).sum()) / expected / freedom)
