"""Levels of detail of the store: which level and node a point goes to.

The grid is the same for all scans and tiles: cells of level l
have an edge of 4 m / 2^l and are counted from zero of UTM, so that pieces of a scan give what the whole
would.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module
from featuredb.geometry.arrays import FloatArray

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
