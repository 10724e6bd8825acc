"""A database at a URL: create, open, commit maps, retire, roll back, look at the past."""

import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from time import monotonic

from featuredb.errors import ConflictError, InvalidValueError, StoreError
from featuredb.maps.feature_map import MapStatus
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.store.changes import (
    ACTIVE,
    RETIRED,
    Change,
    add_maps,
    change_status,
    check_active,
    check_unchanged,
    live_row,
    retire_map,
)
from featuredb.store.commits import (
    LONGEST_COMMIT,
    CommitResult,
    StatusResult,
    apply_change,
    check_children,
    commit_as_of,
    new_write_id,
)
from featuredb.store.decode import read_rows
from featuredb.store.delta import Condition, Table
from featuredb.store.durable.copies import check_restored
from featuredb.store.durable.log import Commit
from featuredb.store.encode import EncodedMap, Row, content_digest, encode_map
from featuredb.store.retry import retry_stale
from featuredb.store.snapshot import Snapshot
from featuredb.store.tables import CHILD_TABLES, CHILDREN, FORMAT_VERSION, MAPS, SPECS

logger = logging.getLogger(__name__)


class Database:
    """Handle of one database; cheap, keeps no data. Threads may share it.

    `url` is a local path or what deltalake takes (`s3://bucket/prefix`, ...); `storage_options` are
    deltalake's, beside which it reads the usual variables of the environment.
    """

    def __init__(self, url: str, storage_options: Mapping[str, str] | None = None) -> None:
        self.url = normal_url(url)
        self._storage_options = dict(storage_options) if storage_options else None
        self._poll_lock = threading.Lock()
        self._poll_table: Table | None = None

    @classmethod
    def create(cls, url: str | Path, *, storage_options: Mapping[str, str] | None = None) -> "Database":
        """Make the tables at a URL, `maps` last, where there are none, and open the database.

        Raises:
            StoreError: a database is being restored there, or the place cannot be written.
        """
        database = cls(str(url), storage_options)
        check_restored(database.url, database._storage_options)
        database.make(MAPS)
        database.table(MAPS)
        return database

    @classmethod
    def open(cls, url: str | Path, *, storage_options: Mapping[str, str] | None = None) -> "Database":
        """Open an existing database.

        Raises:
            DatabaseNotFoundError: there is none.
            StoreError: it cannot be read, has another format, or is being restored.
        """
        database = cls(str(url), storage_options)
        check_restored(database.url, database._storage_options)
        database.table(MAPS)
        return database

    @property
    def name(self) -> str:
        """Last part of the URL, which names the database on the network."""
        return self.url.rstrip("/").rsplit("/", 1)[-1]

    @property
    def storage_options(self) -> dict[str, str] | None:
        """What deltalake is told beside the URL."""
        return self._storage_options

    def table(self, name: str, version: int | None = None) -> Table:
        """A table at its newest or the given version; for maintenance and tests."""
        return Table.load(self.table_url(name), SPECS[name], self._storage_options, version)

    def rows(
        self, name: str, columns: Sequence[str] | None = None, where: Sequence[Condition] = ()
    ) -> list[Row]:
        """Rows of a table at its newest version, as `read_rows`; none where there is no such table."""
        return read_rows(self.table(name), columns, where) if self.has(name) else []

    def has(self, name: str) -> bool:
        """Whether there is a table of CHILDREN, and with it those of which it names rows.

        Raises:
            StoreError: the store cannot be reached.
        """
        return Table.exists(self.table_url(name), self._storage_options)

    def make(self, name: str) -> None:
        """Make a table of CHILDREN, after those of which it names rows; harmless where they are.

        Raises:
            DatabaseNotFoundError: another table than `maps`, where no database is any more.
            StoreError: the place cannot be written.
        """
        if name != MAPS:
            self.table(MAPS)
        for part in (*CHILDREN[name], name):
            Table.create(self.table_url(part), SPECS[part], self._storage_options)

    def tables(self) -> list[str]:
        """The tables that there are: those of maps, and what was made on first use.

        Raises:
            StoreError: the store cannot be reached.
        """
        there = [name for name in CHILDREN if name == MAPS or self.has(name)]
        return [part for name in there for part in (name, *CHILDREN[name])]

    def snapshot(self, as_of: int | datetime | None = None) -> Snapshot:
        """The newest version, that of a number, or the one that was newest at a time (aware datetime).

        Raises:
            SnapshotNotFoundError: no such version, before the first one, or removed by vacuum.
        """
        maps = self.table(MAPS)
        if as_of is None:
            return self._snapshot_of(maps, maps.commits(limit=1)[0])
        commit = commit_as_of(as_of, maps.commits())
        return self._snapshot_of(self.table(MAPS, commit.version), commit)

    def poll_version(self) -> int:
        """Number of the newest snapshot: one look at the log, no data read."""
        with self._poll_lock:
            if self._poll_table is None:
                self._poll_table = self.table(MAPS)
            else:
                self._poll_table.refresh()
            return self._poll_table.version

    def commit_map(
        self,
        feature_map: AnyMap,
        *,
        replaces: str | None = None,
        based_on: str | None = None,
        moves: bool = True,
    ) -> CommitResult:
        """Make one map visible; see `commit_maps`.

        Args:
            based_on: write id of the replaced map that the new one was made from.
        """
        write_ids = {replaces: based_on} if replaces is not None and based_on is not None else {}
        old = () if replaces is None else (replaces,)
        return self.commit_maps([feature_map], replaces=old, based_on=write_ids, moves=moves)[0]

    def commit_maps(
        self,
        feature_maps: Sequence[AnyMap],
        *,
        replaces: Sequence[str] = (),
        based_on: Mapping[str, str] | None = None,
        moves: bool = True,
        reasons: Mapping[str, str] | None = None,
    ) -> list[CommitResult]:
        """Make maps visible, all in one commit.

        A map whose id is visible and not retired is left alone, so committing twice, from one process or two,
        gives one row. With `replaces`, those maps give way in the same commit: a new map of the same id takes
        the old one's place (a re-placement), a replaced map of another id becomes retired. Snapshots before
        it still show the old ones. Maps placed by a replaced one are quarantined (`CommitResult.flagged`).

        Args:
            based_on: write ids, by id, of the replaced maps that the new ones were made from.
            moves: False where the new maps are the old ones at the same place, thinned for example: what
                they placed stands, and nothing is quarantined.
            reasons: why maps have the status that they come with, by id.

        Raises:
            ConflictError: other writers were faster too many times, or a map of `based_on` has been placed
                anew, retired or rolled back since it was read; nothing is visible.
            MapNotFoundError: a map to be replaced is not there.
            StoreError: the store failed, map ids repeat, a map is retired without a reason, or one without a
                place comes to a database of format 1.
        """
        if any(isinstance(feature_map, UnplacedMap) for feature_map in feature_maps):
            self.require_newest_format("keep maps without a place")
        ids = [feature_map.map_id for feature_map in feature_maps]
        if len(set(ids)) != len(ids):
            raise StoreError(f"commit_maps: expected different map ids, found {ids}")
        why = reasons or {}
        if any(m.status == RETIRED and not why.get(m.map_id) for m in feature_maps):
            raise StoreError("commit_maps: expected active or quarantined maps, found a retired one")
        started = monotonic()
        encoded: dict[str, EncodedMap] = {}
        digests = {m.map_id: content_digest(m) for m in feature_maps if m.map_id in replaces}

        def attempt() -> list[CommitResult]:
            maps = self.table(MAPS)
            rows = read_rows(maps)
            visible = {m: row for m in ids if (row := _already_there(rows, m, replaces, digests))}
            pending = [m for m in feature_maps if m.map_id not in visible]
            version = maps.version
            flagged: tuple[str, ...] = ()
            if pending:
                check_unchanged(rows, based_on or {})
                for feature_map in pending:
                    if feature_map.map_id not in encoded:
                        encoded[feature_map.map_id] = self._write_children(feature_map)
                        encoded[feature_map.map_id].row["status_reason"] = why.get(feature_map.map_id, "")
                if monotonic() - started > LONGEST_COMMIT.total_seconds():
                    raise ConflictError(
                        f"commit of {', '.join(ids)} took over {LONGEST_COMMIT}; commit again"
                    )
                for feature_map in pending:
                    check_children(encoded[feature_map.map_id], self.table)
                change = add_maps(rows, [encoded[m.map_id].row for m in pending], replaces, moves=moves)
                flagged = change.flagged
                changed = [*(m.map_id for m in pending), *flagged]
                version = apply_change(maps, change, operation="commit", changed=changed)
            # After a commit whose answer was lost the map is there already, by our own write.
            ours = {m: e.row["write_id"] for m, e in encoded.items()}
            found = {m: visible[m]["write_id"] if m in visible else ours[m] for m in ids}
            return [
                CommitResult(map_id=m, created=w == ours.get(m), version=version, write_id=w, flagged=flagged)
                for m, w in found.items()
            ]

        results = retry_stale(f"commit of {', '.join(ids)}", attempt)
        logger.info("committed %s", [(r.map_id, r.created, r.version) for r in results])
        return results

    def retire(self, map_id: str, reason: str) -> tuple[str, ...]:
        """Take a map out of service with all that hangs on it alone, by `parents`; returns the ids retired.

        Raises:
            MapNotFoundError, ConflictError, StoreError
        """
        retire = partial(retire_map, map_id=map_id, reason=reason)
        return self.change_rows(f"retire {map_id}", "retire", reason, retire).changed

    def set_status(
        self,
        map_ids: Sequence[str],
        status: MapStatus,
        reason: str,
        *,
        based_on: Mapping[str, str] | None = None,
        active: Collection[str] | None = None,
    ) -> StatusResult:
        """Promote maps (`active`) or put them into quarantine, in one commit; history says which.

        A map is promoted only if a chain of active parents, its companions of this call included, leads to
        an anchor. A map that loses its last such chain by a quarantine is quarantined, too.

        Args:
            reason: kept with each map.
            based_on: write ids, by id, of the maps that the decision was about.
            active: write ids of all maps that were active when the decision was made (with canaries, for
                example); None: does not matter.

        Raises:
            ConflictError: other writers were faster too many times, a map of `based_on` has been placed
                anew, retired or rolled back, or other maps than `active` answer now; nothing has changed.
            MapNotFoundError: no such map.
            StoreError: no reason, a retired map, another status than these two, a chain that is not there.
        """

        def decided(rows: list[Row]) -> tuple[Change, list[str]]:
            check_unchanged(rows, based_on or {})
            check_active(rows, active)
            return change_status(rows, map_ids, status, reason)

        operation = "promote" if status == ACTIVE else "quarantine"
        return self.change_rows(f"{status} for {', '.join(map_ids)}", operation, reason, decided)

    def change_rows(
        self,
        what: str,
        operation: str,
        reason: str,
        make: Callable[[list[Row]], tuple[Change, list[str]]],
        name: str = MAPS,
    ) -> StatusResult:
        """Commit what `make` makes of the newest rows of `maps`: the change, and the ids that it is about.

        Args:
            name: LIDAR to change scans instead.

        Raises:
            ConflictError: other writers were faster too many times. StoreError; and what `make` raises.
        """
        changed: list[str] = []

        def attempt() -> int:
            table = self.table(name)
            change, changed[:] = make(read_rows(table))
            return apply_change(table, change, operation=operation, changed=changed, reason=reason)

        version = retry_stale(what, attempt)
        return StatusResult(version=version, changed=tuple(changed))

    def rollback(self, as_of: int | datetime) -> int:
        """Make a new version that shows what an earlier one showed; returns its number.

        Raises:
            SnapshotNotFoundError, ConflictError, StoreError
        """

        def attempt() -> int:
            maps = self.table(MAPS)
            old = self.snapshot(as_of)
            change = Change(rows=old.rows())
            return apply_change(maps, change, operation="rollback", reason=f"to version {old.version}")

        return retry_stale(f"rollback to {as_of}", attempt)

    @property
    def format(self) -> int:
        """Format of the database: of the oldest of its tables of maps."""
        return min(self.table(name).format for name in (*CHILD_TABLES, MAPS))

    def require_newest_format(self, purpose: str) -> None:
        """Refuse what an older format cannot hold.

        Raises:
            StoreError: the database has an older format.
        """
        if self.format < FORMAT_VERSION:
            raise StoreError(
                f"{self.url} has format {self.format}, which cannot {purpose}: expected format "
                f"{FORMAT_VERSION}; run `featuredb upgrade {self.url}` (featuredb before it cannot read the "
                "database any more then)"
            )

    def history(self) -> list[Commit]:
        """All versions, newest first."""
        return self.table(MAPS).commits()

    def _snapshot_of(self, maps: Table, commit: Commit) -> Snapshot:
        rows, children = read_rows(maps), {name: self.table(name) for name in CHILD_TABLES}
        return Snapshot(version=commit.version, timestamp=commit.timestamp, rows=rows, children=children)

    def _write_children(self, feature_map: AnyMap) -> EncodedMap:
        """Write the rows that stay invisible until a row of `maps` names them."""
        now = datetime.now(UTC)
        encoded = encode_map(feature_map, new_write_id(now), now)
        for name, rows in encoded.children.items():
            if len(rows):
                self.table(name).append(rows)
        return encoded

    def table_url(self, name: str) -> str:
        """Where a table lies."""
        return f"{self.url}/{name}"


def normal_url(url: str) -> str:
    """An absolute path for local places, the URL without trailing slash for others."""
    if "\0" in url:  # Arrow would end the process
        raise InvalidValueError(f"expected a folder or an address in an object store, found {url!r}")
    if url.startswith("file://"):
        url = url.removeprefix("file://")
    if "://" in url:
        return url.rstrip("/")
    return str(Path(url).expanduser().absolute())


def _already_there(
    rows: Sequence[Row], map_id: str, replaces: Sequence[str], digests: Mapping[str, str]
) -> Row | None:
    """The visible row that makes a commit needless; a re-placement needs equal content, too."""
    row = live_row(rows, map_id)
    if row is None or (map_id in replaces and row["content_digest"] != digests[map_id]):
        return None
    return row
