"""`verify` names each kind of damage."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable, write_deltalake

from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store import verify as verify_module
from featuredb.store.candidates.photos import contribute
from featuredb.store.durable import log as log_module
from featuredb.store.durable import publish
from featuredb.store.durable.log import log_problems
from featuredb.store.verify import DatabaseProblem, VerifyReport, verify
from tests.support.contributions import contribution
from tests.support.maps import random_map


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database to be copied."""
    database = Database.create(tmp_path_factory.mktemp("whole") / "maps.db")
    # One tile, so that there is one file for each child table to damage.
    database.commit_map(random_map(1, extent_m=10.0))
    assert verify(database).ok
    return Path(database.url)


@pytest.fixture
def database(whole: Path, tmp_path: Path) -> Database:
    return Database(str(shutil.copytree(whole, tmp_path / "maps.db")))


def data_file(database: Database, table: str) -> Path:
    files = sorted(Path(database.url, table).rglob("*.parquet"))
    assert files
    return files[0]


def edit_file(database: Database, table: str, edit: Callable[[pa.Table], pa.Table]) -> None:
    """Rewrite a data file behind the log's back, to the same number of bytes, as the log knows that, too."""
    path = data_file(database, table)
    size = path.stat().st_size
    rows = edit(pq.ParquetFile(path).read())
    pq.write_table(rows, path, compression="zstd", compression_level=19, write_statistics=False)
    content = path.read_bytes()
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    assert len(content) <= size
    path.write_bytes(content[:footer] + bytes(size - len(content)) + content[footer:])


def set_first(column: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    """Change a column in the first row."""

    def edit(table: pa.Table) -> pa.Table:
        index = table.schema.get_field_index(column)
        values = [value, *table[column].to_pylist()[1:]]
        return table.set_column(
            index, table.schema.field(index), pa.array(values, table.schema.field(index).type)
        )

    return edit


def problems(database: Database) -> str:
    report = verify(database)
    assert not report.ok
    return "\n".join(f"{p.where}: {p.what}" for p in report.problems)


@pytest.mark.parametrize("table", ["images", "points", "observations"])
def test_a_deleted_file(database: Database, table: str) -> None:
    data_file(database, table).unlink()
    found = problems(database)
    assert f"{table}/" in found
    assert "map map-1: cannot be loaded" in found


@pytest.mark.parametrize("table", ["images", "points", "observations"])
def test_a_truncated_file(database: Database, table: str) -> None:
    path = data_file(database, table)
    path.write_bytes(path.read_bytes()[:-20])
    assert f"{table}/" in problems(database)


def test_a_flipped_byte_in_the_data(database: Database) -> None:
    path = data_file(database, "observations")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x10
    path.write_bytes(content)
    assert "map map-1" in problems(database)


def test_a_lost_row(database: Database) -> None:
    edit_file(database, "points", lambda table: table.slice(1))
    found = problems(database)
    assert "expected 60 rows by the log, found 59" in found
    assert "points: expected 60 rows" in found


def test_a_double_row(database: Database) -> None:
    edit_file(database, "observations", lambda t: pa.concat_tables([t.slice(1), t.slice(1, 1)]))
    assert "observation_index being each of 0 to 199, found 200 of which 199 are different" in problems(
        database
    )


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("points", "height", 1e4, "content digests differ"),
        ("points", "easting", float("nan"), "cannot be loaded"),
        ("images", "easting", 100_000.0, "images: easting is not that of the map's coordinates"),
        ("images", "camera_id", 7, "cannot be loaded"),
        ("images", "image_id", 77, "cannot be loaded"),
        ("observations", "point_index", 1000, "cannot be loaded"),
        ("points", "error_px", 0.001, "content digests differ"),
        ("points", "red", 300, "content digests differ"),
        ("observations", "descriptor", b"short", "cannot be loaded"),
        ("images", "name", "other.jpg", "content digests differ"),
    ],
)
def test_an_edited_row(database: Database, table: str, column: str, value: Any, message: str) -> None:
    edit_file(database, table, set_first(column, value))
    assert message in problems(database)


