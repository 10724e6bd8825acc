"""Compaction and vacuum: fewer files, and no rows that nothing can see any more."""

from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta

import pyarrow.compute as pc

from featuredb.store import tables
from featuredb.store.candidates.photos import by_candidate, live_maps, read_events
from featuredb.store.candidates.states import standing_of
from featuredb.store.changes import RETIRED, Change
from featuredb.store.commits import KEPT_FROM, apply_change, oldest_kept_version
from featuredb.store.database import Database
from featuredb.store.decode import read_rows
from featuredb.store.delta import Table
from featuredb.store.durable.ages import store_time, write_times
from featuredb.store.durable.filesystem import store_errors
from featuredb.store.durable.log import CHANGED, OPERATION, REASON, list_entries
from featuredb.store.encode import rows_table
from featuredb.store.retry import retry_stale
from featuredb.store.scans import retired_since, scan_rows
from featuredb.store.vacuum_options import VacuumOptions as VacuumOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class VacuumReport:
    """What was removed, or with `dry_run` would be.

    Attributes:
        kept_from: oldest version that stays readable.
        write_ids: of child rows that no kept version names.
        candidate_images: ids of contributed photos whose bytes went: refused ones.
        files: paths of data files; with `dry_run` without those that only the removal of rows sets free.
    """

    kept_from: int
    write_ids: tuple[str, ...]
    candidate_images: tuple[str, ...]
    files: tuple[str, ...]
    dry_run: bool


def compact(database: Database) -> dict[str, int]:
    """Merge small files; returns for each table how many files it has less. Snapshots do not change."""
    saved = {}
    for name in database.tables():
        if name not in (tables.MAPS, tables.LIDAR):
            saved[name] = database.table(name).compact()
    saved[tables.MAPS] = retry_stale("compact maps", lambda: _compact_maps(database))
    return saved


def vacuum(
    database: Database, options: VacuumOptions | None = None, *, dry_run: bool = False
) -> VacuumReport:
    """Remove what no kept snapshot can see: rows of crashed and replaced writes, files of old versions.

    The commit to `maps` that says from which version on the past is kept comes first, so that nobody rolls
    back to a version whose rows are about to go.

    Raises:
        ConflictError, StoreError
    """
    options = options or VacuumOptions()
    with store_errors(f"cannot vacuum {database.url}"):
        now = store_time(database.table(tables.MAPS).storage)
        history, grace = timedelta(hours=options.history_h), timedelta(hours=options.orphan_grace_h)
        kept_from = retry_stale("vacuum", lambda: _announce(database, now - history, dry_run))
        orphans: set[str] = set()
        refused: set[str] = set()
        gone = {scan_id for scan_id, time in retired_since(database).items() if time <= now - history}
        for name, named in named_writes(database, kept_from, gone):
            if name == tables.CANDIDATE_IMAGES:
                # Asked as late as can be, as photos may be given again meanwhile; but before orphans are
                # removed, which gives rows beside them newer files.
                refused = _refused_images(database, now, history, grace)
            orphans |= _remove_orphans(database.table(name), named, now - grace, dry_run)
        if refused and not dry_run:
            database.table(tables.CANDIDATE_IMAGES).delete_rows("candidate_id", refused)
        return VacuumReport(
            kept_from=kept_from,
            write_ids=tuple(sorted(orphans)),
            candidate_images=tuple(sorted(refused)),
            files=tuple(_vacuum_files(database, options, kept_from, dry_run)),
            dry_run=dry_run,
        )


def named_writes(
    database: Database, first_version: int, gone: Collection[str] = ()
) -> Iterator[tuple[str, set[str]]]:
    """Each child table there is, with the write ids that its parent table names.

    Args:
        first_version: of `maps`; what only earlier ones name does not count.
        gone: ids of scans that do not count where they are retired.
    """
    named = write_ids_of_history(database, first_version)
    yield from ((name, named) for name in tables.CHILD_TABLES)
    if database.has(tables.LIDAR):
        rows = [r for r in scan_rows(database) if r["status"] != RETIRED or r["scan_id"] not in gone]
        yield tables.LIDAR_POINTS, {row["write_id"] for row in rows}
    if database.has(tables.CANDIDATES):
        yield tables.CANDIDATE_IMAGES, {event["write_id"] for event in read_events(database)}


def write_ids_of_history(database: Database, first_version: int) -> set[str]:
    """All write ids that the versions from `first_version` on name."""
    maps = database.table(tables.MAPS)
    named: set[str] = set()
    seen_files: frozenset[str] = frozenset()
    for version in range(maps.version, first_version - 1, -1):
        table = database.table(tables.MAPS, version)
        files = frozenset(file.path for file in table.files())
        if files - seen_files:  # otherwise it shows a part of what a newer version shows
            named.update(row["write_id"] for row in read_rows(table))
        seen_files |= files
    return named


