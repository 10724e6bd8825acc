"""A map's similarity to a scan's solid: points to planes, robust, from a start within some metres."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.register.anchor.ground.scan_shape import ScanShape

_WIDTHS_M = (2.0, 2.0, 1.5, 1.5, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.3, 0.3, 0.3)  # of the loss, round by round
_FINE_M, _FINE_ROUNDS, _SETTLED = 0.3, 10, 1e-4
_LEAST_REACH_M = 1.5  # of a point from what is known of the solid
_MOST_TURN = 0.1  # of a step: radians, and of the size
_DAMPING = 1e-3
_UPRIGHT = 0.5  # rise of a wall's normal, at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolidFit:
    """Attributes:
    local_from_own: similarity.
    off_m: (n,) distances of the points from the solid's planes. near_m: (n,) from its nearest point.
    placed: (n, 3) the points there.
    normal: (7, 7) of the left perturbation about `middle`, for residuals of one metre. middle: (3,).
    by_walls: (7,) what a metre of all walls outwards adds to its right side.
    """

    local_from_own: Sim3
    off_m: FloatArray
    near_m: FloatArray
    placed: FloatArray
    normal: FloatArray
    by_walls: FloatArray
    middle: FloatArray


def distances(shape: ScanShape, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Signed distances (n,) from the planes next to points (n, 3), from their points, and their normals."""
    near_m, index = (np.asarray(found) for found in shape.tree.query(points))
    normals = shape.normals[index]
    off = np.einsum("ij,ij->i", normals, points - shape.points[index])
    return np.asarray(off), near_m, np.asarray(normals)


def fitted(
    shape: ScanShape,
    own: FloatArray,
    weight: FloatArray,
    start: Sim3,
    *,
    prior: FloatArray | None = None,
    widths: tuple[float, ...] = _WIDTHS_M,
) -> SolidFit:
    """The similarity that lays points (n, 3) of a map on a scan's solid.

    Args:
        weight: (n,) of the points. prior: (7, 7) information of the start, left perturbation about the
            middle of the points.
    """
    sim = start
    for k in range(len(widths) + _FINE_ROUNDS if widths else 0):
        width = widths[k] if k < len(widths) else widths[-1]
        step, middle = _step(shape, sim.act(own), weight, width, prior)[:2]
        about = Sim3(scale=1.0, rotation=np.eye(3), translation=middle)
        sim = about @ Sim3.exp(step) @ about.inverse() @ sim
        if k >= len(widths) and float(np.abs(step).max()) < _SETTLED:
            break
    placed = sim.act(own)
    off, near_m, _ = distances(shape, placed)
    _, middle, normal, by_walls = _step(shape, placed, weight, widths[-1] if widths else _FINE_M, None)
    return SolidFit(
        local_from_own=sim,
        off_m=off,
        near_m=near_m,
        placed=placed,
        normal=normal,
        middle=middle,
        by_walls=by_walls,
    )


def _step(
    shape: ScanShape, placed: FloatArray, weight: FloatArray, width: float, prior: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The step about the middle of the points, that middle, the normal matrix, and what walls add."""
    middle = np.average(placed, axis=0, weights=weight)
    off, near_m, normals = distances(shape, placed)
    root = weight / (1.0 + np.square(off / width)) ** 2
    root = np.where(near_m < max(4.0 * width, _LEAST_REACH_M), root, 0.0)
    jacobian = np.einsum("ij,ijk->ik", normals, point_jacobian(placed - middle))
    normal = jacobian.T @ (jacobian * root[:, None])
    damping = np.eye(7) * _DAMPING if prior is None else prior
    step = np.linalg.solve(normal + damping, -jacobian.T @ (root * off))
    step[:4] = np.clip(step[:4], -_MOST_TURN, _MOST_TURN)
    return step, middle, normal, jacobian.T @ (root * (np.abs(normals[:, 2]) < _UPRIGHT))