def test_observations_in_another_tile_than_their_point(database: Database) -> None:
    table = DeltaTable(f"{database.url}/observations")
    rows = table.to_pyarrow_table()
    moved = rows.set_column(
        rows.schema.get_field_index("tile"),
        rows.schema.field("tile"),
        pa.repeat("E000001_N000001", len(rows)),
    )
    write_deltalake(table, moved, mode="overwrite")
    assert "observations: tile is not that of the map's coordinates" in problems(database)


def test_a_row_of_maps_that_lies(database: Database) -> None:
    table = DeltaTable(f"{database.url}/maps")
    table.update(updates={"points": "points + 1"})
    assert "points: expected 61 rows" in problems(database)


def test_rows_of_an_unknown_write_are_orphans_and_no_damage(database: Database) -> None:
    table = DeltaTable(f"{database.url}/points")
    rows = table.to_pyarrow_table()
    foreign = rows.set_column(
        rows.schema.get_field_index("write_id"), rows.schema.field("write_id"), pa.repeat("0" * 32, len(rows))
    )
    write_deltalake(table, foreign, mode="append")
    report = verify(database)
    assert report.ok
    assert report.orphans == ("0" * 32,)
    points = database.snapshot().dataset("points").to_table(["write_id"])
    assert pc.count_distinct(points["write_id"]).as_py() == 1


@pytest.mark.parametrize("before", ["write_ids_in", "named_writes"])
def test_a_commit_while_orphans_are_sought(
    database: Database, monkeypatch: pytest.MonkeyPatch, before: str
) -> None:
    contribute(database, [contribution(1)])
    real, calls = getattr(verify_module, before), list[object]()

    def meanwhile(*args: Any) -> Any:
        if not calls:
            calls.append(database.commit_map(random_map(2)))
            contribute(database, [contribution(2)])
        return real(*args)

    monkeypatch.setattr(verify_module, before, meanwhile)
    assert verify(database).orphans == ()
    assert calls


def test_each_log_entry_is_read_once(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
    for _ in range(6):
        database.table("maps").compact()
        database.retire("map-1", "wrong")
        database.rollback(1)
    files = database.table("maps").storage
    log = Path(database.url, "maps", "_delta_log")
    assert len(list(log.glob("*.checkpoint.parquet"))) > 3
    read, real = list[str](), log_module._read
    monkeypatch.setattr(log_module, "_read", lambda files, path: read.append(path) or real(files, path))
    assert list(log_problems(files)) == []
    assert sorted(Path(path).name for path in read) == sorted(
        path.name for path in log.iterdir() if path.suffix != ".parquet"
    )
    read.clear()
    assert log_module.whole_entry(files, 3)[0] == (log / log_module.entry_name(3)).read_bytes()
    assert len(read) == 1


def test_what_was_found_before_a_store_failed_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stored:
        url, storage_options = "s3://bucket/maps", None

    def denied(place: object) -> None:
        raise OSError("access denied")

    found = VerifyReport(problems=(DatabaseProblem(where="points", what="a file is gone"),))
    monkeypatch.setattr("featuredb.store.verify._verify", lambda database: found)
    monkeypatch.setattr("featuredb.store.verify._read_all", denied)
    with pytest.raises(StoreError, match=r"access denied; found before.*points: a file is gone"):
        verify(Stored())  # type: ignore[arg-type]  # it is asked for nothing else


def test_what_was_found_is_said_when_the_store_fails_at_the_second_look(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Stored:
        url, storage_options = "s3://bucket/maps", None

    looks = iter([VerifyReport(problems=(DatabaseProblem(where="points", what="a file is gone"),))])

    def look(database: object) -> VerifyReport:
        for report in looks:
            return report
        raise StoreError("no answer")

    monkeypatch.setattr("featuredb.store.verify._verify", look)
    monkeypatch.setattr("featuredb.store.verify._read_all", lambda place: None)
    with pytest.raises(StoreError, match=r"no answer; found before.*points: a file is gone"):
        verify(Stored())  # type: ignore[arg-type]  # it is asked for nothing else


def test_a_commit_whose_checkpoint_fails_is_done(
    database: Database, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 1)
    monkeypatch.setattr(publish, "publish_checkpoint", full)
    assert database.retire("map-1", "wrong") == ("map-1",)
    assert database.snapshot().maps() == []
    assert "no checkpoint" in caplog.text
