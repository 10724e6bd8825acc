"""The LiDAR scans of a database: tables `lidar` and `lidar_points`, in the manner of `maps` and its children.

Points are written first, under a fresh `write_id`, tile by tile; the row in `lidar` that names it is written
last, by compare-and-swap. A database without these tables has no scans; the first one makes them. Scans have
versions of their own: a rollback of maps leaves them alone.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from time import monotonic
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
from numpy.typing import NDArray

from featuredb.errors import ConflictError, ScanNotFoundError, StoreError
from featuredb.geo.tiles import tiles_touching
from featuredb.geometry.arrays import FloatArray
from featuredb.store.changes import RETIRED, Change, live_row, with_status
from featuredb.store.commits import LONGEST_COMMIT, apply_change, new_write_id
from featuredb.store.database import Database
from featuredb.store.decode import of_columns, read_rows
from featuredb.store.delta import Condition
from featuredb.store.durable.filesystem import read_errors
from featuredb.store.durable.log import list_entries
from featuredb.store.encode import Row, table_of
from featuredb.store.retry import retry_stale
from featuredb.store.snapshot import UtmBox, full_id
from featuredb.store.tables import LIDAR, LIDAR_POINTS, SPECS, UTM_COORDINATES

# One row of `lidar_points` in memory, without the columns that are the same for a whole tile.
POINT_ROW = np.dtype(
    [
        ("utm", "f8", 3),
        ("rgb", "u1", 3),
        ("has_rgb", "?"),
        ("intensity", "u1"),
        ("classification", "u1"),
        ("level", "u1"),
        ("node", "i8"),
        ("node_spacing_m", "f4"),
    ]
)


TileRows = tuple[str, NDArray[Any]]
"""A tile, and points of it on their way into the store: (n,) POINT_ROW, by level and then node."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanSummary:
    """A scan as its row in `lidar` describes it.

    Attributes:
        points, points_in_files: stored, and before anything was dropped.
        level_points: stored points of each level, coarsest first.
        spacing_m: typical distance between neighbouring points in plan.
        classes: points of each ASPRS class.
        row: everything, by the columns of `lidar`.
    """

    scan_id: str
    write_id: str
    name: str
    status: str
    status_reason: str
    created_at: datetime
    epsg: int
    height_datum: str
    box: UtmBox
    points: int
    points_in_files: int
    level_points: tuple[int, ...]
    spacing_m: float
    classes: dict[int, int]
    colour: str
    has_intensity: bool
    licence: str
    row: Row


def scan_rows(database: Database) -> list[Row]:
    """All rows of `lidar`, oldest first; none where the table does not exist."""
    return sorted(database.rows(LIDAR), key=lambda row: (row["created_at"], row["scan_id"]))


def list_scans(database: Database, *, include_retired: bool = False) -> list[ScanSummary]:
    """The scans of the newest version, oldest first."""
    return [_summary(r) for r in scan_rows(database) if include_retired or r["status"] != RETIRED]


def find_scan(database: Database, scan_id: str) -> ScanSummary:
    """One scan, retired or not, by its id or its first letters.

    Raises:
        ScanNotFoundError: no such scan, or several ids begin so.
    """
    rows = {row["scan_id"]: row for row in scan_rows(database)}
    none = f"no scan {scan_id}; `featuredb lidar list` lists what there is"
    return _summary(rows[full_id(scan_id, rows, "scans", ScanNotFoundError, none)])


