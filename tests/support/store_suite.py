"""What a database must do at any place: one suite, run by a test class for every backend.

A subclass provides the fixture `place`.
"""

import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from featuredb.errors import (
    ConflictError,
    DatabaseNotFoundError,
    InvalidValueError,
    MapNotFoundError,
    SnapshotNotFoundError,
    StoreError,
)
from featuredb.store import Database
from featuredb.store.delta import Table
from featuredb.store.durable.backup import backup, restore
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.retry import StaleVersionError
from featuredb.store.sql import SqlSession
from featuredb.store.verify import verify
from tests.support.maps import EPSG, assert_same_map, random_map

NOTHING_KEPT = VacuumOptions(history_h=0, orphan_grace_h=0, file_grace_h=0)
REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a test's database lies."""

    url: str
    storage_options: dict[str, str] = field(default_factory=dict)

    def create(self) -> Database:
        return Database.create(self.url, storage_options=self.storage_options)

    def open(self) -> Database:
        return Database.open(self.url, storage_options=self.storage_options)

    def worker(self, *arguments: str) -> "subprocess.Popen[str]":
        """A process of tests/support/store_worker.py that is ready and waits for `go`."""
        options = [f"{k}={v}" for k, v in self.storage_options.items()]
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.store_worker", self.url, ",".join(options), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process


def go(process: "subprocess.Popen[str]") -> None:
    """Let a worker that is ready begin."""
    assert process.stdin is not None
    process.stdin.write("go\n")
    process.stdin.flush()


