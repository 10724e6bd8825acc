"""A work folder: first pass over a scan: its points in UTM, sorted by tile into temporary files, and counted.

Tiles with too many points for the memory are split into quarters until each piece, a `TileBlock`, is small
enough. Edges of blocks are edges of the store's tiles halved again and again, and so never cut a voxel of the
levels of detail.

Finished blocks wait in the work folder to be published together.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import atomic_file
from featuredb.errors import ScanError
from featuredb.geo.tiles import TILE_SIZE_M, tile_bounds, tile_of
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.las import NOISE_CLASSES, RawPoints
from featuredb.store.encode import Row
from featuredb.store.scans import TileRows
from featuredb.store.tables import BOUNDS

SPILLED = np.dtype(
    [
        ("utm", "f8", 3),
        ("rgb", "u2", 3),
        ("intensity", "u2"),
        ("classification", "u1"),
        ("file", "u2"),  # which of the scan's files: their colours may be stretched differently
    ]
)
_CHUNK_ROWS = 500_000
_CELL_M = 2.0
_CELLS = int(TILE_SIZE_M / _CELL_M)
_SMALLEST_BLOCK_M = 1.0  # below it a block is taken as it is; no scan has a million points in a square metre


@dataclass(frozen=True, slots=True, kw_only=True)
class TileBlock:
    """A square of one tile and the file that holds its points.

    Attributes:
        key: name of the file without suffix, e.g. "E000963_N009527-02" (quarters of quarters).
        tile: the store's tile.
        e0, n0: south-west corner, metres.
        size_m: length of its edge.
        points: how many it holds.
    """

    key: str
    tile: str
    e0: float
    n0: float
    size_m: float
    points: int

    def distance_m(self, utm: FloatArray) -> FloatArray:
        """(n,) distance in plan, along the farther axis, of points (n, 3) from the block; 0 inside."""
        beside = np.abs(utm[:, :2] - (np.array([self.e0, self.n0]) + self.size_m / 2.0)) - self.size_m / 2.0
        return np.asarray(np.maximum(beside.max(axis=1, initial=0.0), 0.0), np.float64)

    def near(self, other: "TileBlock", margin_m: float) -> bool:
        """Whether the other block reaches into this one's surroundings."""
        return (
            other.e0 <= self.e0 + self.size_m + margin_m
            and self.e0 - margin_m <= other.e0 + other.size_m
            and other.n0 <= self.n0 + self.size_m + margin_m
            and self.n0 - margin_m <= other.n0 + other.size_m
        )


