"""Sparse least squares of a block against a scan: what bundle adjustment libraries do not offer.

pycolmap's adjustment knows positions of images and fixed points; it has no residual from a point to a
surface. Here three kinds of residuals meet: the tracks' reprojection errors, scan points seen by registered
frames (control), and distances of the map's points from the scan's planes. Levenberg-Marquardt with Cauchy
weights; the points are eliminated by the Schur complement (Triggs et al., Bundle adjustment: a modern
synthesis, 6.1).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.precision import linearise
from ingest.register.block import Block

_RELATIVE_STEP = 1e-6  # of central differences by the lens parameters


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Control:
    """Points of the scan that registered frames see.

    Attributes:
        xyz: (c, 3) in the block's frame. photo_of: (c,) the block's photo. xy: (c, 2) full-size pixels.
    """

    xyz: FloatArray
    photo_of: NDArray[np.int64]
    xy: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planes:
    """The scan's plane next to each point of the block.

    Attributes:
        offset: (n,) signed distance of the point, metres; NaN where no scan is near.
        normals: (n, 3).
    """

    offset: FloatArray
    normals: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Sigmas:
    """Standard deviations of the three kinds of residuals, and of the lens parameters' priors.

    Attributes:
        track_px, control_px, surface_m: of one residual.
        focal_rel: of a focal length around its start, relative.
        center_rel: of the principal point around its start, relative to the image's longer side.
        distortion: of a distortion coefficient around its start.
    """

    track_px: float
    control_px: float
    surface_m: float
    focal_rel: float
    center_rel: float
    distortion: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Terms:
    """Whitened residuals and Jacobians of one evaluation, with the Cauchy cost."""

    cost: float
    shared: sparse.csr_matrix
    by_point: sparse.csr_matrix
    residual: FloatArray


def solve(
    block: Block, control: Control, planes: Planes, start: tuple[Camera, ...], sigmas: Sigmas, steps: int
) -> Block:
    """The block after at most so many steps of Levenberg-Marquardt.

    Args:
        planes: at the block's points as they are now; they stay while the points move.
        start: cameras around which the lenses' priors lie.
    """
    damping, at = 1e-4, block.xyz
    terms = _terms(block, control, planes, at, start, sigmas)
    for _ in range(steps):
        for _ in range(6):
            candidate = _stepped(block, _step(terms, damping))
            if candidate is None:
                damping *= 10
                continue
            new = _terms(candidate, control, planes, at, start, sigmas)
            if new.cost < terms.cost:
                break
            damping *= 10
        else:
            return block
        gain = (terms.cost - new.cost) / terms.cost
        block, terms, damping = candidate, new, max(damping / 10, 1e-9)
        if gain < 1e-5:
            break
    return block


def _terms(
    block: Block, control: Control, planes: Planes, at: FloatArray, start: tuple[Camera, ...], sigmas: Sigmas
) -> _Terms:
    """All residuals (observed minus predicted, over sigma, times the root of the Cauchy weight)."""
    tracks = linearise(
        block.cameras,
        block.camera_of,
        block.cam_from_block,
        block.xyz,
        block.point_of,
        block.photo_of,
        block.xy,
    )
    marks = linearise(
        block.cameras,
        block.camera_of,
        block.cam_from_block,
        control.xyz,
        np.arange(len(control.xyz)),
        control.photo_of,
        control.xy,
    )
    n, photos = len(block.xyz), len(block.cam_from_block)
    near = np.flatnonzero(np.isfinite(planes.offset))
    normal = planes.normals[near]
    offset = planes.offset[near] + np.einsum("ij,ij->i", normal, block.xyz[near] - at[near])
    weighted = [
        _whitened(tracks.residual / sigmas.track_px),
        _whitened(marks.residual / sigmas.control_px),
        _whitened(-offset[:, None] / sigmas.surface_m),
    ]
    lens_size = sum(len(camera.params) for camera in block.cameras)
    shared = [
        _shared_rows(
            part.by_pose,
            _by_lens(block, points, photo_of),
            photo_of,
            block,
            weight / sigma,
            photos,
            lens_size,
        )
        for part, points, photo_of, (weight, _), sigma in (
            (tracks, block.xyz[block.point_of], block.photo_of, weighted[0], sigmas.track_px),
            (marks, control.xyz, control.photo_of, weighted[1], sigmas.control_px),
        )
    ]
    prior_residual, prior_weight = _lens_prior(block.cameras, start, sigmas)
    prior = sparse.hstack([sparse.csr_matrix((lens_size, 6 * photos)), sparse.diags(prior_weight)])
    no_shared = sparse.csr_matrix((len(near), 6 * photos + lens_size))
    by_point = [
        _point_rows(tracks.by_point * (weighted[0][0] / sigmas.track_px)[:, None, None], block.point_of, n),
        sparse.csr_matrix((2 * len(control.xyz), 3 * n)),
        _point_rows((normal * (weighted[2][0] / sigmas.surface_m)[:, None])[:, None], near, n),
        sparse.csr_matrix((lens_size, 3 * n)),
    ]
    residual = np.concatenate([(w[:, None] * r).ravel() for w, r in weighted] + [prior_residual])
    cost = sum(float(np.log1p((r**2).sum(axis=1)).sum()) for _, r in weighted)
    return _Terms(
        cost=cost + float((prior_residual**2).sum()),
        shared=sparse.csr_matrix(sparse.vstack([shared[0], shared[1], no_shared, prior])),
        by_point=sparse.csr_matrix(sparse.vstack(by_point)),
        residual=residual,
    )


def _whitened(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root of the Cauchy weight (m,) and the residual (m, d) itself; points behind a camera weigh nothing."""
    squared = (residual**2).sum(axis=1)
    ok = np.isfinite(squared)
    finite = np.where(ok[:, None], residual, 1e3)
    return np.where(ok, 1.0 / np.sqrt(1.0 + np.where(ok, squared, 0.0)), 0.0), finite


