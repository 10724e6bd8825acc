"""Marginal covariances of an adjustment: points eliminated, everything shared kept together.

Triggs et al., Bundle adjustment: a modern synthesis, 2000, sections 6 and 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew

_DAMPING = 1e-12  # relative; of directions that nothing determines


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
        by_lens = self._from_lenses() if lens_dilution > 1.0 else np.zeros_like(self.shared)
        result = np.zeros((len(self.pose_start), 6, 6))
        for photo, start in enumerate(self.pose_start.tolist()):
            if start >= 0:
                rows = slice(start, start + 6)
                result[photo] = self.shared[rows, rows] + (lens_dilution - 1.0) * by_lens[rows, rows]
        return result

    def _from_lenses(self) -> FloatArray:
        """What would be gone of the poses' covariance if the lenses were exact."""
        first = 6 * int((self.pose_start >= 0).sum())
        if first == len(self.shared):
            return np.zeros_like(self.shared)
        across, lenses = self.shared[:first, first:], self.shared[first:, first:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(lenses), 1e-300))
        factor = cho_factor(lenses * scale[:, None] * scale + _DAMPING * np.eye(len(scale)))
        return np.asarray((across * scale) @ cho_solve(factor, (across * scale).T))

    def lens(self, camera: int) -> FloatArray:
        """(p, p) of a camera's parameters; zero where they are held."""
        return self._part(int(self.lens_start[camera]), self.lens_size[camera])

    def _part(self, start: int, size: int) -> FloatArray:
        if start < 0:
            return np.zeros((size, size))
        return self.shared[start : start + size, start : start + size]


def marginals(
    jacobian: Any,
    points: NDArray[np.int64],
    poses: Sequence[int],
    lenses: Sequence[int],
    block: Block,
) -> Marginals:
    """From the Jacobian of whitened residuals.

    Args:
        jacobian: columns three for each of `points`, six for each of `poses` in COLMAP's perturbation, then
            the parameters of `lenses`.
    """
    size = tuple(len(camera.params) for camera in block.cameras)
    n = 3 * len(points)
    by_point, by_shared = jacobian[:, :n].tocsc(), jacobian[:, n:].tocsc()
    inverse = _inverse_blocks((by_point.T @ by_point).tocoo(), len(points))
    across = (by_point.T @ by_shared).tocsr()
    normal = (by_shared.T @ by_shared).toarray() - (across.T @ (inverse @ across)).toarray()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale[:, None] * scale + _DAMPING * np.eye(len(scale))
    covariance = cho_solve(cho_factor(scaled), np.eye(len(scale))) * scale[:, None] * scale
    turn = _house_from_colmap([block.cam_from_block[k].translation for k in poses], len(covariance))
    pose_start = np.full(len(block.names), -1, dtype=np.int64)
    pose_start[list(poses)] = 6 * np.arange(len(poses))
    lens_start, first = np.full(len(block.cameras), -1, dtype=np.int64), 6 * len(poses)
    for c in lenses:
        lens_start[c] = first
        first += size[c]
    return Marginals(
        shared=np.asarray(turn @ (turn @ covariance).T),
        pose_start=pose_start,
        lens_start=lens_start,
        lens_size=size,
    )


def _house_from_colmap(translations: Sequence[FloatArray], size: int) -> Any:
    """(q, q): COLMAP turns by half an angle from the left and adds to the translation; see `Marginals`."""
    parts = []
    for translation in translations:
        part = np.eye(6)
        part[:3, :3] *= 2.0
        part[3:, :3] = 2.0 * skew(translation)
        parts.append(part)
    return sparse.block_diag([*parts, sparse.eye(size - 6 * len(parts))], format="csr")


def _inverse_blocks(blocks: Any, n: int) -> Any:
    """The inverse of a matrix of n blocks of three on its diagonal."""
    dense = np.zeros((n, 3, 3))
    dense[blocks.row // 3, blocks.row % 3, blocks.col % 3] = blocks.data
    diagonal = np.einsum("nii->ni", dense)
    diagonal += _DAMPING * diagonal.sum(axis=1, keepdims=True)
    return sparse.bsr_matrix((np.linalg.inv(dense), np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
