"""How far the photos of a refined reconstruction may be off, given the existing points that hold it.

A similarity says how the whole may lie; that a reconstruction bends where nothing holds it any more, it does
not. That is in the normal equations of the adjustment: poses and lenses with the free points eliminated,
existing points known to what they are. Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, 6 and 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap_anchored import FixedPoints, with_observations
from ingest.colmap_bridge import Model
from ingest.focal_prior import FocalPriorOptions
from ingest.growth.photo_spread import PhotoSpread
from ingest.growth.refine import Lenses
from ingest.precision import Linearised, design_effect, linearise

_LEAST_FREEDOM = 0.1
_LEAST_OBSERVATIONS = 100  # of a camera; fewer show no pattern
_PIECE = 5  # photos; a photo alone says more of its own noise than of where its neighbourhood looks


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftOptions:
    """How the bending is judged.

    Attributes:
        least_px: of the standard deviation of an observation with what its neighbours share; it is measured
            on the residuals, which a handful of observations keeps too small.
        adopted_focal_rel, adopted_distortion: what a lens taken from a map may be off against that map's
            points. They were made with that very lens: what it trades for height, they trade alike.
        own_focal_rel, own_distortion: the same for a lens that was refined here; wide, the photos tell.
        exif_focal_rel: and where EXIF held its focal length.
        pattern_px: of a lens that nobody knew before: what SIMPLE_RADIAL, RADIAL and fuller models leave over
            in all their photos alike, as far as it passes for another focal length,
            measured on a simulated album. Flat places from above know nothing better.
        max_photos: of more, the rest is taken to be no worse; the equations are dense.
        max_points: free points that take part; fewer know less, so the bound stays one.
    """

    least_px: float = 0.1
    adopted_focal_rel: float = 0.001
    adopted_distortion: float = 0.0005
    own_focal_rel: float = 0.15
    own_distortion: float = 0.1
    exif_focal_rel: float = FocalPriorOptions().sigma_rel
    pattern_px: tuple[float, float, float] = (0.3, 0.1, 0.03)
    max_photos: int = 300
    max_points: int = 20_000


def photo_covariances(
    model: Model,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
    lenses: Lenses,
    options: DriftOptions,
) -> PhotoSpread:
    """Of all photos, relative to the existing points.

    Args:
        model: refined, in metres. keypoints: of its photos.
        fixed: existing points, those observations of `kept` (m,).
        lenses: what is known of the model's cameras without the photos.
    """
    count = len(model.rows)
    spread = PhotoSpread(
        poses=np.full((count, 6, 6), np.nan),
        turns=np.full((count, 3, 3), np.nan),
        lens_turns=np.full((count, 3, 3), np.nan),
    )
    if len(model.rows) > options.max_photos or not kept.any():
        return spread
    seen = np.union1d(model.photo_of, fixed.photo_of[kept])
    model = _thinned(model, options)
    free_xy = np.zeros((len(model.point_of), 2))
    for k in range(len(model.rows)):
        mine = model.photo_of == k
        free_xy[mine] = keypoints[k][model.keypoint_of[mine]]
    free, free_lens = _derivatives(model, model.xyz, model.point_of, model.photo_of, free_xy)
    held, held_lens = _derivatives(
        model, fixed.xyz, fixed.point_of[kept], fixed.photo_of[kept], fixed.pixels[kept]
    )
    # What points and poses take up of the residuals; tracks of two photos leave a quarter.
    freedom = 1.0 - (3 * len(model.xyz) + 6 * len(model.rows)) / (2.0 * max(len(free_xy), 1))
    sigma = _sigmas_px(model, free, free_xy, options) / np.sqrt(max(freedom, _LEAST_FREEDOM))
    sigma_held = _sigmas_px(model, held, fixed.pixels[kept], options)
    size, first = 6 * len(model.rows), _lens_columns(model)
    columns = size + first[-1]
    normal = np.zeros((columns, columns))
    poses_free = _rows(free, free_lens, model, first, size, columns, sigma)
    poses_held = _rows(held, held_lens, model, first, size, columns, sigma_held)
    normal += (poses_held.T @ poses_held).toarray() + (poses_free.T @ poses_free).toarray()
    by_point = _blocks(free.by_point / sigma[free.photo_of][:, None, None], free.point_of, len(model.xyz))
    normal -= _eliminated(poses_free, by_point, free, sigma)
    normal[size:, size:] += np.diag(_lens_information(model, lenses, options))
    # Photos without observations leave their rows empty; the damping is far below what any photo knows.
    normal += 1e-9 * np.diag(np.diag(normal)) + 1e-9 * np.eye(columns)
    covariance = np.linalg.inv(normal)
    covariance = (covariance[:size, :size] + covariance[:size, :size].T) / 2
    by_lenses = covariance - np.linalg.inv(normal[:size, :size])  # gone if lenses are true
    for c in sorted(set(range(len(model.cameras))) - {*lenses.constant, *lenses.focal_px}):
        parts = [(linear, lens[c]) for linear, lens in ((free, free_lens), (held, held_lens))]
        together = np.zeros(size)
        for k, moves in _by_unknown_focal(model, c, parts, options).items():
            together[6 * k : 6 * k + 6] = moves
        covariance += np.outer(together, together)
        by_lenses += np.outer(together, together)
    for k in seen.tolist():
        spread.poses[k] = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
    for k, piece in _pieces(model, fixed, kept, seen).items():
        spread.turns[k] = _turn(model, covariance, piece)
        spread.lens_turns[k] = _turn(model, by_lenses, piece)
    return spread


def _pieces(
    model: Model, fixed: FixedPoints, kept: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[int, NDArray[np.int64]]:
    """For each photo that sees something, itself and those that share most points with it."""
    photo = np.concatenate([model.photo_of, fixed.photo_of[kept]])
    point = np.concatenate([model.point_of, len(model.xyz) + fixed.point_of[kept]])
    shape = (len(model.rows), len(model.xyz) + len(fixed.xyz))
    sees = sparse.csr_array((np.ones(len(photo)), (photo, point)), shape=shape)
    shared = (sees @ sees.T).toarray()
    np.fill_diagonal(shared, np.inf)
    order = {k: np.argsort(-shared[k], kind="stable")[:_PIECE] for k in seen.tolist()}
    return {k: rows[shared[k, rows] > 0.0] for k, rows in order.items()}


def _turn(model: Model, covariance: FloatArray, piece: NDArray[np.int64]) -> FloatArray:
    """(3, 3) of the mean rotation of a piece's photos, about the local axes.

    Args:
        covariance: (6 k, 6 k) of all poses.
    """
    mean = np.hstack([model.cam_from_sfm[k].rotation.T for k in piece.tolist()]) / len(piece)
    at = (6 * piece[:, None] + np.arange(3)).reshape(-1)
    return np.asarray(mean @ covariance[np.ix_(at, at)] @ mean.T)


def _by_unknown_focal(
    model: Model, c: int, parts: Sequence[tuple[Linearised, FloatArray]], options: DriftOptions
) -> dict[int, FloatArray]:
    """How the poses of a camera's photos move, each (6,), with what its focal length may be off at one sigma.

    The photos tell a focal length by what a pose cannot take over of it: the relief of what they show. A
    pattern that the lens model leaves over passes for that, however many observations there are.

    Args:
        parts: observations of the model with, of those of this camera, the derivatives by its lens.
    """
    camera = model.cameras[c]
    columns = [camera.params[i] if camera.params[i] > 10.0 else 0.0 for i in camera.lens_parameters()]
    moves: dict[int, FloatArray] = {}
    square, count = 0.0, 0
    for k in np.flatnonzero(model.camera_of == c).tolist():
        by_pose, by_focal = [], []
        for linear, by_lens in parts:
            own = model.camera_of[linear.photo_of] == c
            mine = linear.photo_of[own] == k
            good = np.isfinite(linear.by_pose[own][mine]).all(axis=(1, 2))
            by_pose.append(linear.by_pose[own][mine][good].reshape(-1, 6))
            by_focal.append((by_lens[mine][good] @ columns).reshape(-1))
        pose, focal = np.concatenate(by_pose), np.concatenate(by_focal)
        if len(focal) < 8:
            continue
        moves[k] = np.linalg.lstsq(pose, focal, rcond=None)[0]
        square += float(((focal - pose @ moves[k]) ** 2).sum())
        count += len(focal) // 2
    told_px = np.sqrt(square / max(count, 1))  # for a focal length that is off by its own size
    pattern_px = options.pattern_px[{"SIMPLE_RADIAL": 0, "RADIAL": 1}.get(camera.model, 2)]
    sigma = 1.0 / np.hypot(1.0 / options.own_focal_rel, told_px / pattern_px)
    return {k: move * sigma for k, move in moves.items()}


def _sigmas_px(model: Model, linear: Linearised, pixels: FloatArray, options: DriftOptions) -> FloatArray:
    """(k,) standard deviation of the observations of each photo, as the residuals of its camera show it.

    With what neighbours share: a lens that its model does not describe leaves a pattern that many
    observations repeat.
    """
    good = np.isfinite(linear.residual).all(axis=1)
    of_camera = model.camera_of[linear.photo_of]
    sigmas = np.empty(len(model.cameras))
    for c, camera in enumerate(model.cameras):
        own = good & (of_camera == c)
        rows = np.flatnonzero(own if own.sum() >= _LEAST_OBSERVATIONS else good)
        side = max(camera.width, camera.height)
        if len(rows) == 0:
            sigmas[c] = options.least_px
            continue
        shared = design_effect(linear.residual[rows], pixels[rows], linear.photo_of[rows], side)
        sigmas[c] = max(np.sqrt((linear.residual[rows] ** 2).mean() * shared), options.least_px)
    return np.asarray(sigmas[model.camera_of])


def _thinned(model: Model, options: DriftOptions) -> Model:
    """The model with at most so many points, evenly chosen."""
    if len(model.xyz) <= options.max_points:
        return model
    chosen = np.zeros(len(model.xyz), dtype=np.bool_)
    chosen[np.linspace(0, len(model.xyz) - 1, options.max_points).astype(np.int64)] = True
    return with_observations(model, chosen[model.point_of])


def _derivatives(
    model: Model,
    xyz: FloatArray,
    point_of: NDArray[np.int64],
    photo_of: NDArray[np.int64],
    xy: FloatArray,
) -> tuple[Linearised, list[FloatArray]]:
    """Derivatives by points and poses, and by each camera's lens parameters (m, 2, l) of its observations."""
    linear = linearise(model.cameras, model.camera_of, model.cam_from_sfm, xyz, point_of, photo_of, xy)
    lens: list[FloatArray] = []
    rotations = np.array([p.rotation for p in model.cam_from_sfm])
    translations = np.array([p.translation for p in model.cam_from_sfm])
    in_camera = np.einsum("mij,mj->mi", rotations[photo_of], xyz[point_of]) + translations[photo_of]
    for c, camera in enumerate(model.cameras):
        rows = model.camera_of[photo_of] == c
        columns = []
        for index in camera.lens_parameters():
            step = 1e-4 * max(abs(camera.params[index]), 1.0)
            up, down = (_with(camera, index, camera.params[index] + s) for s in (step, -step))
            columns.append((up.project(in_camera[rows]) - down.project(in_camera[rows])) / (2 * step))
        lens.append(
            np.nan_to_num(np.stack(columns, axis=2)) if columns else np.zeros((int(rows.sum()), 2, 0))
        )
    return linear, lens


