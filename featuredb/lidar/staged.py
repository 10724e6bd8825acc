"""Finished blocks of a scan, waiting in the work folder to be published together."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import atomic_file
from featuredb.errors import ScanError
from featuredb.lidar.spill import TileBlock
from featuredb.store.encode import Row
from featuredb.store.scans import TileRows
from featuredb.store.tables import BOUNDS

# Tiles are committed together until they have this many points: fewer, larger commits.
_POINTS_PER_COMMIT = 5_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class IntensityStretch:
    """Linear stretch of raw intensities to 0..255; what lies outside is clipped.

    Attributes:
        low, high: raw values that become 0 and 255.
    """

    low: float
    high: float

    def apply(self, raw: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """(n,) uint8 of raw values (n,) uint16."""
        scaled = (raw.astype(np.float32) - self.low) * np.float32(255.0 / (self.high - self.low))
        return np.asarray(np.rint(np.clip(scaled, 0.0, 255.0)), np.uint8)


def stretch_of(
    histogram: NDArray[np.int64], low_percent: float, high_percent: float
) -> IntensityStretch | None:
    """The stretch between two percentiles of all points of a scan.

    Args:
        histogram: (65536,) how often each raw value occurs.
        low_percent, high_percent: percentiles, 0 to 100.

    Returns:
        None where all intensities are the same: the scan has none.
    """
    values = np.flatnonzero(histogram)
    if len(values) < 2:
        return None
    cumulated = np.cumsum(histogram) / histogram.sum() * 100.0
    low = int(np.searchsorted(cumulated, low_percent, side="right"))
    high = int(np.searchsorted(cumulated, high_percent, side="left"))
    if high <= low:  # nearly all are equal: the range of all
        low, high = int(values[0]), int(values[-1])
    return IntensityStretch(low=float(low), high=float(high))


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockPlan:
    """What the first pass has found, and the blocks that the second one works through.

    Attributes:
        read, noise, withheld: points in the files, and those that were dropped at once.
        spacing_m: typical distance between neighbouring points in plan.
        finest_level: number of the last level.
        stretch: of the intensities; None where there are none.
        colour_bits: 0, 8 or 16 for each file.
        blocks: ordered by tile.
    """

    read: int
    noise: int
    withheld: int
    spacing_m: float
    finest_level: int
    stretch: IntensityStretch | None
    colour_bits: tuple[int, ...]
    blocks: tuple[TileBlock, ...]


class Staged:
    """The folder of finished blocks; a block is finished when its JSON is there."""

    def __init__(self, folder: Path, plan: BlockPlan) -> None:
        self._folder = folder
        self._plan = plan
        folder.mkdir(parents=True, exist_ok=True)

    def has(self, block: TileBlock) -> bool:
        """Whether a block is finished."""
        return self._path(block, "json").is_file()

    def put(self, block: TileBlock, rows: NDArray[Any], outliers: int) -> None:
        """Keep a finished block.

        Args:
            rows: (n,) POINT_ROW, by level and node.
            outliers: how many were dropped.
        """
        with atomic_file(self._path(block, "npy")) as temporary, temporary.open("wb") as file:
            np.save(file, rows)
        classes, counts = np.unique(rows["classification"], return_counts=True)
        utm = rows["utm"]
        facts = {
            "points": len(rows),
            "outliers": outliers,
            "levels": np.bincount(rows["level"], minlength=self._plan.finest_level + 1).tolist(),
            "classes": dict(zip(classes.tolist(), counts.tolist(), strict=True)),
            "low": utm.min(axis=0).tolist() if len(utm) else None,
            "high": utm.max(axis=0).tolist() if len(utm) else None,
        }
        with atomic_file(self._path(block, "json")) as temporary:
            temporary.write_text(json.dumps(facts))

    def totals(self) -> Row:
        """What all blocks hold together, by columns of the table `lidar`: counts, and their box in UTM.

        Raises:
            ScanError: no point is left.
        """
        facts = [json.loads(self._path(block, "json").read_text()) for block in self._plan.blocks]
        classes: Counter[int] = Counter()
        for fact in facts:
            classes.update({int(c): n for c, n in fact["classes"].items()})
        points, outliers = sum(f["points"] for f in facts), sum(f["outliers"] for f in facts)
        if points == 0:
            raise ScanError(
                f"expected points that have neighbours, found {outliers} that are all outliers; add the scan "
                "with --keep-outliers if they are meant"
            )
        low = np.min([f["low"] for f in facts if f["low"]], axis=0)
        high = np.max([f["high"] for f in facts if f["high"]], axis=0)
        return {
            **dict(zip(BOUNDS, (*low.tolist(), *high.tolist()), strict=True)),
            "points": points,
            "dropped_outliers": outliers,
            "level_points": np.sum([f["levels"] for f in facts], axis=0).tolist(),
            "classes": [{"classification": c, "points": n} for c, n in sorted(classes.items())],
        }

    def groups(self) -> list[Callable[[], Iterator[TileRows]]]:
        """What is to be committed, tile after tile."""
        groups: list[list[TileBlock]] = [[]]
        for _, blocks in groupby(self._plan.blocks, key=lambda block: block.tile):
            tile = list(blocks)
            if groups[-1] and sum(b.points for b in (*groups[-1], *tile)) > _POINTS_PER_COMMIT:
                groups.append([])
            groups[-1] += tile
        return [lambda group=group: self._points(group) for group in groups]  # type: ignore[misc]

    def _points(self, blocks: list[TileBlock]) -> Iterator[TileRows]:
        for block in blocks:
            rows = np.load(self._path(block, "npy"))
            if len(rows):
                yield block.tile, rows

    def _path(self, block: TileBlock, suffix: str) -> Path:
        return self._folder / f"{block.key}.{suffix}"
