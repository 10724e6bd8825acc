"""How far apart the points of a scan are."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.compiled import compiled_module

_CODE_BITS = 21  # per axis in a 63-bit code
_PROBE_POINTS = 16.0  # points per probing cell: enough that its spacing is known to an eighth or so


def point_spacing(xyz: ArrayLike) -> NDArray[np.float32]:
    """(n,) float32 metres: how far apart neighbouring points are around each of the points (n, 3).

    What PointCloud.spacing_m holds. Points in any order.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float32)
    if len(points) == 0:
        return np.empty(0, np.float32)
    origin = points.min(axis=0).astype(np.float64)
    by_code, codes, cell_m = _sorted_by_code(points, origin, float((points.max(axis=0) - origin).max()))
    spacing = np.empty(len(points), np.float32)
    spacing[by_code] = compiled_module("featuredb.render.loops.level_loops").spacing_of_codes(codes, cell_m)
    return spacing


def _sorted_by_code(
    points: NDArray[np.float32], origin: NDArray[np.float64], extent: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], float]:
    """Rows by Morton code, their codes, and the codes' cell edge: the scan's own spacing in metres."""
    loops = compiled_module("featuredb.render.loops.level_loops")
    # Codes may not overflow, and float32 has no finer steps than this either.
    finest_m = max(extent, 1e-3) / (2**_CODE_BITS - 1)
    codes = loops.morton_codes(points, origin, finest_m)
    by_code = np.argsort(codes, kind="stable")
    codes = codes[by_code]
    spacing, edge = finest_m, finest_m
    for shift in range(_CODE_BITS):
        cells = loops.occupied(codes, 3 * shift)
        edge = finest_m * 2.0**shift
        if len(codes) / cells >= _PROBE_POINTS:
            spacing = edge * float(np.sqrt(cells / len(codes)))
            break
    else:
        spacing = edge  # a handful of points: one level
    cell_m = max(spacing, finest_m)
    codes = loops.morton_codes(points, origin, cell_m)
    by_code = np.argsort(codes, kind="stable")
    return by_code, codes[by_code], cell_m
