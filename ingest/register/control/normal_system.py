"""Normal equations of a block with control points; see `ingest.register.control.adjust`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.precision import Linearised, linearise
from ingest.register.control.fit import Vertical
from ingest.register.control.marks import Control

T_FREEDOM = 4.0  # of Student's t for surveyed coordinates


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """Standard deviations, and what takes part.

    Attributes:
        mark_px: of a mark's pixel coordinate. control_m: (3,) of a surveyed coordinate.
        marks: (m,) bool: those that take part.
        points: (n,) bool: those whose surveyed coordinates take part; the others only tie photos together.
        ground_m: (n,) of a point's height as the block's ground has it, for points that one photo shows;
            infinity for the others, whose marks say more.
    """

    mark_px: float
    control_m: FloatArray
    marks: NDArray[np.bool_]
    points: NDArray[np.bool_]
    ground_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    poses: tuple[Rigid3, ...]
    cameras: tuple[Camera, ...]
    control: FloatArray
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """What does not change while iterating. `block` holds the points that take part only."""

    block: Block
    control: Control
    weights: Weights
    vertical: Vertical | None
    free: tuple[tuple[int, tuple[int, ...]], ...]  # cameras with their free parameters
    lens_start: NDArray[np.int64]  # column of each camera's first free parameter, -1 for none
    start: State
    similarity: FloatArray
    keypoint_px: float


def linear_of(
    cameras: tuple[Camera, ...], poses: tuple[Rigid3, ...], points: FloatArray, block: Block
) -> Linearised:
    return linearise(cameras, block.camera_of, poses, points, block.point_of, block.photo_of, block.xy)


def mark_linear_of(problem: Problem, state: State) -> Linearised:
    rows = np.flatnonzero(problem.weights.marks)
    control = problem.control
    return linearise(
        state.cameras,
        problem.block.camera_of,
        state.poses,
        state.control,
        control.point_of[rows],
        control.photo_of[rows],
        control.xy[rows],
    )


def cost_of(problem: Problem, state: State) -> float:
    keypoints = linear_of(state.cameras, state.poses, state.points, problem.block).residual
    squared = (keypoints**2).sum(axis=1) / problem.keypoint_px**2
    marks = mark_linear_of(problem, state).residual / problem.weights.mark_px
    total = float(np.log1p(np.where(np.isfinite(squared), squared, 1e12)).sum())
    total += float(np.nan_to_num(marks**2, nan=1e12).sum())
    total += _control_cost(problem, state)
    off_ground = (problem.start.control - state.control)[:, 2] / problem.weights.ground_m
    total += float((off_ground**2).sum())
    if problem.vertical is not None:
        total += float((_vertical_residual(problem, state)[0] ** 2).sum())
    return total


def _control_difference(problem: Problem, state: State) -> FloatArray:
    """(n, 3) surveyed minus found over sigma; zero where unknown or left out."""
    known = np.isfinite(problem.control.surveyed) & problem.weights.points[:, None]
    difference = (problem.control.surveyed - state.control) / problem.weights.control_m
    return np.where(known, difference, 0.0)


def trust_of(problem: Problem, state: State) -> FloatArray:
    """(n,) weight of each point's coordinates under Student's t."""
    axes = np.isfinite(problem.control.surveyed).sum(axis=1)
    squared = (_control_difference(problem, state) ** 2).sum(axis=1)
    return np.asarray((T_FREEDOM + axes) / (T_FREEDOM + squared))


def _control_cost(problem: Problem, state: State) -> float:
    axes = np.isfinite(problem.control.surveyed).sum(axis=1)
    squared = (_control_difference(problem, state) ** 2).sum(axis=1)
    return float(((T_FREEDOM + axes) * np.log1p(squared / T_FREEDOM)).sum())


def _vertical_residual(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Weighted residual (3,) and its derivative (3, 6 k) by the poses.

    The block has moved as a whole by the best similarity of its poses' changes.
    """
    assert problem.vertical is not None
    change = common_change(problem.similarity, problem.start.poses, state.poses)
    return problem.vertical.residual(change), problem.vertical.jacobian(change) @ problem.similarity


def common_change(similarity: FloatArray, before: Sequence[Rigid3], after: Sequence[Rigid3]) -> Sim3:
    """The similarity nearest to what became of all poses."""
    changes = [(now @ old.inverse()).log() for now, old in zip(after, before, strict=True)]
    return Sim3.exp(similarity @ np.concatenate(changes))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class System:
    """Normal equations: reduced to the global unknowns, and what brings the points back."""

    normal: sparse.csr_array
    gradient: FloatArray
    cross: sparse.csr_array
    points: FloatArray
    points_gradient: FloatArray

    @property
    def reduced(self) -> FloatArray:
        inverse = _block_diagonal(np.linalg.inv(self.points))
        return np.asarray((self.normal - self.cross @ inverse @ self.cross.T).todense())


