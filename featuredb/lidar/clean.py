"""One block of a scan: outliers out, colours and intensities as bytes, ordered by level and node."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.lidar.formats.ortho_image import OrthoImage
from featuredb.lidar.levels import order_by_level
from featuredb.lidar.ortho import colour_by_ortho, margin_m
from featuredb.lidar.outliers import OutlierOptions, find_outliers
from featuredb.lidar.spill import SPILLED, Spill, TileBlock
from featuredb.lidar.staged import BlockPlan
from featuredb.store.scans import POINT_ROW


def clean_block(
    spill: Spill,
    plan: BlockPlan,
    block: TileBlock,
    outliers: OutlierOptions | None,
    ortho: OrthoImage | None,
    epsg: int,
) -> tuple[NDArray[Any], int]:
    """The rows of a block as they go into the store, and how many outliers were dropped.

    Args:
        ortho: colours the points. epsg: zone of the points.

    Returns:
        (n,) POINT_ROW, by level and node; n may be 0.
    """
    colour_m = 0.0 if ortho is None else margin_m(plan.spacing_m)
    rows, core, dropped = _without_outliers(spill, plan, block, outliers, colour_m)
    rgb, has_rgb = _colours(rows, plan.colour_bits)
    if ortho is not None:
        # Where the image does not show a point, it keeps its colour, if it has one. With one spacing for all
        # blocks, none hides more.
        rgb, seen = colour_by_ortho(rows["utm"], epsg, rgb, ortho, plan.spacing_m)
        has_rgb = has_rgb | seen
    rows, rgb, has_rgb = rows[:core], rgb[:core], has_rgb[:core]
    cleaned = np.zeros(core, POINT_ROW)
    if not core:
        return cleaned, dropped
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
    return cleaned, dropped


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