def _shared_rows(
    by_pose: FloatArray,
    by_lens: list[tuple[NDArray[np.int64], FloatArray, int]],
    photo_of: NDArray[np.int64],
    block: Block,
    weight: FloatArray,
    photos: int,
    lens_size: int,
) -> sparse.csr_matrix:
    """Rows (2 m, 6 k + lenses) of observations, each touching one pose and one lens."""
    m = len(photo_of)
    rows = np.arange(2 * m).reshape(m, 2, 1)
    values = np.nan_to_num(by_pose * weight[:, None, None])
    columns = 6 * photo_of[:, None, None] + np.arange(6)
    parts = [(values, np.broadcast_to(rows, values.shape), np.broadcast_to(columns, values.shape))]
    for chosen, jacobian, first in by_lens:
        value = np.nan_to_num(jacobian * weight[chosen, None, None])
        column = 6 * photos + first + np.arange(value.shape[2])
        parts.append(
            (value, np.broadcast_to(rows[chosen], value.shape), np.broadcast_to(column, value.shape))
        )
    data, row, column = (np.concatenate([p[i].ravel() for p in parts]) for i in range(3))
    return sparse.csr_matrix((data, (row, column)), shape=(2 * m, 6 * photos + lens_size))


def _by_lens(
    block: Block, points: FloatArray, photo_of: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], FloatArray, int]]:
    """For each camera: rows of its observations, Jacobian (r, 2, p) by its parameters, its first column."""
    rotations = np.array([pose.rotation for pose in block.cam_from_block])
    translations = np.array([pose.translation for pose in block.cam_from_block])
    in_camera = np.einsum("mij,mj->mi", rotations[photo_of], points) + translations[photo_of]
    result, first = [], 0
    for index, camera in enumerate(block.cameras):
        rows = np.flatnonzero(block.camera_of[photo_of] == index)
        columns = []
        for k, value in enumerate(camera.params):
            step = _RELATIVE_STEP * max(abs(value), 1.0)
            more, less = (_with_param(camera, k, value + s).project(in_camera[rows]) for s in (step, -step))
            columns.append((more - less) / (2 * step))
        result.append((rows, np.stack(columns, axis=2), first))
        first += len(camera.params)
    return result


def _with_param(camera: Camera, k: int, value: float) -> Camera:
    params = list(camera.params)
    params[k] = value
    return replace(camera, params=tuple(params))


def _point_rows(jacobian: FloatArray, point_of: NDArray[np.intp], points: int) -> sparse.csr_matrix:
    """Rows (d m, 3 n) of a Jacobian (m, d, 3) by the points."""
    m, d, _ = jacobian.shape
    column = np.broadcast_to(3 * point_of[:, None, None] + np.arange(3), jacobian.shape)
    row = np.broadcast_to(np.arange(m * d).reshape(m, d, 1), jacobian.shape)
    values = np.nan_to_num(jacobian).ravel()
    return sparse.csr_matrix((values, (row.ravel(), column.ravel())), shape=(m * d, 3 * points))