def system_of(problem: Problem, state: State) -> System:
    block, k = problem.block, len(problem.block.names)
    lens = sum(len(columns) for _, columns in problem.free)
    size = 6 * k + lens + 3 * len(state.control)
    linear = linear_of(state.cameras, state.poses, state.points, block)
    squared = (linear.residual**2).sum(axis=1) / problem.keypoint_px**2
    usable = np.isfinite(squared)
    weight = np.where(usable, 1.0 / (1.0 + np.where(usable, squared, 0.0)), 0.0) / problem.keypoint_px**2
    by_global = _global_jacobian(problem, state, linear, state.points, size)
    residual = np.nan_to_num(linear.residual)
    by_point = np.nan_to_num(linear.by_point)
    points = np.zeros((len(state.points), 3, 3))
    np.add.at(points, block.point_of, np.swapaxes(by_point, 1, 2) @ by_point * weight[:, None, None])
    # Far below what the observations say, so that all points together do not hold the block in place.
    points += np.eye(3) * (1e-13 * np.trace(points, axis1=1, axis2=2) + 1e-30)[:, None, None]
    points_gradient = np.zeros((len(state.points), 3))
    np.add.at(points_gradient, block.point_of, np.einsum("mij,mi->mj", by_point, residual) * weight[:, None])
    weighted = sparse.diags_array(np.repeat(weight, 2)) @ by_global
    normal = (by_global.T @ weighted).tocsr()
    gradient = weighted.T @ residual.ravel()
    cross = (weighted.T @ _jacobian_by_index(by_point, block.point_of, len(state.points))).tocsr()
    more_normal, more_gradient = _control_equations(problem, state, size)
    return System(
        normal=(normal + more_normal).tocsr(),
        gradient=gradient + more_gradient,
        cross=cross,
        points=points,
        points_gradient=points_gradient,
    )


def _control_equations(problem: Problem, state: State, size: int) -> tuple[sparse.csr_array, FloatArray]:
    """Normal equations of marks, surveyed coordinates and the vertical."""
    k = len(problem.block.names)
    offset = size - 3 * len(state.control)
    marks, by_global = mark_equations(problem, state, size)
    weight = 1.0 / problem.weights.mark_px**2
    normal = (by_global.T @ by_global * weight).tolil()
    gradient = by_global.T @ marks.residual.ravel() * weight
    known = np.isfinite(problem.control.surveyed) & problem.weights.points[:, None]
    trust = trust_of(problem, state)[:, None]
    diagonal = np.full(size, 0.0)
    diagonal[offset:] = (known * trust / problem.weights.control_m**2).ravel()
    by_sigma = trust * _control_difference(problem, state) / problem.weights.control_m
    gradient[offset:] += by_sigma.ravel()
    ground = offset + 3 * np.arange(len(state.control)) + 2
    diagonal[ground] += 1.0 / problem.weights.ground_m**2
    gradient[ground] += (problem.start.control - state.control)[:, 2] / problem.weights.ground_m**2
    # Points without marks have no equation at all: they stay where they are.
    marked = np.isin(np.arange(len(state.control)), problem.control.point_of[problem.weights.marks])
    idle = np.repeat(~marked, 3)
    diagonal[offset:][idle] = 1.0
    total = sparse.csr_array(normal) + sparse.diags_array(diagonal)
    if problem.vertical is not None:
        rest, by_poses = _vertical_residual(problem, state)
        dense = np.zeros((3, size))
        dense[:, : 6 * k] = by_poses
        total = total + sparse.csr_array(dense.T @ dense)
        gradient -= dense.T @ rest
    return sparse.csr_array(total), np.asarray(gradient)


def mark_equations(problem: Problem, state: State, size: int) -> tuple[Linearised, sparse.csr_array]:
    """The marks that take part, and their derivative (2 m, size) by all unknowns."""
    marks = mark_linear_of(problem, state)
    by_global = _global_jacobian(problem, state, marks, state.control, size)
    offset = size - 3 * len(state.control)
    by_point = _jacobian_by_index(marks.by_point, marks.point_of, len(state.control), offset, size)
    return marks, by_global + by_point


