"""Marginal covariances of an adjustment: points eliminated, everything shared kept together.

Triggs et al., Bundle adjustment: a modern synthesis, 2000, sections 6 and 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotri

from featuredb.adjust.terms import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew

_DAMPING = 1e-12  # relative; of directions that nothing determines
_ROWS_AT_ONCE = 60_000  # of a Jacobian, or coordinates of points: products of more need memory
_CONTROLLED = 1e-3  # least redundancy of a direction in which a residual says something of its observation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marginals:
    """Covariances of poses and lenses with each other.

    Attributes:
        shared: (q, q) of the free poses, six each: left perturbation (omega, nu) of cam_from_block, rad and
            units of the block; then of the free lenses' parameters.
        pose_start, lens_start: first column of each photo and camera, -1 where it is held.
        lens_size: parameters of each camera.
    """

    shared: FloatArray
    pose_start: NDArray[np.int64]
    lens_start: NDArray[np.int64]
    lens_size: tuple[int, ...]

    def pose(self, photo: int) -> FloatArray:
        """(6, 6) of a photo's pose; zero where it is held."""
        return self._part(int(self.pose_start[photo]), 6)

    def poses(self, lens_dilution: float = 1.0) -> FloatArray:
        """(k, 6, 6) of all poses; zero where they are held.

        Args:
            lens_dilution: so much less than their number says do the observations tell of lenses: what comes
                from lenses grows by it.
        """
        by_lens = self.by_lenses()
        result = np.zeros((len(self.pose_start), 6, 6))
        for photo, start in enumerate(self.pose_start.tolist()):
            if start >= 0:
                rows = slice(start, start + 6)
                result[photo] = self.shared[rows, rows] + (lens_dilution - 1.0) * by_lens[rows, rows]
        return result

    def by_lenses(self) -> FloatArray:
        """(q, q) the part of `shared` that would be gone if the lenses were exact."""
        first = 6 * int((self.pose_start >= 0).sum())
        across, lenses = self.shared[:, first:], self.shared[first:, first:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(lenses), 1e-300))
        factor = lenses * scale[:, None] * scale + _DAMPING * np.eye(len(scale))
        return np.asarray((across * scale) @ np.linalg.solve(factor, (across * scale).T))

    def lens(self, camera: int) -> FloatArray:
        """(p, p) of a camera's parameters; zero where they are held."""
        return self._part(int(self.lens_start[camera]), self.lens_size[camera])

    def _part(self, start: int, size: int) -> FloatArray:
        if start < 0:
            return np.zeros((size, size))
        return self.shared[start : start + size, start : start + size]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whitened:
    """Residuals of c observations of d coordinates over their standard deviations, and what they may be.

    Baarda, A testing procedure for use in geodetic networks, 1968: a residual is smaller than its
    observation's error where few others control it. The trace of `covariance` is its share of the redundancy.

    Attributes:
        residual: (c, d) adjusted minus observed.
        together: (c d, c d) covariance of all; the unit matrix less what the adjusted unknowns take up.
    """

    residual: FloatArray
    together: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """(c, d, d) of each."""
        count, axes = self.residual.shape
        blocks = self.together.reshape(count, axes, count, axes)
        return np.asarray(blocks[np.arange(count), :, np.arange(count)])

    def of(self, used: NDArray[np.bool_]) -> "Whitened":
        """The used coordinates (c, d), each as an observation of its own."""
        rows = np.flatnonzero(used)
        return Whitened(
            residual=self.residual.reshape(-1, 1)[rows], together=self.together[np.ix_(rows, rows)]
        )

    def left_out(self, rows: NDArray[np.int64]) -> tuple[FloatArray, "Whitened"]:
        """Of observations of one coordinate: some had they taken no part, and then the others."""
        others = np.setdiff1d(np.arange(len(self.residual)), rows)
        share, axes = np.linalg.eigh(self.together[np.ix_(rows, rows)])
        inverse = np.where(share > _CONTROLLED, 1.0 / np.maximum(share, _CONTROLLED), 0.0)
        alone = axes @ (inverse * (axes.T @ self.residual[rows, 0]))
        across = self.together[np.ix_(others, rows)]
        return alone, Whitened(
            residual=self.residual[others] - (across @ alone)[:, None],
            together=self.together[np.ix_(others, others)] - (across @ axes * inverse) @ (across @ axes).T,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetMarginals:
    """An adjustment's covariances where it has targets.

    Attributes:
        block: of poses and lenses.
        points: (t,) the block's rows of the targets. point: (t, 3, 3) their covariances.
        marks, survey: residuals, in the order of `featuredb.adjust.terms.Targets`.
    """

    block: Marginals
    points: NDArray[np.int64]
    point: FloatArray
    marks: Whitened
    survey: Whitened


def target_marginals(
    covariance: FloatArray,
    own: Any,
    residual: FloatArray,
    targets: NDArray[np.int64],
    marks: int,
    free: tuple[Sequence[int], Sequence[int]],
    block: Block,
) -> TargetMarginals:
    """Of the covariance (q, q) of targets, poses and lenses.

    Args:
        own: Jacobian of the targets' whitened residuals, marks before surveyed points, by the same.
        residual: (r,) the targets' residuals, whitened.
        targets: (t,) rows of the block's points. marks: how many.
        free: photos and cameras that are not held.
    """
    size = 3 * len(targets)
    spread = own @ covariance

    def whitened(first: int, last: int, axes: int) -> Whitened:
        """Rows of observations of so many axes."""
        return Whitened(
            residual=residual[first:last].reshape(-1, axes),
            together=np.eye(last - first) - (own[first:last] @ spread[first:last].T),
        )

    return TargetMarginals(
        block=marginals(covariance[size:, size:], *free, block),
        points=targets,
        point=np.array([covariance[i : i + 3, i : i + 3] for i in range(0, size, 3)]),
        marks=whitened(0, 2 * marks, 2),
        survey=whitened(2 * marks, len(residual), 3),
    )


def inverse_without_points(by_point: Any, by_shared: Any) -> FloatArray:
    """(q, q) covariance of what points share, which are eliminated: from the Jacobian's two parts, CSR."""
    normal = np.zeros((by_shared.shape[1], by_shared.shape[1]), order="F")
    for first in range(0, by_shared.shape[0], _ROWS_AT_ONCE):
        part = by_shared[first : first + _ROWS_AT_ONCE]
        normal += (part.T.tocsr() @ part).toarray()
    of_points = by_point.tocsc()
    for first in range(0, of_points.shape[1], _ROWS_AT_ONCE):
        part = of_points[:, first : first + _ROWS_AT_ONCE]
        across = part.T @ by_shared
        inverse = inverse_blocks((part.T @ part).tocoo(), part.shape[1] // 3)
        normal -= (across.T.tocsr() @ (inverse @ across)).toarray()
    if (np.diag(normal) < 0.0).any():
        raise LinAlgError("the points take more than there is, as those that lie in a camera do")
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal *= scale[:, None]
    normal *= scale
    normal[np.diag_indices_from(normal)] += _DAMPING
    factor, failed = dpotrf(normal, overwrite_a=1)
    if failed:
        raise LinAlgError("the normal matrix is not positive definite")
    covariance, _ = dpotri(factor, overwrite_c=1)  # its upper triangle
    for row in range(len(covariance)):
        covariance[row + 1 :, row] = covariance[row, row + 1 :]
    covariance *= scale[:, None]
    covariance *= scale
    return np.asarray(covariance)


def points_by_shared(
    by_point: Any, by_shared: Any, poses: Sequence[int], block: Block
) -> tuple[Any, FloatArray]:
    """How points move with the perturbations of `Marginals.shared`, and what their own rays tell of them.

    Args:
        by_point, by_shared: the Jacobian's two parts, CSR. poses: the free ones.

    Returns:
        (3 n, q) CSR and (n, 3, 3), information of each point if poses and lenses were exact.
    """
    of_points, count = by_point.tocsc(), by_point.shape[1] // 3
    normal = (of_points.T @ of_points).tocoo()
    back = [np.linalg.inv(_house_from_colmap(block.cam_from_block[k].translation)) for k in poses]
    unturned = sparse.block_diag([*back, sparse.eye(by_shared.shape[1] - 6 * len(back))], format="csr")
    moved = -(inverse_blocks(normal, count) @ (of_points.T @ (by_shared @ unturned)))
    return moved.tocsr(), _blocks(normal, count)


def marginals(covariance: FloatArray, poses: Sequence[int], lenses: Sequence[int], block: Block) -> Marginals:
    """Of the covariance of poses, in COLMAP's perturbation, and lenses, which is changed in place."""
    size = tuple(len(camera.params) for camera in block.cameras)
    for row, k in enumerate(poses):
        turn, own = _house_from_colmap(block.cam_from_block[k].translation), slice(6 * row, 6 * row + 6)
        covariance[own] = turn @ covariance[own]
        covariance[:, own] = covariance[:, own] @ turn.T
    pose_start = np.full(len(block.names), -1, dtype=np.int64)
    pose_start[list(poses)] = 6 * np.arange(len(poses))
    lens_start, first = np.full(len(block.cameras), -1, dtype=np.int64), 6 * len(poses)
    for c in lenses:
        lens_start[c] = first
        first += size[c]
    return Marginals(
        shared=covariance,
        pose_start=pose_start,
        lens_start=lens_start,
        lens_size=size,
    )


def _house_from_colmap(translation: FloatArray) -> FloatArray:
    """(6, 6): COLMAP turns by half an angle from the left and adds to the translation; see `Marginals`."""
    turn = np.eye(6)
    turn[:3, :3] *= 2.0
    turn[3:, :3] = 2.0 * skew(translation)
    return turn


def inverse_blocks(blocks: Any, n: int) -> Any:
    """The inverse of a matrix of n blocks of three on its diagonal."""
    dense = _blocks(blocks, n)
    diagonal = np.einsum("nii->ni", dense)
    # No residual of a point behind its cameras depends on it: its block is zero.
    diagonal += _DAMPING * np.maximum(diagonal.sum(axis=1, keepdims=True), _DAMPING)
    return sparse.bsr_matrix((np.linalg.inv(dense), np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))


def _blocks(blocks: Any, n: int) -> FloatArray:
    """(n, 3, 3) the blocks on the diagonal of a sparse matrix, COO."""
    dense = np.zeros((n, 3, 3))
    dense[blocks.row // 3, blocks.row % 3, blocks.col % 3] = blocks.data
    return dense