def commit_scan(
    database: Database,
    row: Row,
    groups: Iterable[Callable[[], Iterator[TileRows]]],
    on_progress: Callable[[int], None] = lambda points: None,
) -> tuple[bool, str]:
    """Write a scan's points and then its row; a scan that is visible already is left alone.

    Args:
        row: columns of `lidar` but `write_id`, `points_checksum`, `status`, `status_reason`, `created_at`.
        groups: each gives the points of some tiles when called; one commit to `lidar_points` each.

    Returns:
        Whether this call made the scan visible, and the `write_id` of its points.

    Raises:
        ConflictError: other writers were faster too many times.
        StoreError: the store failed.
    """
    database.make(LIDAR)
    visible = live_row(scan_rows(database), row["scan_id"], "scan_id")
    if visible is not None:
        return False, visible["write_id"]
    started = monotonic()
    write_id = new_write_id(datetime.now(UTC))
    checksum = PointsChecksum()
    written = 0

    def batches(group: Callable[[], Iterator[TileRows]]) -> Iterator[pa.RecordBatch]:
        nonlocal written
        for tile, points in group():
            checksum.add(points["utm"])
            written += len(points)
            on_progress(written)
            constants = {"write_id": write_id, "zone": row["epsg"], "tile": tile}
            columns = _point_columns(points, row["has_intensity"])
            yield from table_of(LIDAR_POINTS, constants, columns, len(points)).to_batches()

    for group in groups:
        stream = pa.RecordBatchReader.from_batches(SPECS[LIDAR_POINTS].schema, batches(group))
        database.table(LIDAR_POINTS).append(stream)
    if monotonic() - started > LONGEST_COMMIT.total_seconds():
        raise ConflictError(f"commit of scan {row['scan_id']} took over {LONGEST_COMMIT}; add it again")
    if written != row["points"]:
        raise StoreError(f"scan {row['scan_id']}: expected {row['points']} points, {written} were written")
    if (left := database.table(LIDAR_POINTS).count("write_id", write_id)) != written:
        raise ConflictError(f"scan {row['scan_id']}: a vacuum left {left} of {written} points; add it again")
    made = {"write_id": write_id, "points_checksum": checksum.text(), "created_at": datetime.now(UTC)}
    full = {**row, **made, "status": "active", "status_reason": ""}
    winner = retry_stale(f"commit of scan {row['scan_id']}", lambda: _add_row(database, full))
    return winner == write_id, winner


def retire_scan(database: Database, scan_id: str, reason: str) -> bool:
    """Take a scan out of service; False if it was already.

    Raises:
        ScanNotFoundError, StoreError: no reason given.
    """
    if not reason.strip():
        raise StoreError(f"retire {scan_id}: expected a reason, for those who will ask later")
    scan_id = find_scan(database, scan_id).scan_id

    def retired(rows: list[Row]) -> tuple[Change, list[str]]:
        if live_row(rows, scan_id, "scan_id") is None:
            return Change(rows=rows, added=()), []
        return Change(rows=with_status(rows, [scan_id], RETIRED, reason, "scan_id")), [scan_id]

    return bool(database.change_rows(f"retire {scan_id}", "retire", reason, retired, LIDAR).changed)


def scan_points(
    database: Database,
    scan: ScanSummary,
    level: int,
    box: tuple[float, float, float, float] | None,
    columns: Sequence[str],
) -> pa.Table:
    """The points of one level of a scan, in the order they were written.

    Args:
        box: (e0, n0, e1, n1), closed, metres in the scan's zone; None for all.

    Raises:
        StoreError: they cannot be read.
    """
    with read_errors(f"scan {scan.scan_id}: cannot read its points"):
        return _level_rows(database, scan, level, box).to_table(list(columns))


