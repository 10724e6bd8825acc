"""Does the database hold what it says? Every file, every row and every cross-reference of one snapshot."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from featuredb.errors import FeatureDbError, StoreError
from featuredb.geo.tiles import tile_of
from featuredb.geometry.arrays import FloatArray
from featuredb.store.canaries import list_canaries
from featuredb.store.candidates.photos import count_candidates
from featuredb.store.candidates.upkeep import check_growth_tables, named_writes
from featuredb.store.commits import oldest_kept_version
from featuredb.store.database import Database
from featuredb.store.decode import has_place
from featuredb.store.delta import Table
from featuredb.store.durable.copies import LIST, CopyPlace, cut_off
from featuredb.store.durable.filesystem import one_line, sha256_of, store_errors, table_files
from featuredb.store.durable.log import LOG, file_digests, log_problems
from featuredb.store.encode import Row, content_digest
from featuredb.store.maintenance import write_ids_in, write_ids_of_history
from featuredb.store.scans import (
    PointsChecksum,
    ScanSummary,
    list_scans,
    scan_batches,
    scan_rows,
)
from featuredb.store.snapshot import Snapshot
from featuredb.store.tables import (
    BOUNDS,
    CANDIDATE_IMAGES,
    CANDIDATES,
    CHILD_TABLES,
    IMAGES,
    LIDAR,
    LIDAR_POINTS,
    MAPS,
    NO_TILE,
    NO_ZONE,
    OBSERVATIONS,
    OWN_COORDINATES,
    POINTS,
    SPECS,
    UTM_COORDINATES,
)

logger = logging.getLogger(__name__)

_LIGHT_COLUMNS = {
    IMAGES: ["image_index", "image_id", "camera_id", "easting", "northing", "height", "zone", "tile"],
    POINTS: ["point_index", "easting", "northing", "height", "zone", "tile"],
    OBSERVATIONS: ["observation_index", "point_index", "image_id", "zone", "tile"],
}
_INDEX = {IMAGES: "image_index", POINTS: "point_index", OBSERVATIONS: "observation_index"}


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseProblem:
    """One thing that is wrong: where (table and file, or map), and what."""

    where: str
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifyReport:
    """What was looked at and what is wrong.

    Attributes:
        version: of the snapshot that was checked; -1 where a log is so damaged that none can be read.
        maps, scans, candidates, canaries, files, rows: how many of each were checked.
        problems: damage; empty in a sound database.
        orphans: write ids of child rows that no version names, left by a crash or written just now by a
            commit under way. No damage: nobody reads them, and `vacuum` removes them.
    """

    version: int = -1
    maps: int = 0
    scans: int = 0
    candidates: int = 0
    canaries: int = 0
    files: int = 0
    rows: int = 0
    problems: tuple[DatabaseProblem, ...] = ()
    orphans: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        return not self.problems


_TOLD = 3  # problems in a message
Found = tuple[str, str]  # where, and what


def verify(database: Database) -> VerifyReport:
    """Check the newest snapshot, scans, contributed photos and known queries; reads all of them.

    In an object store what seems damaged is read again.

    Raises:
        StoreError: the store cannot be reached, or there is no database.
    """
    with store_errors(f"cannot verify {database.url}"):
        report = _verify(database)
        if report.problems and "://" in database.url:
            # Requests that failed look like damage: whoever can read all bytes now looks again.
            try:
                _read_all(CopyPlace(database.url, database.storage_options))
                return _verify(database)
            except (OSError, StoreError) as error:
                seen = "; ".join(f"{p.where}: {p.what}" for p in report.problems[:_TOLD])
                raise StoreError(
                    f"cannot verify {database.url}: {one_line(error)}; "
                    f"found before, this failure or damage: {seen}"
                ) from error
        return report


def _read_all(place: CopyPlace) -> None:
    """Raises OSError where the store does not answer."""
    for path in place.sizes():
        with suppress(FileNotFoundError):
            place.sha256(path)


def _verify(database: Database) -> VerifyReport:
    problems = list(check_logs(database))
    if unfinished := cut_off(database.url, database.storage_options):
        problems.insert(0, (LIST, unfinished))
    try:
        snapshot = database.snapshot()
        scans = list_scans(database)
        names = database.tables()
    except StoreError as error:
        if not problems:
            raise
        logger.debug("nothing but the logs can be checked: %s", error)
        return VerifyReport(problems=_said(problems))
    files = rows = 0
    for name in names:
        table = database.table(name)
        live = table.files()
        files += len(live)
        rows += sum(file.rows for file in live)
        problems += check_files(table)
    for row in snapshot.rows():
        problems += check_map(snapshot, row)
    for scan in scans:
        problems += check_scan(database, scan)
    problems += check_growth_tables(database)
    orphans = [] if problems else _orphans(database)
    return VerifyReport(
        version=snapshot.version,
        maps=len(snapshot.rows()),
        scans=len(scans),
        candidates=0 if problems else sum(count_candidates(database).by_state.values()),
        canaries=0 if problems else len(list_canaries(database)),
        files=files,
        rows=rows,
        problems=_said(problems),
        orphans=tuple(orphans),
    )


def check_logs(database: Database) -> Iterator[Found]:
    """Is every entry of every log there and whole, and does the log end where it was acknowledged to end?"""
    for name in SPECS:
        files = table_files(database.table_url(name), database.storage_options)
        for problem in log_problems(files):
            what = f"{problem.what}; `featuredb repair` says what can be done"
            yield f"{name}/{LOG}/{problem.name}", what


def check_files(table: Table) -> list[Found]:
    """Does every file open, has it as many rows as the log says, and the bytes that were written?

    Where there are problems the table moves to its newest version: files that others have replaced meanwhile,
    and may have deleted, do not count.
    """
    found = list(_file_problems(table))
    if found:
        table.refresh()
    live = {f"{table.spec.name}/{file.path}" for file in table.files()} if found else set()
    return [(where, what) for where, what in found if where in live]


def _file_problems(table: Table) -> Iterator[Found]:
    expected = {file.path: file.rows for file in table.files()}
    try:
        digests = file_digests(table.storage)
    except StoreError:  # said of the log
        digests = {}
    for fragment in table.dataset().get_fragments():
        where = f"{table.spec.name}/{fragment.path}"
        try:
            found = fragment.metadata.num_rows
            digest = digests.get(fragment.path)
            same = digest is None or digest == sha256_of(table.storage, fragment.path)
        except (OSError, pa.ArrowException) as error:
            yield where, f"cannot be opened: {one_line(error)[:300]}"
            continue
        if found != expected[fragment.path]:
            yield where, f"expected {expected[fragment.path]} rows by the log, found {found}"
        if not same:
            yield where, "its bytes are not those that were written: hashes differ"


def check_map(snapshot: Snapshot, row: Row) -> Iterator[Found]:
    """Do the child rows of one map agree with its row, with each other and with what was committed?"""
    where = f"map {row['map_id']}"
    mine = ds.field("write_id") == row["write_id"]
    tables: dict[str, pa.Table] = {}
    for name in CHILD_TABLES:
        try:
            columns = [
                *_LIGHT_COLUMNS[name],
                *(OWN_COORDINATES if not has_place(row) and name == POINTS else ()),
            ]
            tables[name] = snapshot.dataset(name).to_table(columns, filter=mine)
        except (OSError, pa.ArrowException) as error:
            yield where, f"cannot read its {name}: {one_line(error)[:300]}"
    if len(tables) < len(CHILD_TABLES):
        return
    found = [
        *_check_counts(row, tables),
        *_check_references(row, tables),
        *(_check_places(row, tables) if has_place(row) else _check_no_place(tables)),
    ]
    yield from ((where, what) for what in found)
    if found:
        return
    try:
        digest = content_digest(snapshot.load_any(row["map_id"]))
    except FeatureDbError as error:
        yield where, f"cannot be loaded: {one_line(error)[:300]}"
        return
    if digest != row["content_digest"]:
        yield where, "its rows are not those that were committed: content digests differ"


def check_scan(database: Database, scan: ScanSummary) -> Iterator[Found]:
    """Do the points of a scan agree with its row, and are they those that were committed?"""
    where = f"scan {scan.scan_id}"
    levels, coordinates = np.zeros(len(scan.level_points), np.int64), PointsChecksum()
    low, high = np.array([[scan.row[b] for b in BOUNDS[:3]], [scan.row[b] for b in BOUNDS[3:]]])
    elsewhere = outside = 0
    try:
        for batch in scan_batches(database, scan, ("easting", "northing", "height", "tile", "level")):
            utm = _utm(batch)
            coordinates.add(utm)
            levels += np.bincount(batch["level"].to_numpy(), minlength=len(levels))[: len(levels)]
            if not np.isfinite(utm).all():
                yield where, "coordinates that are not finite"
                return
            elsewhere += int((tile_of(utm) != batch["tile"].to_numpy(zero_copy_only=False)).sum())
            outside += int((~((utm >= low) & (utm <= high)).all(axis=1)).sum())
    except (OSError, pa.ArrowException) as error:
        yield where, f"cannot read its points: {one_line(error)[:300]}"
        return
    if levels.tolist() != list(scan.level_points):
        yield where, f"expected {list(scan.level_points)} points by level, found {levels.tolist()}"
    elif coordinates.text() != scan.row["points_checksum"]:
        yield where, "its points are not those that were committed: checksums differ"
    if elsewhere:
        yield where, f"{elsewhere} points in another tile than their coordinates'"
    if outside:
        yield where, f"{outside} points outside the scan's box"


def _check_counts(row: Row, tables: dict[str, pa.Table]) -> Iterator[str]:
    for name, table in tables.items():
        if len(table) != row[name]:
            yield f"expected {row[name]} rows in {name}, found {len(table)}"
        index = np.sort(table[_INDEX[name]].to_numpy())
        if not np.array_equal(index, np.arange(len(table))):
            yield f"{name}: {_INDEX[name]} is not each of 0 to {len(table) - 1} once"


def _check_references(row: Row, tables: dict[str, pa.Table]) -> Iterator[str]:
    seen, images = tables[OBSERVATIONS], tables[IMAGES]
    lost = pc.sum(pc.invert(pc.is_in(seen["point_index"], tables[POINTS]["point_index"]))).as_py()
    if lost:
        yield f"{lost} observations name a point that is not there"
    lost = pc.sum(pc.invert(pc.is_in(seen["image_id"], images["image_id"]))).as_py()
    if lost:
        yield f"{lost} observations name an image that is not there"
    camera = images["camera_id"].to_numpy()
    lost = int(((camera < 0) | (camera >= len(row["cameras"]))).sum())
    if lost:
        yield f"{lost} images name a camera that is not there"


def _check_no_place(tables: dict[str, pa.Table]) -> Iterator[str]:
    """Coordinates of the own frame finite; nothing that could be taken for a place."""
    for name, table in tables.items():
        if (
            pc.any(pc.not_equal(table["zone"], NO_ZONE)).as_py()
            or pc.any(pc.not_equal(table["tile"], NO_TILE)).as_py()
        ):
            yield f"{name}: rows in a zone or tile, of a map without a place"
    for name in (IMAGES, POINTS):
        if np.isfinite(_utm(tables[name])).any():
            yield f"{name}: UTM coordinates, of a map without a place"
    points = tables[POINTS]
    own = np.column_stack([points[name].to_numpy() for name in OWN_COORDINATES])
    if not np.isfinite(own).all():
        yield "points: coordinates that are not finite"


def _check_places(row: Row, tables: dict[str, pa.Table]) -> Iterator[str]:
    """Coordinates finite and inside the map's box; zone and tile those of the coordinates."""
    for name, table in tables.items():
        if pc.any(pc.not_equal(table["zone"], row["epsg"])).as_py():
            yield f"{name}: rows in another zone than {row['epsg']}"
    for name in (IMAGES, POINTS):
        utm = _utm(tables[name])
        if not np.isfinite(utm).all():
            yield f"{name}: coordinates that are not finite"
            return
        wrong = int((tile_of(utm) != tables[name]["tile"].to_numpy()).sum())
        if wrong:
            yield f"{name}: {wrong} rows in another tile than their coordinates'"
    points = _utm(tables[POINTS])
    if len(points):
        low, high = [row[b] for b in BOUNDS[:3]], [row[b] for b in BOUNDS[3:]]
        outside = int((~((points >= low) & (points <= high)).all(axis=1)).sum())
        if outside:
            yield f"{outside} points outside the map's box"
    wrong = _observations_in_wrong_tile(tables)
    if wrong:
        yield f"observations: {wrong} rows in another tile than their point"


