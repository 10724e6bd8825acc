"""Does the database hold what it says? Every file, every row and every cross-reference of one snapshot."""

import hashlib
import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds

from featuredb.errors import FeatureDbError, StoreError
from featuredb.geo.tiles import tile_of
from featuredb.store import tables
from featuredb.store.canaries import list_canaries, load_canary_image
from featuredb.store.candidates.photos import by_candidate, count_candidates, live_maps, read_events
from featuredb.store.candidates.states import CONTRIBUTED, EVENTS, standing_of
from featuredb.store.commits import oldest_kept_version
from featuredb.store.database import Database
from featuredb.store.delta import Table
from featuredb.store.durable.copies import LIST, CopyPlace, cut_off
from featuredb.store.durable.filesystem import one_line, sha256_of, store_errors, table_files
from featuredb.store.durable.log import LOG, file_digests, log_problems
from featuredb.store.encode import Row, encode_map
from featuredb.store.maintenance import named_writes, write_ids_in
from featuredb.store.scans import PointsChecksum, ScanSummary, list_scans, scan_batches
from featuredb.store.snapshot import Snapshot

logger = logging.getLogger(__name__)

# Columns that follow from a map's coordinates, and are not part of what is loaded.
_PLACES = {
    tables.IMAGES: (*tables.UTM_COORDINATES, "zone", "tile"),
    tables.POINTS: (*tables.UTM_COORDINATES, "zone", "tile"),
    tables.OBSERVATIONS: ("zone", "tile"),
}
_SAME_M = 1e-3
_INDEX = {
    tables.IMAGES: "image_index",
    tables.POINTS: "point_index",
    tables.OBSERVATIONS: "observation_index",
}


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


_GROWTH = (tables.CANDIDATES, tables.CANDIDATE_IMAGES, tables.CANARIES)
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
            sha256_of(place.files, path)


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
    for name in tables.SPECS:
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
    """Are the rows of one map those that were committed, in the zone and the tiles of their coordinates?"""
    where = f"map {row['map_id']}"
    try:
        encoded = encode_map(snapshot.load_any(row["map_id"]), row["write_id"], row["created_at"])
    except FeatureDbError as error:
        yield where, f"cannot be loaded: {one_line(error)[:300]}"
        return
    if encoded.row["content_digest"] != row["content_digest"]:
        yield where, "its rows are not those that were committed: content digests differ"
        return
    if any(encoded.row[name] != row[name] for name in (*tables.BOUNDS, "tiles")):
        yield where, "its box or its tiles are not those of its coordinates"
    mine = ds.field("write_id") == row["write_id"]
    for name, expected in encoded.children.items():
        places = _PLACES[name]
        try:
            found = snapshot.dataset(name).to_table([_INDEX[name], *places], filter=mine)
        except (OSError, pa.ArrowException) as error:
            yield where, f"cannot read its {name}: {one_line(error)[:300]}"
            continue
        found = found.sort_by(_INDEX[name])
        for column in places:
            if not _same(found[column], expected[column]):
                yield where, f"{name}: {column} is not that of the map's coordinates"


def _same(found: pa.ChunkedArray, expected: pa.ChunkedArray) -> bool:
    """Coordinates within a millimetre: another PROJ computes those of cameras with other last digits."""
    if not pa.types.is_floating(found.type):
        return bool(found.equals(expected))
    return np.allclose(found.to_numpy(), expected.to_numpy(), rtol=0.0, atol=_SAME_M, equal_nan=True)


def check_scan(database: Database, scan: ScanSummary) -> Iterator[Found]:
    """Do the points of a scan agree with its row, and are they those that were committed?"""
    where = f"scan {scan.scan_id}"
    levels, coordinates = np.zeros(len(scan.level_points), np.int64), PointsChecksum()
    elsewhere = 0
    try:
        for batch in scan_batches(database, scan, (*tables.UTM_COORDINATES, "tile", "level")):
            utm = np.column_stack([batch[name].to_numpy() for name in tables.UTM_COORDINATES])
            coordinates.add(utm)
            levels += np.bincount(batch["level"].to_numpy(), minlength=len(levels))[: len(levels)]
            if not np.isfinite(utm).all():
                yield where, "coordinates that are not finite"
                return
            elsewhere += int((tile_of(utm) != batch["tile"].to_numpy(zero_copy_only=False)).sum())
    except (OSError, pa.ArrowException) as error:
        yield where, f"cannot read its points: {one_line(error)[:300]}"
        return
    if levels.tolist() != list(scan.level_points):
        yield where, f"expected {list(scan.level_points)} points by level, found {levels.tolist()}"
    elif coordinates.text() != scan.row["points_checksum"]:
        yield where, "its points are not those that were committed: checksums differ"
    if elsewhere:
        yield where, f"{elsewhere} points in another tile than their coordinates'"