def scan_batches(database: Database, scan: ScanSummary, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """All points of a scan, some thousand at a time, in no particular order."""
    dataset = database.table(LIDAR_POINTS).dataset([("write_id", "=", scan.write_id)])
    yield from dataset.to_batches(columns=list(columns), use_threads=False)


def retired_since(database: Database) -> dict[str, datetime]:
    """When each scan was retired last, by scan id and the store's time."""
    if not database.has(LIDAR):
        return {}
    table = database.table(LIDAR)
    entries = list_entries(table.storage)
    commits = reversed(table.commits())  # oldest first
    return {s: entries[c.version] for c in commits if c.operation == "retire" for s in c.maps}


def count_points(
    database: Database, scan: ScanSummary, level: int, box: tuple[float, float, float, float] | None
) -> int:
    """How many points of a level lie in a box; see `scan_points`."""
    if box is None or level >= len(scan.level_points):
        return scan.level_points[level] if level < len(scan.level_points) else 0
    return int(_level_rows(database, scan, level, box).count_rows())


class PointsChecksum:
    """Sum over all points of a hash of each, so that the order, which compaction changes, does not count."""

    def __init__(self) -> None:
        self._sums = [0, 0]
        self._count = 0

    def add(self, utm: FloatArray) -> None:
        """Take in coordinates (n, 3) float64."""
        bits = np.ascontiguousarray(utm, dtype="<f8").view("<u8")
        h = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
        for axis, factor in ((1, 0xC2B2AE3D27D4EB4F), (2, 0x165667B19E3779F9)):
            h = ((h ^ (h >> np.uint64(29))) + bits[:, axis]) * np.uint64(factor)
        h ^= h >> np.uint64(32)
        for i, values in enumerate((h, h * h)):
            self._sums[i] = (self._sums[i] + int(values.sum(dtype=np.uint64))) % 2**64
        self._count += len(bits)

    def text(self) -> str:
        """The checksum, 64 hex digits."""
        return hashlib.sha256(f"{self._sums} {self._count}".encode()).hexdigest()


def _add_row(database: Database, row: Row) -> str:
    """Add the row unless the scan is visible; a retired one gives way. Returns the visible write id."""
    table = database.table(LIDAR)
    rows = read_rows(table)
    visible = live_row(rows, row["scan_id"], "scan_id")
    if visible is not None:
        return str(visible["write_id"])
    kept = [r for r in rows if r["scan_id"] != row["scan_id"]]
    change = Change(rows=[*kept, row], added=[row] if len(kept) == len(rows) else None)
    apply_change(table, change, operation="lidar add", changed=[row["scan_id"]])
    return str(row["write_id"])


def _point_columns(rows: NDArray[Any], has_intensity: bool) -> dict[str, Any]:
    no_rgb = ~rows["has_rgb"]
    columns: dict[str, Any] = {
        "classification": rows["classification"].astype(np.int16),
        "node": rows["node"],
        "node_spacing_m": rows["node_spacing_m"],
        "level": rows["level"].astype(np.int32),
    }
    for axis, name in enumerate(UTM_COORDINATES):
        columns[name] = np.ascontiguousarray(rows["utm"][:, axis])
    for axis, name in enumerate(("red", "green", "blue")):
        if not no_rgb.all():
            columns[name] = pa.array(rows["rgb"][:, axis].astype(np.int16), mask=no_rgb)
    if has_intensity:
        columns["intensity"] = rows["intensity"].astype(np.int16)
    return columns


def _level_rows(
    database: Database, scan: ScanSummary, level: int, box: tuple[float, float, float, float] | None
) -> ds.Dataset:
    where: list[Condition] = [
        ("zone", "=", scan.epsg), ("level", "=", level), ("write_id", "=", scan.write_id)
    ]  # fmt: skip
    if box is not None:
        e0, n0, e1, n1 = box
        where += [
            ("easting", ">=", e0),
            ("easting", "<=", e1),
            ("northing", ">=", n0),
            ("northing", "<=", n1),
            ("tile", "in", sorted(set(tiles_touching(*box)) & set(scan.row["tiles"]))),
        ]
    return database.table(LIDAR_POINTS).dataset(where)


def _summary(row: Row) -> ScanSummary:
    values = {
        "box": of_columns(UtmBox, row),
        "level_points": tuple(row["level_points"]),
        "classes": {c["classification"]: c["points"] for c in row["classes"]},
        "row": row,
    }
    return of_columns(ScanSummary, {**row, **values})
