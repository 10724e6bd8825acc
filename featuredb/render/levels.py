"""Orders the points of a scan into levels of detail and nodes that are drawn together."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.render.cloud import UNCLASSIFIED, CloudNodes, PointCloud
from featuredb.render.compiled import compiled_module

# In a cell that tells a point's spacing: fewer make it uncertain by more than a third, more blur the step
# from a dense roof to a sparse wall.
_NEIGHBOURS = 8
_CODE_BITS = 21  # per axis in a 63-bit code
_PROBE_POINTS = 16.0  # points per probing cell: enough that its spacing is known to an eighth or so
# Levels are added until the coarsest has at most this many points: drawing them costs less than a
# millisecond.
_COARSEST_POINTS = 4000
# A node is a cell of 2^5 spacings of its level along each edge: about a thousand points of a surface, cheap
# to cull and small beside a camera's view.
_NODE_BITS = 5


def build_cloud(
    frame: LocalFrame,
    height_datum: str,
    xyz: ArrayLike,
    rgb: ArrayLike | None = None,
    intensity: ArrayLike | None = None,
    classification: ArrayLike | None = None,
) -> PointCloud:
    """A cloud whose points are ordered into levels, each with half the spacing of the one before.

    Level l has one point in each cell of its spacing where no coarser level has one already; the finest
    level has all that is left. The result is a permutation of the input, the same for the same input.

    Args:
        frame: local frame of `xyz`.
        height_datum: vertical datum of the scan, see featuredb.geo.datum.
        xyz: (n, 3) metres, n >= 1.
        rgb: (n, 3) uint8, or None.
        intensity: (n,) uint8, or None.
        classification: (n,) uint8 ASPRS classes, or None for a scan without.

    Raises:
        InvalidValueError: no points, wrong shapes, coordinates that are not finite.
        MissingExtraError: numba is not installed.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InvalidValueError(f"build_cloud: expected points (n, 3) with n >= 1, found {points.shape}")
    if not np.isfinite(points).all():
        raise InvalidValueError("build_cloud: expected finite coordinates, found NaN or infinity")
    order, nodes, spacing = _order(points)
    n = len(points)
    classes = np.full(n, UNCLASSIFIED, np.uint8) if classification is None else classification
    return PointCloud(
        frame=frame,
        height_datum=height_datum,
        xyz=points[order],
        rgb=None if rgb is None else _bytes("rgb", rgb, (n, 3))[order],
        intensity=None if intensity is None else _bytes("intensity", intensity, (n,))[order],
        classification=_bytes("classification", classes, (n,))[order],
        nodes=nodes,
        spacing_m=spacing,
    )


def point_spacing(xyz: ArrayLike) -> NDArray[np.float32]:
    """(n,) float32 metres: how far apart neighbouring points are around each of the points (n, 3).

    What PointCloud.spacing_m holds; `build_cloud` fills it. Points in any order.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float32)
    if len(points) == 0:
        return np.empty(0, np.float32)
    origin = points.min(axis=0).astype(np.float64)
    by_code, codes, cell_m = _sorted_by_code(points, origin, float((points.max(axis=0) - origin).max()))
    spacing = np.empty(len(points), np.float32)
    spacing[by_code] = _spacing(codes, cell_m)
    return spacing


def _spacing(codes: NDArray[np.int64], cell_m: float) -> NDArray[np.float32]:
    loops = compiled_module("featuredb.render.loops.level_loops")
    spacing: NDArray[np.float32] = loops.spacing_of_codes(codes, cell_m, _NEIGHBOURS)
    return spacing


def _bytes(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    array = np.asarray(value)
    if array.shape != shape or array.dtype != np.uint8:
        raise InvalidValueError(
            f"build_cloud: {name}: expected {shape} uint8, found {array.shape} {array.dtype}"
        )
    return array


def _order(
    points: NDArray[np.float32],
) -> tuple[NDArray[np.int64], CloudNodes, NDArray[np.float32]]:
    """The rows in drawing order, the nodes, and the spacing around each row in that order."""
    loops = compiled_module("featuredb.render.loops.level_loops")
    origin = points.min(axis=0).astype(np.float64)
    extent = float((points.max(axis=0) - origin).max())
    by_code, codes, cell_m = _sorted_by_code(points, origin, extent)
    finest = _level_count(codes)
    level = loops.assign_levels(points[by_code], codes, origin, cell_m, finest)
    runs = [loops.node_runs(codes, level, k, finest, _NODE_BITS, cell_m) for k in range(finest + 1)]
    by_level = np.argsort(level, kind="stable")
    order = by_code[by_level]
    count = np.concatenate([counts for counts, _ in runs])
    start = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    low, high = loops.node_boxes(points[order], start, count)
    nodes = CloudNodes(
        start=start,
        count=count,
        level=np.repeat(np.arange(finest + 1, dtype=np.int16), [len(counts) for counts, _ in runs]),
        spacing_m=np.concatenate([spacings for _, spacings in runs]),
        box_min=low,
        box_max=high,
    )
    return order, nodes, _spacing(codes, cell_m)[by_level]


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


def _level_count(codes: NDArray[np.int64]) -> int:
    """The number of the finest level, when level 0 has at most that many points."""
    loops = compiled_module("featuredb.render.loops.level_loops")
    finest = 0
    while finest < _CODE_BITS and loops.occupied(codes, 3 * finest) > _COARSEST_POINTS:
        finest += 1
    return finest
