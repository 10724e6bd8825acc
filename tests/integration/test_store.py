"""The database on a local disk."""

import shutil
from pathlib import Path

import pyarrow as pa
import pytest
from deltalake import DeltaTable

from featuredb.errors import DatabaseNotFoundError, StoreError
from featuredb.store import Database
from tests.support.maps import assert_same_map, random_map
from tests.support.store_suite import ChangesSuite, Place


class TestLocalStore(ChangesSuite):
    @pytest.fixture
    def place(self, tmp_path: Path) -> Place:
        return Place(url=str(tmp_path / "maps.db"))


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match="cannot create"):
        Database.create(tmp_path / "file" / "maps.db")


def test_another_delta_table_is_no_database(tmp_path: Path) -> None:
    DeltaTable.create(tmp_path / "maps", pa.schema([("a", pa.int64())]))
    with pytest.raises(DatabaseNotFoundError, match="not one of featuredb"):
        Database.open(tmp_path)


def test_a_newer_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("featuredb.store.durable.making.FORMAT_VERSION", 999)
    monkeypatch.setattr("featuredb.store.durable.making.READABLE_FORMATS", (999,))
    Database.create(tmp_path / "maps.db")
    monkeypatch.undo()
    with pytest.raises(StoreError, match="format 999"):
        Database.open(tmp_path / "maps.db")


def test_a_database_that_vanishes_while_it_is_polled(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "maps.db")
    assert database.poll_version() == 0
    shutil.rmtree(tmp_path / "maps.db")
    with pytest.raises(StoreError):
        database.snapshot()


def test_a_copied_database_keeps_its_history(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "maps.db")
    for seed in (1, 2):
        database.commit_map(random_map(seed))
    then = database.snapshot(1).timestamp
    shutil.copytree(tmp_path / "maps.db", tmp_path / "copy.db")
    copy = Database.open(tmp_path / "copy.db")
    assert copy.snapshot(then).version == 1
    assert copy.history() == database.history()
    assert_same_map(copy.snapshot(then).load_map("map-1"), random_map(1))


def test_names_and_urls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Database("maps.db").url == str(tmp_path / "maps.db")
    assert Database(f"file://{tmp_path}/maps.db").url == str(tmp_path / "maps.db")
    assert Database("s3://bucket/a/town/").url == "s3://bucket/a/town"
    assert Database("s3://bucket/a/town/").name == "town"
