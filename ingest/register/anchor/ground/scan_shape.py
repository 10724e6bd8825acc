"""A scan as a solid, ground, roofs and the walls that stand where its heights jump; and a map laid on it.

A map is laid on it by its points' distances from planes, robust, from a start within some metres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_erosion,
    distance_transform_edt,
    gaussian_filter,
    grey_opening,
    median_filter,
    minimum_filter,
)
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.ground.facades import on_lines

Circle = tuple[float, float, float]  # x, y, radius

CELL_M = 0.5
_VEGETATION = (3, 4, 5)  # ASPRS: crowns are no fronts, and people stand under them
_WIDEST_M = 30.0  # of a building across: ground is what is left of heights that are narrower
_JUMP_M = 2.0  # between cells, of a wall
HIGH_M = 2.5  # over the ground: nobody looks through it
_RAY_STEPS = 60
_STEP_M = 0.5  # between points of a wall
_SMOOTH_CELLS = 1.5  # of the heights whose gradient says where a wall looks
_SLOPE_CELLS = 0.7  # of the heights whose gradient is a surface's normal
_FLAT_M = 0.5  # between cells of one surface
_FINE_M, _FINE_ROUNDS, _SETTLED = 0.3, 10, 1e-4  # width of the loss, rounds with the last width
_LEAST_REACH_M = 1.5  # of a point from what is known of the solid
_MOST_TURN = 0.1  # of a step: radians, and of the size
_UPRIGHT = 0.5  # rise of a wall's normal, at most


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanShape:
    """Rows northwards: the middle of cell (row, column) lies (column + 0.5, row + 0.5) cells from `corner`.

    Attributes:
        corner: (2,) metres, in the cloud's frame.
        ground, top: (h, w) heights, metres. known: (h, w), where the scan has points near.
        built: (h, w), what nobody looks through: no border of a building.
        points, normals: (n, 3) of ground, roofs and walls. tree: of the points.
        walls: (k, 4) of wall cells: x, y, and the way out of the wall.
    """

    corner: FloatArray
    ground: FloatArray
    top: FloatArray
    known: NDArray[np.bool_]
    built: NDArray[np.bool_]
    points: FloatArray
    normals: FloatArray
    tree: cKDTree
    walls: FloatArray

    def cells(self, xy: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of places (n, 2), those outside at the border."""
        at = np.floor((xy - self.corner) / CELL_M).astype(np.int64)
        return np.clip(at[:, 1], 0, self.top.shape[0] - 1), np.clip(at[:, 0], 0, self.top.shape[1] - 1)

    def inside(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Whether the scan shows places (n, 2)."""
        at = (xy - self.corner) / CELL_M
        there = ((at >= 0) & (at < np.array(self.top.shape[::-1]))).all(axis=1)
        return np.asarray(there & self.known[self.cells(xy)])

    def through(self, rays: FloatArray) -> float:
        """Share of rays (r, 4), from x, y to x, y, that go through buildings."""
        along = np.linspace(0.0, 1.0, _RAY_STEPS)[:, None, None]
        at = rays[:, :2] + along * (rays[:, 2:] - rays[:, :2])
        inside = self.built[self.cells(at.reshape(-1, 2))].reshape(_RAY_STEPS, -1)
        return float(inside.any(axis=0).mean())


def shape_of(cloud: PointCloud, circle: Circle | None) -> ScanShape | None:
    """The solid that a scan shows within a circle; None where it shows no surface."""
    shown = ~np.isin(cloud.classification, _VEGETATION)
    if circle is not None:
        shown &= np.hypot(cloud.xyz[:, 0] - circle[0], cloud.xyz[:, 1] - circle[1]) < circle[2]
    xyz = cloud.xyz[shown].astype(np.float64)
    if len(xyz) < 100:
        return None
    corner = np.floor(xyz[:, :2].min(axis=0))
    size = np.ceil((xyz[:, :2].max(axis=0) - corner) / CELL_M).astype(np.int64) + 1
    at = np.floor((xyz[:, :2] - corner) / CELL_M).astype(np.int64)
    flat = at[:, 1] * size[0] + at[:, 0]
    top, lowest = np.full(size[::-1], -np.inf), np.full(size[::-1], np.inf)
    np.maximum.at(top.reshape(-1), flat, xyz[:, 2])
    np.minimum.at(lowest.reshape(-1), flat, xyz[:, 2])
    seen = np.isfinite(top)
    top, known = _filled(top, seen)
    top = median_filter(top, 3)
    low = median_filter(minimum_filter(_filled(lowest, seen)[0], 3), 5)
    window = int(_WIDEST_M / CELL_M) | 1
    ground = gaussian_filter(grey_opening(low, (window, window)), 4.0)
    walls = _walls(top, known, corner, xyz)
    surface, surface_normals = _surfaces(xyz, flat, top, lowest, seen)
    upright, upright_normals = _standing(walls)
    points = np.vstack([surface, upright])
    return ScanShape(
        corner=corner,
        ground=ground,
        top=top,
        known=known,
        built=binary_erosion((top - ground > HIGH_M) & known),
        points=points,
        normals=np.vstack([surface_normals, upright_normals]),
        tree=cKDTree(points),
        walls=walls[:, :4],
    )


def _filled(heights: FloatArray, seen: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Gaps filled from the nearest cell with points, and which cells have one within 2 m."""
    away, (row, column) = distance_transform_edt(~seen, return_indices=True)
    return heights[row, column], np.asarray(away * CELL_M <= 2.0)


def _surfaces(
    xyz: FloatArray,
    cell_of: NDArray[np.int64],
    top: FloatArray,
    lowest: FloatArray,
    seen: NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray]:
    """Middles of the points of cells that lie on ground or roofs and are no edge, and their normals."""
    count = np.maximum(np.bincount(cell_of, minlength=top.size), 1)
    middle = np.column_stack([np.bincount(cell_of, xyz[:, k], top.size) / count for k in range(3)])
    steps = [np.abs(np.diff(top, axis=axis)) < _FLAT_M for axis in (0, 1)]
    smooth = seen.copy()
    smooth[:-1] &= steps[0]
    smooth[1:] &= steps[0]
    smooth[:, :-1] &= steps[1]
    smooth[:, 1:] &= steps[1]
    smooth &= top - lowest < 2.0 * _FLAT_M
    heights = np.where(seen, middle[:, 2].reshape(top.shape), top)
    up, across = np.gradient(gaussian_filter(heights, _SLOPE_CELLS), CELL_M)
    normals = np.column_stack([-across[smooth], -up[smooth], np.ones(np.count_nonzero(smooth))])
    return middle[smooth.ravel()], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _walls(top: FloatArray, known: NDArray[np.bool_], corner: FloatArray, xyz: FloatArray) -> FloatArray:
    """(k, 6): place in plan, way out, lower and upper height, between cells whose heights jump."""
    smooth = gaussian_filter(top, _SMOOTH_CELLS)
    up, across = (np.asarray(np.gradient(smooth, axis=axis)) for axis in (0, 1))
    found = []
    for axis in (0, 1):
        step = np.diff(top, axis=axis)
        both = known[:-1] & known[1:] if axis == 0 else known[:, :-1] & known[:, 1:]
        rows, columns = np.nonzero((np.abs(step) > _JUMP_M) & both)
        next_row, next_column = (rows + 1, columns) if axis == 0 else (rows, columns + 1)
        middle = 0.5 * np.column_stack([columns + next_column, rows + next_row]) + 0.5
        here, there = (rows, columns), (next_row, next_column)
        out = -np.column_stack([across[here] + across[there], up[here] + up[there]])
        heights = np.sort(np.column_stack([top[rows, columns], top[next_row, next_column]]), axis=1)
        found.append(np.column_stack([corner + middle * CELL_M, out, heights]))
    walls = np.vstack(found)
    walls[:, 2:4] /= np.maximum(np.linalg.norm(walls[:, 2:4], axis=1, keepdims=True), 1e-9)
    return on_lines(walls, xyz)


def _standing(walls: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points one above the other on walls, and their normals."""
    counts = np.maximum(((walls[:, 5] - walls[:, 4]) / _STEP_M).astype(np.int64), 1)
    of = np.repeat(np.arange(len(walls)), counts)
    within = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
    heights = walls[of, 4] + (within + 0.5) * _STEP_M
    return np.column_stack([walls[of, :2], heights]), np.column_stack([walls[of, 2:4], np.zeros(len(of))])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolidFit:
    """Points of a map on a scan's solid.

    Attributes:
        local_from_own: similarity. placed: (n, 3) the points there. middle: (3,) of them.
        eaves_m: by how much the solid's walls lie outside of the fronts.
        off_m: (n,) distances of the points from the solid's planes. near_m: (n,) from its nearest point;
            infinite where none is within reach.
        normal, right: (8, 8) and (8,) equations of the step that lessens `off_m`: of the left perturbation
            about `middle`, and of `eaves_m`.
    """

    local_from_own: Sim3
    eaves_m: float
    placed: FloatArray
    middle: FloatArray
    off_m: FloatArray
    near_m: FloatArray
    normal: FloatArray
    right: FloatArray


def laid(
    shape: ScanShape, own: FloatArray, local_from_own: Sim3, eaves_m: float = 0.0, width_m: float = _FINE_M
) -> SolidFit:
    """How points (n, 3) of a map lie on a scan's solid; `width_m` of the loss by which they are weighed."""
    placed = local_from_own.act(own)
    middle = placed.mean(axis=0)
    reach_m = max(4.0 * width_m, _LEAST_REACH_M)  # a tree finds at once that nothing is near
    near_m, index = (np.asarray(found) for found in shape.tree.query(placed, distance_upper_bound=reach_m))
    index = np.where(np.isfinite(near_m), index, 0)  # of points that nothing is near, which count for nothing
    normals = shape.normals[index]
    stands = np.abs(normals[:, 2]) < _UPRIGHT
    off_m = np.einsum("ij,ij->i", normals, placed - shape.points[index]) + eaves_m * stands
    weight = 1.0 / (1.0 + np.square(off_m / width_m)) ** 2
    weight = np.where(np.isfinite(near_m), weight, 0.0)
    by_place = np.einsum("ij,ijk->ik", normals, point_jacobian(placed - middle))
    jacobian = np.column_stack([by_place, stands])
    return SolidFit(
        local_from_own=local_from_own,
        eaves_m=eaves_m,
        placed=placed,
        middle=middle,
        off_m=off_m,
        near_m=near_m,
        normal=jacobian.T @ (jacobian * weight[:, None]),
        right=-jacobian.T @ (weight * off_m),
    )


def fitted(
    shape: ScanShape, own: FloatArray, start: Sim3, prior: FloatArray, widths_m: tuple[float, ...]
) -> SolidFit:
    """The similarity, and the eaves, that lay points (n, 3) of a map on a scan's solid.

    Args:
        prior: (8, 8) information of the start, left perturbation about the middle of the points, and of no
            eaves at all.
        widths_m: of the loss, round by round; the last one until the similarity settles.
    """
    sim, eaves_m = start, 0.0
    for k in range(len(widths_m) + _FINE_ROUNDS):
        fit = laid(shape, own, sim, eaves_m, widths_m[min(k, len(widths_m) - 1)])
        step = np.linalg.solve(fit.normal + prior, fit.right - prior[:, 7] * eaves_m)
        step[:4] = np.clip(step[:4], -_MOST_TURN, _MOST_TURN)
        sim, eaves_m = Sim3.exp(step[:7]).about(fit.middle) @ sim, eaves_m + float(step[7])
        if k >= len(widths_m) and float(np.abs(step).max()) < _SETTLED:
            break
    return laid(shape, own, sim, eaves_m, widths_m[-1])
