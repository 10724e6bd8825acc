"""Points of a scan as the renderer wants them: in a local frame, ordered by nodes of levels of detail."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.compiled import compiled_module
from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import freeze

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


UNCLASSIFIED = 1  # ASPRS class of points that nobody classified


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudNodes:
    """Runs of points that are drawn together or not at all.

    Levels add up: each point is in one node, and what a finer level adds lies in its own nodes. Drawing all
    nodes of levels 0..l gives a cloud whose points are about `spacing` of level l apart; drawing all levels
    gives the scan.

    Attributes:
        start, count: (k,) int64, rows of the cloud; nodes follow each other without gaps.
        level: (k,) int16, 0 is the coarsest.
        spacing_m: (k,) float32, distance between neighbouring points when this level and all coarser ones
            are drawn.
        box_min, box_max: (k, 3) float32, corners of the box around the node's points, local frame, metres.
    """

    start: NDArray[np.int64]
    count: NDArray[np.int64]
    level: NDArray[np.int16]
    spacing_m: NDArray[np.float32]
    box_min: NDArray[np.float32]
    box_max: NDArray[np.float32]

    def __post_init__(self) -> None:
        k = len(self.start)
        freeze(self, np.int64, start=(k,), count=(k,))
        freeze(self, np.int16, level=(k,))
        freeze(self, np.float32, spacing_m=(k,), box_min=(k, 3), box_max=(k, 3))
        ends = np.concatenate([[0], self.start + self.count])
        if (self.count < 1).any() or not np.array_equal(ends[:-1], self.start):
            raise InvalidValueError("CloudNodes: expected non-empty runs that follow each other from row 0")

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCloud:
    """A scan, or the part of one that was loaded, in a local frame.

    Attributes:
        frame: the local east-north-up frame of `xyz`.
        height_datum: vertical datum of the scan, see featuredb.geo.datum.
        xyz: (n, 3) float32 metres.
        rgb: (n, 3) uint8, or None where the scan has no colour.
        intensity: (n,) uint8, stretched over the scan's range (see featuredb.lidar), or None.
        classification: (n,) uint8, ASPRS classes; UNCLASSIFIED where the file says nothing. Noise (7, 18) is
            not in here.
        nodes: levels of detail and culling.
        spacing_m: (n,) float32, distance between neighbouring points of the whole scan around each point
            (see featuredb.render.cloud.point_spacing), or None: the nodes' spacings are taken, which are
            those of the dense parts where a node holds dense and sparse surfaces, as roofs and walls.
    """

    frame: LocalFrame
    height_datum: str
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None
    intensity: NDArray[np.uint8] | None
    classification: NDArray[np.uint8]
    nodes: CloudNodes
    spacing_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        n = len(self.xyz)
        # Scans are large: arrays that are right already are taken over, not copied.
        for name, shape, dtype in (
            ("xyz", (n, 3), np.float32),
            ("rgb", (n, 3), np.uint8),
            ("intensity", (n,), np.uint8),
            ("classification", (n,), np.uint8),
            ("spacing_m", (n,), np.float32),
        ):
            value = getattr(self, name)
            if value is None and name in ("rgb", "intensity", "spacing_m"):
                continue
            if value.shape != shape or value.dtype != dtype:
                raise InvalidValueError(
                    f"PointCloud.{name}: expected {shape} {np.dtype(dtype)}, "
                    f"found {value.shape} {value.dtype}"
                )
        if int(self.nodes.count.sum()) != n:
            raise InvalidValueError(
                f"PointCloud: expected nodes with {n} points, found {int(self.nodes.count.sum())}"
            )

    def __len__(self) -> int:
        return len(self.xyz)