def check_growth_tables(database: Database) -> list[Found]:
    """What is wrong with contributed photos and known queries: where, and what. Reads every image.

    Where others commit meanwhile, as a withdrawal does, it looks again for what it has found.
    """

    def look() -> tuple[list[int], list[Found]]:
        return versions(), [*_check_candidates(database), *_check_canaries(database)]

    def versions() -> list[int]:
        return [database.table(name).version for name in database.tables() if name in _GROWTH]

    seen, found = look()
    while found and seen != versions():
        seen, again = look()
        lasting = [problem for problem in found if problem in again]
        if lasting == found:
            break
        found = lasting
    return found


def _check_candidates(database: Database) -> Iterator[Found]:
    if not database.has(tables.CANDIDATES):
        return
    try:
        events = read_events(database)
        live = live_maps(database)
        digests = dict(_stored_digests(database))
    except (FeatureDbError, OSError, pa.ArrowException) as error:
        yield "candidates", f"cannot be read: {one_line(error)[:300]}"
        return
    whole = by_candidate(events)
    for event in events:
        where = f"candidate {event['candidate_id']}"
        if event["event"] not in EVENTS:
            yield where, f"an event {event['event']!r} that is none of {', '.join(EVENTS)}"
        elif event["candidate_id"] not in whole:
            yield where, f"an event {event['event']!r} of a photo that nobody contributed"
    for candidate_id, own in whole.items():
        where, state = f"candidate {candidate_id}", standing_of(own, live).state
        expected = next(e["sha256"] for e in own if e["event"] == CONTRIBUTED)
        if not str(expected).startswith(candidate_id):
            yield where, f"its id is not the beginning of its hash {expected}"
        if candidate_id not in digests:
            if state in ("waiting", "used"):
                yield where, f"it is {state}, but its image is not there"
        elif state == "withdrawn":
            yield where, "it is withdrawn, but its image is still there; withdraw it again"
        elif digests[candidate_id] != expected:
            yield where, "its image is not the one that was contributed: hashes differ"


def _check_canaries(database: Database) -> Iterator[Found]:
    try:
        canaries = list_canaries(database)
    except FeatureDbError as error:
        yield "canaries", f"cannot be read: {error}"
        return
    names = [canary.name for canary in canaries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"canary {name}", "there are several of this name"
    for canary in canaries:
        try:
            load_canary_image(database, canary)
        except FeatureDbError as error:
            yield f"canary {canary.name}", str(error)


def _stored_digests(database: Database) -> Iterator[tuple[str, str]]:
    """Candidate and SHA-256 of each stored image, one in memory at a time."""
    dataset = database.table(tables.CANDIDATE_IMAGES).dataset()
    batches = dataset.to_batches(
        columns=["candidate_id", "image"],
        batch_size=1,
        batch_readahead=1,
        fragment_readahead=1,
        use_threads=False,
    )
    for batch in batches:
        for candidate_id, image in zip(batch["candidate_id"], batch["image"], strict=True):
            yield candidate_id.as_py(), hashlib.sha256(image.as_buffer()).hexdigest()


def _said(problems: Iterable[Found]) -> tuple[DatabaseProblem, ...]:
    return tuple(DatabaseProblem(where=where, what=what) for where, what in problems)


def _orphans(database: Database) -> list[str]:
    first = oldest_kept_version(database.table(tables.MAPS).commits())
    # First what is there: a commit names its rows after it has written them.
    children = [name for name in database.tables() if name not in tables.CHILDREN]
    present = {name: set(write_ids_in(database.table(name))) for name in children}
    orphans: set[str] = set()
    for name, named in named_writes(database, first):
        orphans |= present.get(name, set()) - named  # a table may have been made meanwhile
    return sorted(orphans)