def _observations_in_wrong_tile(tables: dict[str, pa.Table]) -> int:
    points, seen = tables[POINTS], tables[OBSERVATIONS]
    position = pc.index_in(seen["point_index"], points["point_index"])
    known = pc.is_valid(position)
    tiles = points["tile"].take(position.filter(known))
    return int(pc.sum(pc.not_equal(tiles, seen["tile"].filter(known))).as_py() or 0)


def _said(problems: Iterable[Found]) -> tuple[DatabaseProblem, ...]:
    return tuple(DatabaseProblem(where=where, what=what) for where, what in problems)


def _utm(table: pa.Table | pa.RecordBatch) -> FloatArray:
    return np.column_stack([table[name].to_numpy() for name in UTM_COORDINATES])


def _orphans(database: Database) -> list[str]:
    first = oldest_kept_version(database.table(MAPS).commits())
    present: set[str] = set().union(*(write_ids_in(database.table(name)) for name in CHILD_TABLES))
    orphans = present - write_ids_of_history(database, first)
    if database.has(LIDAR):
        orphans |= set(write_ids_in(database.table(LIDAR_POINTS))) - {
            r["write_id"] for r in scan_rows(database)
        }
    if database.has(CANDIDATES):
        orphans |= set(write_ids_in(database.table(CANDIDATE_IMAGES))) - named_writes(database)
    return sorted(orphans)
