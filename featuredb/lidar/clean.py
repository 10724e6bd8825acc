"""One block of a scan: outliers out, colours and intensities as bytes, ordered by level and node.

Outliers are points much farther from their neighbours than those are from theirs.

Levels of detail: the grid is the same for all scans and tiles. Cells of level l have an edge of 4 m / 2^l and
are counted from zero of UTM, so that pieces of a scan give what the whole would.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.compiled import compiled_module
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.ortho_image import OrthoImage
from featuredb.lidar.ortho import colour_by_ortho, margin_m
from featuredb.lidar.spill import SPILLED, BlockPlan, Spill, TileBlock
from featuredb.store.scans import POINT_ROW

# The coarsest level has a point every 4 m: some 16,000 in a tile of flat land, small enough to load for
# kilometres.
COARSEST_SPACING_M = 4.0
FINEST_LEVEL = 12  # 1 mm
# A node is a cube of 2^5 cells of its level: about a thousand points of a surface, cheap to cull and small
# beside a camera's view.
NODE_BITS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelOrder:
    """How the points of a block are to be stored.

    Attributes:
        order: (n,) rows of the block, by level and then by node.
        level: (n,) uint8 in that order.
        node: (n,) int64 in that order; equal for points of one node, differs between neighbours in the order.
        spacing_m: (n,) float32 in that order, see CloudNodes.spacing_m.
    """

    order: NDArray[np.int64]
    level: NDArray[np.uint8]
    node: NDArray[np.int64]
    spacing_m: NDArray[np.float32]


def finest_level(spacing_m: float) -> int:
    """The level that takes all the points that coarser ones have left.

    Its cells are as large as the scan's typical spacing or smaller by less than a half.
    """
    return int(np.clip(np.ceil(np.log2(COARSEST_SPACING_M / max(spacing_m, 1e-6))), 0, FINEST_LEVEL))


def order_by_level(utm: FloatArray, finest: int) -> LevelOrder:
    """Level and node of each point of a block.

    Args:
        utm: (n, 3) float64 metres, n >= 1; a block of at most a tile in plan and 2 km in height.
        finest: number of the last level.
    """
    loops: Any = compiled_module("featuredb.render.loops.level_loops")
    cell_m = COARSEST_SPACING_M / 2.0**finest
    # Nodes of level 0 are the largest cells of the grid: counting from their corners keeps the grid the same
    # for all.
    node_m = COARSEST_SPACING_M * 2**NODE_BITS
    origin = np.floor(utm.min(axis=0) / node_m) * node_m
    local = (utm - origin).astype(np.float32)
    zero = np.zeros(3)
    codes = loops.morton_codes(local, zero, cell_m)
    by_code = np.argsort(codes, kind="stable")
    codes, local = codes[by_code], local[by_code]
    level = loops.assign_levels(local, codes, zero, cell_m, finest)
    by_level = np.argsort(level, kind="stable")
    shift = 3 * (finest - level.astype(np.int64) + NODE_BITS)
    runs = [
        loops.node_runs(codes, level, current, finest, NODE_BITS, cell_m) for current in range(finest + 1)
    ]
    count = np.concatenate([count for count, _ in runs])
    spacing = np.concatenate([spacing for _, spacing in runs])
    return LevelOrder(
        order=by_code[by_level],
        level=level[by_level],
        node=(codes >> shift)[by_level],
        spacing_m=np.repeat(spacing, count).astype(np.float32),
    )


_QUERY_ROWS = 100_000  # neighbours of this many points at a time: 15 MB
_SORTED_CELLS = 8.0  # cells per reach when points are sorted: about as many as there are neighbours


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlierOptions:
    """Which points are outliers.

    Attributes:
        neighbours: how many nearest neighbours are looked at.
        fewest: a point with fewer of them in reach is an outlier: alone, or a pair of birds.
        ratio: a point is one if the mean distance to its neighbours is this many times the median of theirs.
        reach_spacings: neighbours are looked for within this many of the scan's spacings, ...
        shortest_reach_m: ... but at least this far.
    """

    # Eight, as many as surround a point of a grid.
    neighbours: int = 8
    fewest: int = 4
    # A ratio of neighbours and no distance: scans are denser near the scanner and where strips overlap, and a
    # distance that is odd in one place is usual in another. docs/measurements/lidar.md has the distributions.
    ratio: float = 5.0
    reach_spacings: float = 12.0
    shortest_reach_m: float = 1.0

    def reach_m(self, spacing_m: float) -> float:
        """How far neighbours are looked for, metres."""
        return max(self.shortest_reach_m, self.reach_spacings * spacing_m)

    def margin_m(self, spacing_m: float) -> float:
        """How far around a block points decide on its own: neighbours, and their neighbours."""
        return 2.0 * self.reach_m(spacing_m)


def clean_block(
    spill: Spill,
    plan: BlockPlan,
    block: TileBlock,
    outliers: OutlierOptions | None,
    ortho: OrthoImage | None,
    epsg: int,
) -> tuple[NDArray[Any], int, int]:
    """The rows of a block as they go into the store, and how many outliers were dropped and points coloured.

    Args:
        ortho: colours the points. epsg: zone of the points.

    Returns:
        (n,) POINT_ROW, by level and node; n may be 0.
    """
    colour_m = 0.0 if ortho is None else margin_m(plan.spacing_m)
    rows, core, dropped = _without_outliers(spill, plan, block, outliers, colour_m)
    rgb, has_rgb = _colours(rows, plan.colour_bits)
    shown = 0
    if ortho is not None:
        # Where the image does not show a point, it keeps its colour, if it has one. With one spacing for all
        # blocks, none hides more.
        rgb, seen = colour_by_ortho(rows["utm"], epsg, rgb, ortho, plan.spacing_m)
        has_rgb, shown = has_rgb | seen, int(seen[:core].sum())
    rows, rgb, has_rgb = rows[:core], rgb[:core], has_rgb[:core]
    cleaned = np.zeros(core, POINT_ROW)
    if not core:
        return cleaned, dropped, shown
    order = order_by_level(rows["utm"], plan.finest_level)
    rows = rows[order.order]
    cleaned["utm"] = rows["utm"]
    cleaned["rgb"], cleaned["has_rgb"] = rgb[order.order], has_rgb[order.order]
    if plan.stretch is not None:
        cleaned["intensity"] = plan.stretch.apply(rows["intensity"])
    cleaned["classification"] = rows["classification"]
    cleaned["level"] = order.level
    cleaned["node"] = order.node
    cleaned["node_spacing_m"] = order.spacing_m
    return cleaned, dropped, shown


def _without_outliers(
    spill: Spill, plan: BlockPlan, block: TileBlock, outliers: OutlierOptions | None, colour_m: float
) -> tuple[NDArray[Any], int, int]:
    """Points of a block and then up to `colour_m` around it; how many are the block's; its outliers."""
    reach_m = 0.0 if outliers is None else outliers.margin_m(plan.spacing_m)
    around = np.empty(0, SPILLED)
    core = spill.rows(block)
    if reach_m + colour_m > 0.0:
        around = spill.around(block, plan.blocks, reach_m + colour_m)
    near = block.distance_m(around["utm"]) <= colour_m
    rows = np.concatenate([core, around[near], around[~near]])
    asked = len(core) + int(near.sum())
    if outliers is None:
        return rows[:asked], len(core), 0
    drop = find_outliers(rows["utm"] - core["utm"][0], asked, plan.spacing_m, outliers)
    dropped = int(drop[: len(core)].sum())
    return rows[:asked][~drop], len(core) - dropped, dropped


