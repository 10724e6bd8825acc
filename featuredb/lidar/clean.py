"""One block of a scan: outliers out, colours and intensities as bytes, ordered by level and node."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.lidar.levels import order_by_level
from featuredb.lidar.outliers import OutlierOptions, find_outliers
from featuredb.lidar.spill import Block, Spill
from featuredb.lidar.staged import BlockPlan
from featuredb.store.scans import POINT_ROW


def clean_block(
    spill: Spill, plan: BlockPlan, block: Block, outliers: OutlierOptions | None
) -> tuple[NDArray[Any], int]:
    """The rows of a block as they go into the store, and how many outliers were dropped.

    Returns:
        (n,) POINT_ROW, by level and node; n may be 0.
    """
    rows, dropped = _without_outliers(spill, plan, block, outliers)
    cleaned = np.zeros(len(rows), POINT_ROW)
    if not len(rows):
        return cleaned, dropped
    order = order_by_level(rows["utm"], plan.finest_level)
    rows = rows[order.order]
    cleaned["utm"] = rows["utm"]
    cleaned["rgb"], cleaned["has_rgb"] = _colours(rows, plan.colour_bits)
    if plan.stretch is not None:
        cleaned["intensity"] = plan.stretch.apply(rows["intensity"])
    cleaned["classification"] = rows["classification"]
    cleaned["level"] = order.level
    cleaned["node"] = order.node
    cleaned["node_spacing_m"] = order.spacing_m
    return cleaned, dropped


def _without_outliers(
    spill: Spill, plan: BlockPlan, block: Block, outliers: OutlierOptions | None
) -> tuple[NDArray[Any], int]:
    if outliers is None:
        return spill.rows(block), 0
    core, around = spill.with_margin(block, plan.blocks, outliers.margin_m(plan.spacing_m))
    utm = np.concatenate([core["utm"], around["utm"]])
    utm -= core["utm"][0]
    drop = find_outliers(utm, len(core), plan.spacing_m, outliers)
    return core[~drop], int(drop.sum())


def _colours(rows: NDArray[Any], colour_bits: tuple[int, ...]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (n, 3) as bytes, by the range that the point's file uses, and which points have one."""
    bits = np.array(colour_bits, np.int64)[rows["file"]]
    wide = (rows["rgb"] >> np.where(bits == 16, 8, 0).astype(np.uint16)[:, None]).astype(np.uint8)
    return wide, bits > 0
