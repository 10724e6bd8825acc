"""Straight walls where the heights of a scan jump, as far out as its roofs go.

Cells make stairs of a wall, and a roof's points end where they happen to. A whole front tells its direction
and place better than a part of it: a line that leaves a twentieth of the roof's points outside (quantile
regression, Koenker and Bassett 1978), moved out by the depth that these take.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray

_AROUND_M = 3.0  # of a cell: others that give its line a start
_BAND_M = 0.6  # of a line: a stair of cells to both sides
_GAP_M = 1.6  # along it: the next wall
_ALIKE = 0.7  # cosine between the ways out of one wall's cells
_LEAST_CELLS, _LEAST_M, _LEAST_POINTS = 3, 2.0, 8  # of a wall
_ROUNDS = 8  # of a line and its cells
_ROOF_M = 1.5  # of a roof, inwards and outwards of its line
_INSIDE = 0.95  # of these points
_FITS, _SETTLED, _LEAST_OFF_M = 60, 1e-5, 0.01
_STEADY = 0.5  # square metres: no line turns by less than its points along it tell


def on_lines(walls: FloatArray, xyz: FloatArray) -> FloatArray:
    """Cells of walls (k, 6) moved to straight lines along roofs; those that are on no line are left out.

    Args:
        walls: place in plan, way out, lower and upper height. xyz: (n, 3) of the scan.
    """
    if not len(walls):
        return walls
    near = cKDTree(walls[:, :2]).query_ball_point(walls[:, :2], _AROUND_M)
    alike = [int((walls[rows, 2:4] @ walls[k, 2:4] > _ALIKE).sum()) for k, rows in enumerate(near)]
    tree, left = cKDTree(xyz[:, :2]), np.ones(len(walls), dtype=np.bool_)
    found = [walls[:0]]
    for k in np.argsort(-np.array(alike), kind="stable").tolist():
        if not left[k]:
            continue
        cells = _of_one_line(walls, left, k, np.array(near[k]))
        left[cells] = False
        left[k] = False
        if len(cells) >= _LEAST_CELLS:
            found.append(_at_the_roof(walls[cells], xyz, tree))
    return np.vstack(found)


def _of_one_line(
    walls: FloatArray, left: NDArray[np.bool_], first: int, near: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Rows of the cells that are left, hang together with the first, and lie on one line."""
    rows = near[left[near] & (walls[near, 2:4] @ walls[first, 2:4] > _ALIKE)]
    for _ in range(_ROUNDS):
        if len(rows) < _LEAST_CELLS:
            break
        middle, along, out = _line(walls[rows])
        near_by = left & (np.abs((walls[:, :2] - middle) @ out) < _BAND_M) & (walls[:, 2:4] @ out > _ALIKE)
        there = np.flatnonzero(near_by)
        if not len(there):
            return there
        place = (walls[there, :2] - middle) @ along
        order = np.argsort(place, kind="stable")
        run = np.concatenate([[0], np.cumsum(np.diff(place[order]) > _GAP_M)])
        closest = int(np.abs(place[order] - (walls[first, :2] - middle) @ along).argmin())
        now = np.sort(there[order[run == run[closest]]])
        if np.array_equal(now, rows):
            break
        rows = now
    return rows


def _line(cells: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middle (2,), the way along and the way out of cells (k, 6)."""
    middle = cells[:, :2].mean(axis=0)
    off = cells[:, :2] - middle
    along = np.linalg.eigh(off.T @ off)[1][:, 1]
    out = np.array([-along[1], along[0]])
    return middle, along, out * (np.sign(out @ cells[:, 2:4].sum(axis=0)) or 1.0)


def _at_the_roof(cells: FloatArray, xyz: FloatArray, tree: cKDTree) -> FloatArray:
    """The cells of a line moved to where its roof ends; none of a short one, or where no roof is seen."""
    middle, along, out = _line(cells)
    place = (cells[:, :2] - middle) @ along
    low, high = float(place.min()), float(place.max())
    around = tree.query_ball_point(
        middle + 0.5 * (low + high) * along, float(np.hypot(0.5 * (high - low), _ROOF_M))
    )
    points = xyz[np.sort(np.array(around, dtype=np.int64))]
    s, d = ((points[:, :2] - middle) @ way for way in (along, out))
    roof = (points[:, 2] > np.median(cells[:, 4:].mean(axis=1))) & (s >= low) & (s <= high)
    roof &= np.abs(d) < _ROOF_M
    if high - low < _LEAST_M or np.count_nonzero(roof) < _LEAST_POINTS:
        return cells[:0]
    base, slope = _quantile_line(s[roof], d[roof])
    inside, half = np.quantile(d[roof] - base - slope * s[roof], [_INSIDE, 0.5])
    outermost = base + (inside - half) / (_INSIDE - 0.5) * (1.0 - _INSIDE)
    moved = cells.copy()
    moved[:, :2] = middle + place[:, None] * along + (outermost + slope * place)[:, None] * out
    moved[:, 2:4] = (out - slope * along) / np.hypot(1.0, slope)
    return moved


def _quantile_line(s: FloatArray, d: FloatArray) -> tuple[float, float]:
    """Base and slope of the line d(s) that a share of `_INSIDE` of points (n,) lies below."""
    ahead = np.column_stack([np.ones_like(s), s])
    found = np.array([np.quantile(d, _INSIDE), 0.0])
    for _ in range(_FITS):
        off = d - ahead @ found
        weight = np.where(off > 0, _INSIDE, 1.0 - _INSIDE) / np.maximum(np.abs(off), _LEAST_OFF_M)
        normal = ahead.T @ (ahead * weight[:, None]) + np.diag([0.0, _STEADY])
        before, found = found, np.linalg.solve(normal, ahead.T @ (weight * d))
        if np.abs(found - before).max() < _SETTLED:
            break
    return float(found[0]), float(found[1])