def _lens_prior(
    cameras: tuple[Camera, ...], start: tuple[Camera, ...], sigmas: Sigmas
) -> tuple[FloatArray, FloatArray]:
    """Residuals and weights of the lens parameters around their start."""
    residual, weight = [], []
    for camera, first in zip(cameras, start, strict=True):
        template = first.to_pycolmap()
        for k, value in enumerate(camera.params):
            if k in template.focal_length_idxs():
                sigma = sigmas.focal_rel * first.focal_px
            elif k in template.principal_point_idxs():
                sigma = sigmas.center_rel * max(first.width, first.height)
            else:
                sigma = sigmas.distortion
            weight.append(1.0 / sigma)
            residual.append((first.params[k] - value) / sigma)
    return np.array(residual), np.array(weight)


def lens_covariance(
    block: Block, control: Control, planes: Planes, start: tuple[Camera, ...], sigmas: Sigmas
) -> list[FloatArray]:
    """Covariance (p, p) of each camera's parameters, all else estimated too, for independent residuals."""
    terms = _terms(block, control, planes, block.xyz, start, sigmas)
    system = _reduce(terms, 1e-12)
    covariance = system.scale[:, None] * np.linalg.inv(system.scaled) * system.scale
    result, first = [], 6 * len(block.cam_from_block)
    for camera in block.cameras:
        end = first + len(camera.params)
        result.append(np.asarray(covariance[first:end, first:end]))
        first = end
    return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Reduced:
    """The normal equations of the shared parameters, points eliminated, scaled to a unit diagonal."""

    scaled: FloatArray
    scale: FloatArray
    gradient: FloatArray
    gradient_points: FloatArray
    inverse: FloatArray
    across: sparse.csr_matrix


def _reduce(terms: _Terms, damping: float) -> _Reduced:
    n = terms.by_point.shape[1] // 3
    normal_points = (terms.by_point.T @ terms.by_point).tocsr()
    blocks = _diagonal_blocks(normal_points, n)
    diagonal = np.einsum("nii->ni", blocks)
    diagonal += damping * diagonal + 1e-9 * (diagonal.max() + 1.0)
    inverse: FloatArray = np.asarray(np.linalg.inv(blocks), dtype=np.float64)
    across = (terms.by_point.T @ terms.shared).tocsr()
    inverse_matrix = sparse.bsr_matrix((inverse, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    carried = (inverse_matrix @ across).tocsr()
    shared = (terms.shared.T @ terms.shared).toarray()
    shared[np.diag_indices(len(shared))] *= 1.0 + damping
    gradient_points = terms.by_point.T @ terms.residual
    # Lens coefficients and metres differ by orders of magnitude.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(shared), 1e-12))
    reduced = shared - (across.T @ carried).toarray()
    return _Reduced(
        scaled=reduced * scale[:, None] * scale + 1e-12 * np.eye(len(scale)),
        scale=scale,
        gradient=terms.shared.T @ terms.residual - carried.T @ gradient_points,
        gradient_points=gradient_points,
        inverse=inverse,
        across=across,
    )


def _step(terms: _Terms, damping: float) -> tuple[FloatArray, FloatArray]:
    """Increments of the shared parameters and of the points (n, 3)."""
    system = _reduce(terms, damping)
    solution = system.scale * np.linalg.solve(system.scaled, system.scale * system.gradient)
    left = (system.gradient_points - system.across @ solution).reshape(-1, 3)
    return solution, np.einsum("nij,nj->ni", system.inverse, left)


def _diagonal_blocks(matrix: sparse.csr_matrix, n: int) -> FloatArray:
    """The (n, 3, 3) blocks of a block diagonal matrix."""
    entries = matrix.tocoo()
    blocks = np.zeros((n, 3, 3))
    blocks[entries.row // 3, entries.row % 3, entries.col % 3] = entries.data
    return blocks


def _stepped(block: Block, step: tuple[FloatArray, FloatArray]) -> Block | None:
    """The block moved by a step; None where the step leaves what a lens can be."""
    shared, points = step
    photos = len(block.cam_from_block)
    if not (np.isfinite(shared).all() and np.isfinite(points).all()):
        return None
    cameras, first = [], 6 * photos
    for camera in block.cameras:
        params = np.array(camera.params) + shared[first : first + len(camera.params)]
        first += len(camera.params)
        focals = params[list(camera.to_pycolmap().focal_length_idxs())]
        if (focals < 0.2 * camera.focal_px).any() or (focals > 5 * camera.focal_px).any():
            return None
        cameras.append(replace(camera, params=tuple(params)))
    return replace(
        block,
        cameras=tuple(cameras),
        cam_from_block=tuple(
            Rigid3.exp(shared[6 * k : 6 * k + 6]) @ pose for k, pose in enumerate(block.cam_from_block)
        ),
        xyz=block.xyz + points,
    )