def _colours(rows: NDArray[Any], colour_bits: tuple[int, ...]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (n, 3) as bytes, by the range that the point's file uses, and which points have one."""
    bits = np.array(colour_bits, np.int64)[rows["file"]]
    shift = np.where(bits == 16, 8, 0).astype(np.uint16)
    return (rows["rgb"] >> shift[:, None]).astype(np.uint8), bits > 0


def outlier_ratio(xyz: FloatArray, core: int, reach_m: float, options: OutlierOptions) -> FloatArray:
    """Mean distance to the nearest neighbours, as a multiple of the median of the same of those neighbours.

    Neighbours farther than `reach_m` count as that far away, so that the ratio of a point depends only on
    what lies within twice the reach: pieces of a scan that overlap by that give what the whole scan gives.

    Args:
        xyz: (n, 3) metres.
        core: the ratio is asked for the first `core` points; the others are their surroundings.

    Returns:
        (core,) float64; infinity for a point with less than `options.fewest` neighbours in reach.
    """
    loops: Any = compiled_module("featuredb.render.loops.level_loops")
    local = (xyz - xyz.min(axis=0)).astype(np.float32)
    # Asking for neighbours in the order of space is three times faster than in that of most files.
    order = np.argsort(loops.morton_codes(local, np.zeros(3), reach_m / _SORTED_CELLS), kind="stable")
    points = xyz[order]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    mean = np.empty(len(points) + 1, np.float32)
    mean[-1] = np.nan  # what is not there has row n
    rows = np.empty((len(points), options.neighbours), np.int32)
    for start in range(0, len(points), _QUERY_ROWS):
        part = slice(start, min(start + _QUERY_ROWS, len(points)))
        found: Any = tree.query(points[part], k=options.neighbours + 1, distance_upper_bound=reach_m)
        mean[part] = np.minimum(found[0][:, 1:], reach_m).mean(axis=1)
        rows[part] = found[1][:, 1:]
    ratio = np.full(len(points), np.inf)
    for start in range(0, len(points), _QUERY_ROWS):
        part = slice(start, min(start + _QUERY_ROWS, len(points)))
        some = (rows[part] < len(points)).sum(axis=1) >= options.fewest
        theirs = np.nanmedian(mean[rows[part][some]], axis=1)
        ratio[part][some] = mean[part][some] / np.maximum(theirs, 1e-9)
    unsorted = np.empty(len(points))
    unsorted[order] = ratio
    return unsorted[:core]


def find_outliers(xyz: FloatArray, core: int, spacing_m: float, options: OutlierOptions) -> NDArray[np.bool_]:
    """(core,) bool, which of the first `core` points are outliers; see `outlier_ratio`."""
    return outlier_ratio(xyz, core, options.reach_m(spacing_m), options) > options.ratio
