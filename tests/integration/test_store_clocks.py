"""What a vacuum takes depends on no writer's clock, and a commit does not name rows that have gone."""

import os
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow.fs as fs
import pytest

from featuredb.errors import ConflictError
from featuredb.store import Database
from featuredb.store.commits import new_write_id
from featuredb.store.durable.ages import store_time
from featuredb.store.maintenance import VacuumOptions, vacuum
from featuredb.store.tables import MAPS
from featuredb.store.verify import verify
from tests.support.maps import assert_same_map, random_map

NOTHING_KEPT = VacuumOptions(history_h=0, orphan_grace_h=0, file_grace_h=0)


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database.create(tmp_path / "maps.db")


def clock_off_by(monkeypatch: pytest.MonkeyPatch, off: timedelta) -> None:
    """Let the writers' clocks be wrong."""

    def write_id(now: datetime) -> str:
        return new_write_id(now + off)

    monkeypatch.setattr("featuredb.store.database.new_write_id", write_id)


def vacuum_before_maps(monkeypatch: pytest.MonkeyPatch, options: VacuumOptions) -> None:
    """Let a vacuum come between the child rows of a commit and its row in `maps`."""
    real = Database._write_children

    def write(self: Database, *args: Any) -> Any:
        encoded = real(self, *args)
        vacuum(self, options)
        return encoded

    monkeypatch.setattr(Database, "_write_children", write)


def make_older(database: Database, hours: float) -> None:
    """Let everything that is there have come earlier."""
    then = time.time() - 3600 * hours
    for path in Path(database.url).rglob("*"):
        os.utime(path, (then, then))


def test_rows_of_a_writer_whose_clock_is_slow_stay(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_off_by(monkeypatch, timedelta(hours=-30))
    vacuum_before_maps(monkeypatch, VacuumOptions())
    assert database.commit_map(random_map(1)).created
    assert_same_map(database.snapshot().load_map("map-1"), random_map(1))
    assert verify(database).ok


def test_a_commit_whose_rows_were_taken_says_so(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        vacuum_before_maps(patch, NOTHING_KEPT)
        with pytest.raises(ConflictError, match="a vacuum has removed them"):
            database.commit_map(random_map(1))
    assert database.snapshot().rows() == []
    assert database.commit_map(random_map(1)).created
    assert verify(database).ok


@pytest.mark.parametrize("off_h", [-1000, 1000])
def test_orphans_and_history_age_by_the_stores_time(
    database: Database, monkeypatch: pytest.MonkeyPatch, off_h: float
) -> None:
    clock_off_by(monkeypatch, timedelta(hours=off_h))
    database.commit_map(random_map(1))
    with monkeypatch.context() as patch:
        patch.setattr("featuredb.store.database.apply_change", _die)
        with pytest.raises(KeyboardInterrupt):
            database.commit_map(random_map(2))
    (orphan,) = verify(database).orphans
    make_older(database, 23)
    assert vacuum(database).write_ids == ()
    make_older(database, 25)
    report = vacuum(database)
    assert (report.write_ids, report.kept_from) == ((orphan,), 0)
    database.retire("map-1", "wrong")
    make_older(database, 24 * 31)
    database.commit_map(random_map(3))
    assert vacuum(database).kept_from == 2
    assert verify(database).ok


def test_files_just_dropped_stay_for_readers(database: Database) -> None:
    database.commit_map(random_map(1))
    reader = database.snapshot()
    make_older(database, 100)
    database.retire("map-1", "wrong")
    assert [f for f in vacuum(database, VacuumOptions(history_h=0)).files if f.startswith("maps/")] == []
    assert_same_map(reader.load_map("map-1"), random_map(1))
    make_older(database, 25)
    assert [f for f in vacuum(database, VacuumOptions(history_h=0)).files if f.startswith("maps/")]


def _die(*args: Any, **kwargs: Any) -> None:
    raise KeyboardInterrupt


def test_a_file_that_is_lost_stops_no_vacuum(database: Database) -> None:
    database.commit_map(random_map(1, extent_m=10.0))
    replaced = list(Path(database.url, "points").glob("**/*.parquet"))
    database.commit_map(replace(random_map(2, extent_m=10.0), map_id="map-1"), replaces="map-1")
    for path in replaced:
        path.unlink()
    vacuum(database, NOTHING_KEPT)
    assert_same_map(
        database.snapshot().load_map("map-1"), replace(random_map(2, extent_m=10.0), map_id="map-1")
    )


def test_the_time_of_a_store_that_can_only_be_read_is_that_of_its_newest_file(database: Database) -> None:
    class ReadOnly:
        def open_output_stream(self, path: str) -> None:
            raise OSError(f"{path}: read-only file system")

        def get_file_info(self, what: fs.FileSelector) -> Any:
            return files.get_file_info(what)

    make_older(database, hours=2.0)
    files = database.table(MAPS).storage
    age = datetime.now(UTC) - store_time(ReadOnly())
    assert timedelta(hours=1.9) < age < timedelta(hours=2.1)