class Spill:
    """The folder of spilled points: one file per tile while writing, one per block after `split`.

    Attributes:
        read, noise, withheld: points of the files, and those dropped for their class or flag.
        intensity: (65536,) histogram of the raw intensities of points that are kept.
        largest_rgb: largest colour value of each file; -1 where the format has none.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self.read = self.noise = self.withheld = 0
        self.intensity = np.zeros(65536, np.int64)
        self.largest_rgb: list[int] = []
        self._tiles: dict[str, int] = {}
        self._occupied: dict[str, NDArray[np.bool_]] = {}

    def clear(self) -> None:
        """Remove what an earlier, unfinished pass has left."""
        for path in self.folder.glob("*.points"):
            path.unlink()

    def add_file(
        self,
        number: int,
        chunks: Iterator[RawPoints],
        to_utm: Callable[[FloatArray], FloatArray],
        on_progress: Callable[[int], None] = lambda points: None,
    ) -> None:
        """Read a file's chunks, drop noise and withheld points, and sort the rest into tiles."""
        self.largest_rgb.append(-1)
        for points in chunks:
            noise = np.isin(points.classification, NOISE_CLASSES)
            kept = ~(noise | points.withheld)
            self.read += len(points)
            self.noise += int(noise.sum())
            self.withheld += int((points.withheld & ~noise).sum())
            if points.rgb is not None:
                largest = int(points.rgb.max(initial=0))
                self.largest_rgb[number] = max(self.largest_rgb[number], largest)
            self.intensity += np.bincount(points.intensity[kept], minlength=65536)
            rows = np.zeros(int(kept.sum()), SPILLED)
            rows["utm"] = to_utm(points.xyz[kept])
            if points.rgb is not None:
                rows["rgb"] = points.rgb[kept]
            rows["intensity"] = points.intensity[kept]
            rows["classification"] = points.classification[kept]
            rows["file"] = number
            self._append(rows)
            on_progress(self.read)

    def split(self, largest_points: int) -> list[TileBlock]:
        """Split what is too large; returns all blocks, ordered by tile."""
        blocks: list[TileBlock] = []
        for tile in sorted(self._tiles):
            e0, n0, e1, _ = tile_bounds(tile)
            whole = TileBlock(key=tile, tile=tile, e0=e0, n0=n0, size_m=e1 - e0, points=self._tiles[tile])
            blocks += self._split(whole, largest_points)
        return blocks

    def rows(self, block: TileBlock) -> NDArray[Any]:
        """(n,) SPILLED, all points of a block."""
        return np.fromfile(self._path(block.key), SPILLED)

    def chunks(self, block: TileBlock) -> Iterator[NDArray[Any]]:
        """The points of a block, piece by piece."""
        with self._path(block.key).open("rb") as stream:
            while len(rows := np.fromfile(stream, SPILLED, _CHUNK_ROWS)):
                yield rows

    def around(self, block: TileBlock, blocks: Sequence[TileBlock], margin_m: float) -> NDArray[Any]:
        """(n,) SPILLED, the points of other blocks at most `margin_m` away from a block in plan."""
        found = [np.empty(0, SPILLED)]
        for other in blocks:
            if other.key != block.key and block.near(other, margin_m):
                found += [rows[block.distance_m(rows["utm"]) <= margin_m] for rows in self.chunks(other)]
        return np.concatenate(found)

    def spacing_m(self) -> float:
        """Typical distance between neighbouring points in plan: the root of the area that one point has.

        The area is that of the smallest plan cells, 2 m or larger by powers of two, that hold eight points on
        average: holes and surroundings without points do not count.
        """
        points = sum(self._tiles.values())
        cells, edge = self._occupied, _CELL_M
        while True:
            occupied = sum(int(tile.sum()) for tile in cells.values())
            if points >= 8 * occupied or edge >= TILE_SIZE_M:
                return float(edge * np.sqrt(occupied / points))
            cells = {
                name: tile[::2, ::2] | tile[1::2, ::2] | tile[::2, 1::2] | tile[1::2, 1::2]
                for name, tile in cells.items()
            }
            edge *= 2.0

    def _append(self, rows: NDArray[Any]) -> None:
        if not len(rows):
            return
        east, north = np.floor(rows["utm"][:, :2] / TILE_SIZE_M).astype(np.int64).T
        number = east * 10_000_000 + north
        order = np.argsort(number, kind="stable")
        starts = np.flatnonzero(np.diff(number[order], prepend=number[order[0]] - 1))
        for part in np.split(rows[order], starts[1:]):
            name = str(tile_of(part["utm"][:1])[0])
            with self._path(name).open("ab" if name in self._tiles else "wb") as stream:
                part.tofile(stream)
            self._tiles[name] = self._tiles.get(name, 0) + len(part)
            cells = self._occupied.setdefault(name, np.zeros((_CELLS, _CELLS), np.bool_))
            i, j = (part["utm"][:, :2] % TILE_SIZE_M // _CELL_M).astype(np.int64).T
            cells[np.minimum(i, _CELLS - 1), np.minimum(j, _CELLS - 1)] = True

    def _split(self, block: TileBlock, largest_points: int) -> list[TileBlock]:
        half = block.size_m / 2.0
        if block.points <= largest_points or half < _SMALLEST_BLOCK_M:
            return [block]
        separator = "" if "-" in block.key else "-"
        keys = [f"{block.key}{separator}{quarter}" for quarter in range(4)]
        counts = [0, 0, 0, 0]
        for key in keys:
            self._path(key).write_bytes(b"")
        for rows in self.chunks(block):
            east = rows["utm"][:, 0] >= block.e0 + half
            north = rows["utm"][:, 1] >= block.n0 + half
            quarter = east.astype(np.int64) + 2 * north
            for number, key in enumerate(keys):
                part = rows[quarter == number]
                counts[number] += len(part)
                with self._path(key).open("ab") as stream:
                    part.tofile(stream)
        self._path(block.key).unlink()
        pieces: list[TileBlock] = []
        for number, key in enumerate(keys):
            if not counts[number]:
                self._path(key).unlink()
                continue
            piece = TileBlock(
                key=key,
                tile=block.tile,
                e0=block.e0 + half * (number % 2),
                n0=block.n0 + half * (number // 2),
                size_m=half,
                points=counts[number],
            )
            pieces += self._split(piece, largest_points)
        return pieces

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.points"


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

    def put(self, block: TileBlock, rows: NDArray[Any], outliers: int, shown: int) -> None:
        """Keep a finished block.

        Args:
            rows: (n,) POINT_ROW, by level and node.
            outliers: how many were dropped. shown: how many have their colour from an ortho image.
        """
        with atomic_file(self._path(block, "npy")) as temporary, temporary.open("wb") as file:
            np.save(file, rows)
        classes, counts = np.unique(rows["classification"], return_counts=True)
        utm = rows["utm"]
        facts = {
            "points": len(rows),
            "outliers": outliers,
            "shown": shown,
            "levels": np.bincount(rows["level"], minlength=self._plan.finest_level + 1).tolist(),
            "classes": dict(zip(classes.tolist(), counts.tolist(), strict=True)),
            "low": utm.min(axis=0).tolist() if len(utm) else None,
            "high": utm.max(axis=0).tolist() if len(utm) else None,
        }
        with atomic_file(self._path(block, "json")) as temporary:
            temporary.write_text(json.dumps(facts))

    def shown(self) -> int:
        """How many points of all blocks have their colour from an ortho image."""
        return sum(json.loads(self._path(block, "json").read_text())["shown"] for block in self._plan.blocks)

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