def _global_jacobian(
    problem: Problem, state: State, linear: Linearised, points: FloatArray, size: int
) -> sparse.csr_array:
    """(2 m, size) derivative of projections by poses and lenses."""
    m = len(linear.photo_of)
    by_pose = np.nan_to_num(linear.by_pose)
    rows = np.repeat(np.arange(2 * m), 6)
    columns = (6 * linear.photo_of[:, None, None] + np.arange(6)).repeat(2, axis=1).ravel()
    values = [by_pose.ravel()]
    all_rows: list[NDArray[Any]] = [rows]
    all_columns: list[NDArray[Any]] = [columns]
    camera_of = problem.block.camera_of[linear.photo_of]
    rotations = np.array([p.rotation for p in state.poses])
    translations = np.array([p.translation for p in state.poses])
    for index, parameters in problem.free:
        mine = np.flatnonzero(camera_of == index)
        photo = linear.photo_of[mine]
        in_camera = (
            np.einsum("mij,mj->mi", rotations[photo], points[linear.point_of[mine]]) + translations[photo]
        )
        for number, parameter in enumerate(parameters):
            derivative = _by_parameter(state.cameras[index], parameter, in_camera)
            values.append(np.nan_to_num(derivative).ravel())
            all_rows.append((2 * mine[:, None] + [0, 1]).ravel())
            all_columns.append(np.full(2 * len(mine), problem.lens_start[index] + number))
    return sparse.csr_array(
        (np.concatenate(values), (np.concatenate(all_rows), np.concatenate(all_columns))), shape=(2 * m, size)
    )


def _by_parameter(camera: Camera, parameter: int, in_camera: FloatArray) -> FloatArray:
    """(m, 2) derivative of the projection by one lens parameter, by central differences."""
    step = 1e-6 * max(abs(camera.params[parameter]), 1.0)

    def at(change: float) -> FloatArray:
        params = list(camera.params)
        params[parameter] += change
        return replace(camera, params=tuple(params)).project(in_camera)

    return np.asarray((at(step) - at(-step)) / (2.0 * step))


def _jacobian_by_index(
    by_point: FloatArray, index: NDArray[np.int64], count: int, offset: int = 0, size: int | None = None
) -> sparse.csr_array:
    """(2 m, 3 count) derivative by points, of observations' own (m, 2, 3)."""
    m = len(index)
    rows = np.repeat(np.arange(2 * m), 3)
    columns = (offset + 3 * index[:, None, None] + np.arange(3)).repeat(2, axis=1).ravel()
    shape = (2 * m, 3 * count if size is None else size)
    return sparse.csr_array((np.nan_to_num(by_point).ravel(), (rows, columns)), shape=shape)


def _block_diagonal(blocks: NDArray[np.floating[Any]]) -> sparse.csr_array:
    n = len(blocks)
    return sparse.csr_array(sparse.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n)))


def solve(system: System, damping: float) -> tuple[FloatArray, FloatArray]:
    """Steps of the global unknowns and of the points (p, 3) with Marquardt's damping."""
    points = system.points + damping * np.eye(3) * system.points
    inverse = np.linalg.inv(points)
    sparse_inverse = _block_diagonal(inverse)
    eliminated = system.cross @ sparse_inverse
    reduced = np.asarray((system.normal - eliminated @ system.cross.T).todense())
    reduced[np.diag_indices_from(reduced)] += damping * system.normal.diagonal()
    right = system.gradient - eliminated @ system.points_gradient.ravel()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    scaled = reduced * scale[:, None] * scale
    scaled[np.diag_indices_from(scaled)] += 1e-13
    step = scale * cho_solve(cho_factor(scaled), scale * right)
    rest = system.points_gradient - (system.cross.T @ step).reshape(-1, 3)
    return step, np.einsum("nij,nj->ni", inverse, rest)


def moved(problem: Problem, state: State, step: FloatArray, points_step: FloatArray) -> State:
    """The state after a step.

    What the step moves as a whole is done as a similarity, exactly: half a degree, harmless for control
    points that are good to a metre, would by its second order break what keypoints hold to millimetres.
    """
    k = len(state.poses)
    whole_tangent = problem.similarity @ step[: 6 * k]
    whole = Sim3.exp(whole_tangent)
    turned = whole.scale * whole.rotation

    def carried(places: FloatArray, change: FloatArray) -> FloatArray:
        own = change - point_jacobian(places) @ whole_tangent
        return np.asarray(whole.act(places) + own @ turned.T)

    poses = []
    for i, pose in enumerate(state.poses):
        own = step[6 * i : 6 * i + 6] - _pose_change(pose, whole_tangent)
        own[3:] *= whole.scale
        poses.append(Rigid3.exp(own) @ whole.act_on_pose(pose))
    cameras = list(state.cameras)
    for index, parameters in problem.free:
        params = list(cameras[index].params)
        for number, parameter in enumerate(parameters):
            params[parameter] += float(step[problem.lens_start[index] + number])
        cameras[index] = replace(cameras[index], params=tuple(params))
    return State(
        poses=tuple(poses),
        cameras=tuple(cameras),
        control=carried(state.control, step[len(step) - 3 * len(state.control) :].reshape(-1, 3)),
        points=carried(state.points, points_step),
    )


def _pose_change(pose: Rigid3, tangent: FloatArray) -> FloatArray:
    """(6,) left perturbation of cam_from_local when the whole block moves by a similarity's tangent (7,)."""
    center_moves = point_jacobian(pose.center) @ tangent
    return np.concatenate([-pose.rotation @ tangent[1:4], -pose.rotation @ center_moves])