def write_ids_in(table: Table) -> dict[str, set[str]]:
    """All write ids that a child table holds, from the log where a file has one, else from the file.

    Returns:
        The paths of the files that hold each.
    """
    found: defaultdict[str, set[str]] = defaultdict(set)
    mixed = set()
    for file in table.files():
        if file.write_id is not None:
            found[file.write_id].add(file.path)
        else:
            mixed.add(file.path)
    for fragment in table.dataset().get_fragments() if mixed else ():
        if fragment.path in mixed:
            for batch in fragment.to_batches(columns=["write_id"], use_threads=False):
                for write_id in pc.unique(batch.column("write_id")).to_pylist():
                    found[write_id].add(fragment.path)
    return dict(found)


def _remove_orphans(table: Table, named: set[str], before: datetime, dry_run: bool) -> set[str]:
    """Remove rows that nothing names and that the store had before a time; returns their write ids."""
    orphans = {write_id: paths for write_id, paths in write_ids_in(table).items() if write_id not in named}
    found = {write_id for write_id, time in write_times(orphans, table.storage).items() if time <= before}
    if found and not dry_run:
        table.delete_rows("write_id", found)
    return found


def _compact_maps(database: Database) -> int:
    maps = database.table(tables.MAPS)
    files = len(maps.files())
    if files <= 1:
        return 0
    apply_change(maps, Change(rows=read_rows(maps)), operation="compact")
    return files - 1


def _announce(database: Database, cutoff: datetime, dry_run: bool) -> int:
    """Commit from which version on the past is kept: what was newest at a time; returns that version."""
    maps = database.table(tables.MAPS)
    commits = maps.commits()
    # The version that was newest then, and all later ones; all if none is so old.
    old = [version for version, time in list_entries(maps.storage).items() if time <= cutoff]
    kept_from = max(*old, oldest_kept_version(commits), 0)
    if not dry_run and kept_from > oldest_kept_version(commits):
        apply_change(
            maps,
            Change(rows=read_rows(maps)),
            operation="vacuum",
            reason=f"versions before {kept_from} are gone",
            extra={KEPT_FROM: str(kept_from)},
        )
    return kept_from


def _refused_images(database: Database, now: datetime, history: timedelta, grace: timedelta) -> set[str]:
    """Photos whose bytes may go: withdrawn ones (left by a crash), and those refused `history` ago.

    Not those with bytes younger than `grace`: somebody may be giving the photo again just now.
    """
    live = live_maps(database)
    found = set()
    for candidate_id, events in by_candidate(read_events(database)).items():
        state = standing_of(events, live).state
        if state == "withdrawn" or (state == "refused" and now - events[-1]["happened_at"] >= history):
            found.add(candidate_id)
    table = database.table(tables.CANDIDATE_IMAGES)
    times = write_times(write_ids_in(table), table.storage)
    stored = table.dataset().to_table(["candidate_id", "write_id"], use_threads=False).to_pylist()
    old = {write_id for write_id, time in times.items() if now - time >= grace}
    fresh = {row["candidate_id"] for row in stored if row["write_id"] not in old}
    return (found & {row["candidate_id"] for row in stored}) - fresh


def _vacuum_files(database: Database, options: VacuumOptions, kept_from: int, dry_run: bool) -> list[str]:
    files = []
    for name in database.tables():
        if name == tables.LIDAR:
            continue
        table = database.table(name)
        # Versions of `maps` are kept by number; the newest child table serves all of them.
        keep = range(kept_from, table.version + 1) if name == tables.MAPS else ()
        removed = table.vacuum(
            timedelta(hours=options.file_grace_h), dry_run=dry_run, keep_versions=list(keep)
        )
        files += [f"{name}/{path}" for path in removed]
    return files


def upgrade(database: Database) -> list[str]:
    """Bring all tables to the newest format.

    All maps and snapshots stay as they are. `maps` comes last: until then the format is the old one.

    Returns:
        What was done, a sentence for each step; none where nothing was to be done.

    Raises:
        ConflictError: other writers were faster too many times.
        StoreError: the store failed.
    """
    steps: list[str] = []
    for name in reversed(database.tables()):
        found = database.table(name).format
        if found < tables.FORMAT_VERSION:
            _to_newest_format(database, name)
            steps.append(
                f"{name}: format {found} became {tables.FORMAT_VERSION}, which older releases cannot read"
            )
    return steps


def _to_newest_format(database: Database, name: str) -> None:
    def attempt() -> None:
        table = database.table(name)
        if name == tables.MAPS:
            said = {OPERATION: "upgrade", CHANGED: "", REASON: f"to format {tables.FORMAT_VERSION}"}
            table.upgrade(rows_table(tables.MAPS, read_rows(table)), said)
        else:
            table.upgrade()

    retry_stale(f"upgrade of {name}", attempt)
