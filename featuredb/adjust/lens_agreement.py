"""How photos agree on a lens, and covariances of an estimate whose priors count more than they tell.

An adjustment lets priors of lenses and positions count `dilution` times, as what a lens model leaves over is
common to whole photos and makes any lens look certain. That is a choice of weights; how far its result may be
off follows from the residuals and from the priors as they are (White 1982; Liang and Zeger 1986, photos as
clusters).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.adjust.marginals import inverse_blocks
from featuredb.geometry.arrays import FloatArray

_LEAST_PHOTOS = 3  # that can disagree
# About that of `brighton`, the one real set looked at; `python -m tools.lens_widths` prints others.
_USUAL = 5.0
_SIZE = 8  # parameters of a whole lens
_USUAL_PHOTOS = 4.0  # so many photos weigh as much as what is usual: chosen, not measured


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weighted:
    """A linearised adjustment.

    Attributes:
        by_point, by_shared: (r, 3 n) and (r, q) CSR, Jacobian of whitened residuals by points, and by poses
            and lenses.
        residual: (r,) whitened.
        inverse: (q, q) of the normal matrix, without points.
        lenses: columns of each free lens among q; poses come before all of them.
    """

    by_point: Any
    by_shared: Any
    residual: FloatArray
    inverse: FloatArray
    lenses: Sequence[slice]


def lens_disagreement(problem: Weighted) -> FloatArray:
    """Variance of what all photos of a camera say of its lens together, over that of independent residuals.

    Lenses of few photos are taken to be as others are.

    Returns:
        Of each free lens.
    """
    squares, freedom = lens_squares(problem)
    known = np.isfinite(squares)
    weight = _USUAL_PHOTOS * _SIZE
    pooled = (weight * _USUAL + squares[known].sum()) / (weight + freedom[known].sum())
    return np.asarray(np.where(known, (weight * pooled + squares) / (weight + freedom), pooled))


def lens_squares(problem: Weighted) -> tuple[FloatArray, FloatArray]:
    """How far the photos of each free lens differ in what they say of it.

    Of the gradient by a lens, with points, poses and other lenses eliminated, each photo has a part; how far
    these parts differ is compared with how far they would if residuals were independent.

    Returns:
        Sums of squares, NaN for lenses of fewer than three photos, and their degrees of freedom: what
        independent residuals give.
    """
    by_point, by_shared = problem.by_point, problem.by_shared
    squares, freedom = np.full(len(problem.lenses), np.nan), np.zeros(len(problem.lenses))
    if not problem.lenses:
        return squares, freedom
    inverse = inverse_blocks((by_point.T @ by_point.tocsc()).tocoo(), by_point.shape[1] // 3)
    photo_of = _photo_of(by_shared[:, : problem.lenses[0].start])
    seen = np.diff(by_point.indptr) > 0
    for row, columns in enumerate(problem.lenses):
        rows = np.flatnonzero(np.diff(by_shared[:, columns].indptr))
        rows = rows[(photo_of[rows] >= 0) | seen[rows]]
        if len(np.unique(photo_of[rows])) < _LEAST_PHOTOS:
            continue
        moved = problem.inverse[:, columns] @ np.linalg.inv(problem.inverse[columns, columns])
        score = np.asarray(by_shared @ moved)
        score -= by_point @ (inverse @ (by_point.T @ score))
        squares[row], freedom[row] = _between(score[rows], problem.residual[rows], photo_of[rows])
    return squares, freedom


def diluted(
    inverse: FloatArray,
    of_priors: FloatArray,
    dilution: float,
    lenses: Sequence[slice],
    disagreement: FloatArray,
) -> FloatArray:
    """(q, q) covariance of an estimate whose priors counted `dilution` times.

    Args:
        inverse, lenses: as of `Weighted`.
        of_priors: (d, q) dense, rows of those priors, by poses and lenses.
        dilution: at least 1.
        disagreement: of each free lens, by `lens_disagreement`.
    """
    spread = inverse @ of_priors.T
    covariance = np.asarray(spread @ spread.T)  # sums in place: of 1,000 photos it has 300 MB
    covariance *= dilution - 1.0
    covariance += inverse
    if lenses:
        free = slice(lenses[0].start, len(inverse))
        told = np.linalg.inv(inverse[free, free]) - of_priors[:, free].T @ of_priors[:, free]
        root = np.repeat(np.sqrt(disagreement), [columns.stop - columns.start for columns in lenses])
        across, more = inverse[:, free], told * np.outer(root, root) - told
        for row in range(len(covariance)):
            covariance[row] += across @ (more @ across[row])
    return covariance


def _photo_of(by_pose: Any) -> NDArray[np.int64]:
    """(r,) the free pose of each row, -1 for none."""
    entries = by_pose.tocoo()
    result = np.full(by_pose.shape[0], -1, dtype=np.int64)
    result[entries.row] = entries.col // 6
    return result


def _between(score: FloatArray, residual: FloatArray, photo_of: NDArray[np.int64]) -> tuple[float, float]:
    """Squares of the photos' gradients over those of independent residuals, and what they would be.

    Args:
        score: (r, p) derivatives. residual: (r,). photo_of: (r,).
    """
    number = np.unique(photo_of, return_inverse=True)[1].reshape(-1)
    count, size = int(number.max()) + 1, score.shape[1]
    gradient = np.stack([np.bincount(number, score[:, i] * residual, count) for i in range(size)], axis=1)
    products = [
        np.bincount(number, score[:, i] * score[:, j], count) for i in range(size) for j in range(size)
    ]
    parts = np.stack(products, axis=1).reshape(count, size, size)
    inverse = np.linalg.inv(parts.sum(axis=0))
    shares = parts @ inverse
    freedom = np.trace(shares, axis1=1, axis2=2).sum() - np.einsum("kij,kji->", shares, shares)
    scale = count  # a sum over photos, each of about a share 1 / count of what is known
    return scale * float(np.einsum("ki,ij,kj->", gradient, inverse, gradient)), scale * float(freedom)