def _with(camera: Camera, index: int, value: float) -> Camera:
    params = list(camera.params)
    params[index] = value
    return Camera(model=camera.model, width=camera.width, height=camera.height, params=tuple(params))


def _lens_columns(model: Model) -> NDArray[np.int64]:
    """First column of each camera's lens, and their number at the end."""
    counts = [len(camera.lens_parameters()) for camera in model.cameras]
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _lens_information(model: Model, lenses: Lenses, options: DriftOptions) -> FloatArray:
    """Inverse variances of all lens parameters."""
    known: list[float] = []
    for c, camera in enumerate(model.cameras):
        own = c not in lenses.constant
        focal = options.exif_focal_rel if c in lenses.focal_px else options.own_focal_rel
        focal = focal if own else options.adopted_focal_rel
        distortion = options.own_distortion if own else options.adopted_distortion
        for index in camera.lens_parameters():
            is_focal = camera.params[index] > 10.0  # pixels; distortion coefficients are below one
            known.append(1.0 / ((focal * camera.params[index]) if is_focal else distortion) ** 2)
    return np.array(known)


def _rows(
    linear: Linearised,
    lens: Sequence[FloatArray],
    model: Model,
    lenses: NDArray[np.int64],
    size: int,
    columns: int,
    sigma: FloatArray,
) -> sparse.csr_array:
    """Whitened rows (2 m, columns) of the derivatives by poses and lenses."""
    scale = 1.0 / sigma[linear.photo_of][:, None, None]
    poses = _blocks(linear.by_pose * scale, linear.photo_of, len(model.rows))
    parts = [sparse.hstack([poses, sparse.csr_array((poses.shape[0], columns - size))]).tocsr()]
    for c, by_lens in enumerate(lens):
        if by_lens.shape[2] == 0:
            continue
        rows = np.flatnonzero(model.camera_of[linear.photo_of] == c)
        values = by_lens * scale[rows]
        at = (2 * rows[:, None, None] + np.arange(2)[None, :, None]) + 0 * values.astype(np.int64)
        column = size + lenses[c] + np.arange(by_lens.shape[2])[None, None, :] + 0 * at
        parts.append(
            sparse.csr_array(
                (values.ravel(), (at.ravel(), column.ravel())), shape=(2 * len(linear.photo_of), columns)
            )
        )
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return sparse.csr_array(total)