class StoreSuite:
    """The behaviour of a database, wherever it lies."""

    @pytest.fixture
    def place(self) -> Place:
        raise NotImplementedError

    @pytest.fixture
    def database(self, place: Place) -> Database:
        return place.create()

    def test_a_map_comes_back_exactly_as_committed(self, database: Database) -> None:
        original = random_map(1, points=500, images=7, observations=3000)
        result = database.commit_map(original)
        assert result.created
        assert_same_map(database.snapshot().load_map("map-1"), original)
        summary = database.snapshot().get("map-1")
        assert (summary.points, summary.images, summary.observations) == (500, 7, 3000)
        assert summary.descriptors == int(original.observations.has_descriptor.sum())
        assert summary.box is not None
        assert summary.box.max_easting == original.points.utm[:, 0].max()
        assert summary.box.min_height == original.points.utm[:, 2].min()

    def test_a_map_without_points_is_a_map(self, database: Database) -> None:
        empty = random_map(2, points=0, images=0)
        database.commit_map(empty)
        assert_same_map(database.snapshot().load_map("map-2"), empty)
        assert database.snapshot().get("map-2").box is None
        assert verify(database).ok

    def test_open_and_create(self, place: Place) -> None:
        with pytest.raises(DatabaseNotFoundError, match="featuredb init"):
            place.open()
        place.create().commit_map(random_map(1))
        assert [m.map_id for m in place.create().snapshot().maps()] == ["map-1"]

    def test_committing_twice_is_committing_once(self, database: Database) -> None:
        first, again = (database.commit_map(random_map(1)) for _ in range(2))
        assert first.created
        assert not again.created
        assert (again.version, again.write_id) == (first.version, first.write_id)
        assert len(database.snapshot().rows()) == 1
        assert database.poll_version() == first.version

    def test_a_commit_whose_answer_was_lost(
        self, database: Database, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The log entry is written, the writer hears of a failure, and finds its own map."""
        real, lost = Table.swap, []

        def swap(table: Table, *args: Any, **kwargs: Any) -> int:
            version = real(table, *args, **kwargs)
            if not lost:
                lost.append(version)
                raise StaleVersionError("the answer was lost")
            return version

        monkeypatch.setattr(Table, "swap", swap)
        result = database.commit_map(random_map(1))
        assert lost == [1]
        assert result.created
        assert result.version == 1
        assert len(database.snapshot().rows()) == 1

    def test_writers_that_always_collide_give_up(
        self, database: Database, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def swap(table: Table, *args: Any, **kwargs: Any) -> int:
            raise StaleVersionError("someone was first")

        monkeypatch.setattr(Table, "swap", swap)
        monkeypatch.setattr("featuredb.store.retry.ATTEMPTS", 3)
        with pytest.raises(ConflictError, match="3 attempts"):
            database.commit_map(random_map(1))
        monkeypatch.undo()
        assert database.snapshot().rows() == []
        assert len(verify(database).orphans) == 1

    def test_a_snapshot_stays_what_it_was(self, database: Database) -> None:
        database.commit_map(random_map(1))
        snapshot = database.snapshot()
        database.commit_map(random_map(2))
        database.retire("map-1", "test")
        compact(database)
        vacuum(database, NOTHING_KEPT)
        assert [m.map_id for m in snapshot.maps()] == ["map-1"]
        # Its files are gone, but the rows live on in the compacted ones.
        assert_same_map(snapshot.load_map("map-1"), random_map(1))

    def test_vacuum_keeps_what_kept_versions_name(self, database: Database) -> None:
        database.commit_map(random_map(1))
        database.commit_map(random_map(2, map_id="map-1"), replaces="map-1")
        assert vacuum(database).write_ids == ()
        assert_same_map(database.snapshot(1).load_map("map-1"), random_map(1))
        dry = vacuum(database, NOTHING_KEPT, dry_run=True)
        assert len(dry.write_ids) == 1
        assert_same_map(database.snapshot(1).load_map("map-1"), random_map(1))
        assert vacuum(database, NOTHING_KEPT).write_ids == dry.write_ids
        with pytest.raises(SnapshotNotFoundError, match="vacuumed"):
            database.snapshot(1)
        with pytest.raises(SnapshotNotFoundError, match="vacuumed"):
            database.rollback(1)
        report = verify(database)
        assert report.ok
        assert report.orphans == ()
        assert_same_map(database.snapshot().load_map("map-1"), random_map(2, map_id="map-1"))

    def test_backup_and_restore(self, database: Database, place: Place, tmp_path: Path) -> None:
        options = place.storage_options
        for seed in (1, 2):
            database.commit_map(random_map(seed))
        there, here = f"{place.url}-backup", str(tmp_path / "backup.db")
        files = backup(database, there, options).files
        assert backup(database, there, options).kept == files
        assert backup(database, here).files == files
        for source, given in ((there, options), (here, {})):
            target = Database(f"{place.url}-{len(source)}", options)
            assert restore(source, target, given).files == files
            assert verify(target).problems == ()
            assert_same_map(target.snapshot().load_map("map-2"), random_map(2))
            target.commit_map(random_map(3))
            with pytest.raises(StoreError, match="overwrites nothing"):
                restore(source, target, given)

    def test_sql_sees_one_snapshot(self, database: Database) -> None:
        database.commit_map(random_map(1, points=50))
        database.commit_map(random_map(2, points=70))
        counts = []
        for version in (1, 2):
            with SqlSession(database.snapshot(version)) as session:
                counts.append(next(session.query("select count(*) from points").rows)[0])
        assert counts == [50, 120]

    def test_two_processes_and_a_reader_that_never_sees_half_a_map(
        self, database: Database, place: Place
    ) -> None:
        writers = [place.worker("commit", *seeds) for seeds in (("1", "2", "9"), ("9", "3", "4"))]
        for writer in writers:
            go(writer)
        seen: set[str] = set()
        deadline = datetime.now(UTC) + timedelta(seconds=120)
        while any(writer.poll() is None for writer in writers):
            assert datetime.now(UTC) < deadline
            snapshot = database.snapshot()
            for summary in snapshot.maps():
                if summary.map_id not in seen:
                    seed = int(summary.map_id.removeprefix("map-"))
                    assert_same_map(snapshot.load_map(summary.map_id), random_map(seed))
                    seen.add(summary.map_id)
            time.sleep(0.05)  # a store on this machine is the writers' as well
        created = [line for w in writers for line in w.communicate(timeout=10)[0].split()]
        assert [w.returncode for w in writers] == [0, 0]
        assert sorted(created) == [f"map-{i}" for i in (1, 2, 3, 4, 9)]
        assert len(database.snapshot().rows()) == 5
        assert verify(database).ok


class ChangesSuite(StoreSuite):
    """What changes do to the rows of `maps`, too: the code is the same wherever they lie."""

    def test_threads_that_commit_the_same_and_different_maps(self, database: Database, place: Place) -> None:
        results = []

        def commit(seed: int) -> None:
            results.append(place.open().commit_map(random_map(seed)))

        threads = [threading.Thread(target=commit, args=(seed,)) for seed in (1, 1, 1, 2, 3, 4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        assert sorted((r.map_id, r.created) for r in results) == [
            ("map-1", False),
            ("map-1", False),
            ("map-1", True),
            ("map-2", True),
            ("map-3", True),
            ("map-4", True),
        ]
        assert len(database.snapshot().rows()) == 4
        report = verify(database)
        assert report.ok

    def test_time_travel_and_rollback(self, database: Database) -> None:
        database.commit_map(random_map(1))
        database.commit_map(random_map(2))
        between = database.snapshot().timestamp
        database.retire("map-1", "test")
        assert [len(database.snapshot(v).maps()) for v in (0, 1, 2, 3)] == [0, 1, 2, 1]
        assert database.snapshot(between).version == 2
        assert database.rollback(2) == 4
        assert {m.map_id for m in database.snapshot().maps()} == {"map-1", "map-2"}
        assert_same_map(database.snapshot().load_map("map-1"), random_map(1))
        assert len(database.snapshot(3).maps()) == 1
        history = database.history()
        assert [e.operation for e in history] == ["rollback", "retire", "commit", "commit", "init"]
        assert history[1].maps == ("map-1",)
        assert history[1].reason == "test"
        for wrong in (99, datetime(2000, 1, 1, tzinfo=UTC), datetime(2000, 1, 1)):
            with pytest.raises(SnapshotNotFoundError):
                database.snapshot(wrong)

    def test_compact_keeps_every_row(self, database: Database) -> None:
        for seed in range(4):
            database.commit_map(random_map(seed))
        files = verify(database).files
        saved = compact(database)
        report = verify(database)
        assert report.ok
        assert report.files == files - sum(saved.values())
        assert all(count > 0 for count in saved.values())
        for seed in range(4):
            assert_same_map(database.snapshot().load_map(f"map-{seed}"), random_map(seed))

    def test_several_maps_in_one_commit(self, database: Database) -> None:
        database.commit_map(random_map(1))
        results = database.commit_maps([random_map(i) for i in (1, 2, 3)])
        assert [r.created for r in results] == [False, True, True]
        assert database.poll_version() == 2
        assert len(database.snapshot().maps()) == 3
        with pytest.raises(StoreError, match="different"):
            database.commit_maps([random_map(4), random_map(4)])

    def test_what_cannot_be_committed(self, database: Database) -> None:
        with pytest.raises(StoreError, match="retired"):
            database.commit_map(random_map(1).with_status("retired"))
        with pytest.raises(InvalidValueError, match="JSON"):
            database.commit_map(replace(random_map(1), provenance={"x": object()}))
        assert database.poll_version() == 0

    def test_replacing_a_map_under_its_own_id(self, database: Database) -> None:
        old, new = random_map(1), random_map(2, map_id="map-1")
        before = database.commit_map(old)
        after = database.commit_map(new, replaces="map-1")
        assert after.created
        assert not database.commit_map(new, replaces="map-1").created
        assert_same_map(database.snapshot().load_map("map-1"), new)
        assert_same_map(database.snapshot(before.version).load_map("map-1"), old)
        assert len(database.snapshot().rows()) == 1

    def test_replacing_a_map_by_another(self, database: Database) -> None:
        database.commit_map(random_map(1))
        database.commit_map(random_map(2), replaces="map-1")
        snapshot = database.snapshot()
        assert [m.map_id for m in snapshot.maps()] == ["map-2"]
        assert snapshot.get("map-1").status == "retired"
        assert snapshot.get("map-1").status_reason == "replaced by map-2"
        with pytest.raises(MapNotFoundError, match="map-9"):
            database.commit_map(random_map(3), replaces="map-9")

    def test_replacing_a_map_quarantines_what_it_placed(self, database: Database) -> None:
        child = random_map(3, parents=("map-1",))
        database.commit_maps([random_map(1), random_map(2), child])
        result = database.commit_map(random_map(9, map_id="map-1"), replaces="map-1")
        assert result.flagged == ("map-3",)
        assert {m.map_id: m.status for m in database.snapshot().maps()} == {
            "map-1": "active",
            "map-2": "active",
            "map-3": "quarantined",
        }
        assert "map-1" in database.snapshot().get("map-3").status_reason
        assert database.snapshot(result.version - 1).get("map-3").status == "active"
        database.rollback(result.version - 1)
        assert database.snapshot().get("map-3").status == "active"

    def test_a_map_changed_since_it_was_read_is_not_replaced(self, database: Database) -> None:
        first = database.commit_map(random_map(1))
        database.commit_map(random_map(2, map_id="map-1"), replaces="map-1", based_on=first.write_id)
        with pytest.raises(ConflictError, match="map-1 was placed anew"):
            database.commit_map(random_map(3, map_id="map-1"), replaces="map-1", based_on=first.write_id)
        second = database.snapshot().get("map-1").write_id
        database.retire("map-1", "wrong street")
        with pytest.raises(ConflictError, match="retired"):
            database.commit_map(random_map(3, map_id="map-1"), replaces="map-1", based_on=second)

    def test_retire_takes_what_hangs_on_the_map_alone(self, database: Database) -> None:
        database.commit_maps(
            [
                random_map(1),
                random_map(2),
                random_map(3, parents=("map-1",)),
                random_map(4, parents=("map-3",)),
                random_map(5, parents=("map-3", "map-2")),
            ]
        )
        assert database.retire("map-1", "wrong street") == ("map-1", "map-3", "map-4")
        assert {m.map_id for m in database.snapshot().maps()} == {"map-2", "map-5"}
        assert database.snapshot().get("map-4").status_reason == "wrong street (map-1)"
        version = database.poll_version()
        assert database.retire("map-1", "again") == ()
        assert database.poll_version() == version
        # A retired map may come back by committing it.
        assert database.commit_map(random_map(1)).created
        assert database.snapshot().get("map-1").status == "active"
        with pytest.raises(MapNotFoundError):
            database.retire("map-9", "no such map")

    def test_maps_in_a_box(self, database: Database) -> None:
        database.commit_map(random_map(1))
        snapshot = database.snapshot()
        box = snapshot.get("map-1").box
        assert box is not None
        e, n = box.max_easting, box.max_northing
        assert snapshot.maps_in(EPSG, e, n, e + 10, n + 10)
        assert not snapshot.maps_in(EPSG, e + 0.01, n, e + 10, n + 10)
        assert not snapshot.maps_in(EPSG + 1, e - 10, n - 10, e, n)
        with pytest.raises(MapNotFoundError, match="map-9"):
            snapshot.load_map("map-9")

    def test_a_map_is_found_by_the_first_letters_of_its_id(self, database: Database) -> None:
        database.commit_maps(
            [random_map(i, map_id=name) for i, name in enumerate(("ab", "abc", "abd", "x1"))]
        )
        database.retire("x1", "wrong")
        snapshot = database.snapshot()
        assert [snapshot.find(start).map_id for start in ("ab", "abc", "abd")] == ["ab", "abc", "abd"]
        database.retire("abd", "wrong")
        database.retire("ab", "wrong")
        assert database.snapshot().find("a").map_id == "abc"
        with pytest.raises(MapNotFoundError, match=r"a: 3 maps begin so \(ab, abc, abd\)"):
            snapshot.find("a")
        for start in ("x", "x1", "abcd", ""):
            with pytest.raises(MapNotFoundError, match="no live map"):
                snapshot.find(start)