def _blocks(values: FloatArray, group: NDArray[np.int64], count: int) -> sparse.csr_array:
    """Sparse (2 m, count * d) with the blocks (m, 2, d) at the columns of their groups."""
    m, _, d = values.shape
    rows = np.broadcast_to((2 * np.arange(m)[:, None] + np.arange(2))[:, :, None], values.shape)
    columns = np.broadcast_to(d * group[:, None, None] + np.arange(d), values.shape)
    finite = np.nan_to_num(values)
    return sparse.csr_array((finite.ravel(), (rows.ravel(), columns.ravel())), shape=(2 * m, d * count))


def _eliminated(
    poses: sparse.csr_array, by_point: sparse.csr_array, linear: Linearised, sigma: FloatArray
) -> FloatArray:
    """What eliminating the free points takes from the normal matrix of poses and lenses."""
    scaled = np.nan_to_num(linear.by_point) / sigma[linear.photo_of][:, None, None]
    information = np.zeros((by_point.shape[1] // 3, 3, 3))
    np.add.at(information, linear.point_of, np.swapaxes(scaled, 1, 2) @ scaled)
    trace = np.trace(information, axis1=1, axis2=2)
    inverse = np.linalg.inv(information + (1e-9 * trace + 1e-12)[:, None, None] * np.eye(3))
    mixed = sparse.csr_array(poses.T @ by_point)
    return np.asarray((mixed @ sparse.block_diag(inverse, format="csr") @ mixed.T).toarray())
