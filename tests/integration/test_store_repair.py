"""Damaged logs: said by every command, found by `verify`, mended by `repair` without losing what was done."""

import json
import shutil
from pathlib import Path

import pyarrow.fs as fs
import pytest

from featuredb.cli.main import main
from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store.durable import publish
from featuredb.store.durable.log import DIGEST, acknowledge, acknowledged, entry_name
from featuredb.store.durable.repair import repair
from featuredb.store.tables import CHILD_TABLES, MAPS
from featuredb.store.verify import verify
from tests.support.maps import random_map


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of two maps, to be copied."""
    database = Database.create(tmp_path_factory.mktemp("whole") / "maps.db")
    for seed in (1, 2):
        database.commit_map(random_map(seed, extent_m=10.0))
    return Path(database.url)


@pytest.fixture
def database(whole: Path, tmp_path: Path) -> Database:
    return Database(str(shutil.copytree(whole, tmp_path / "maps.db")))


def entry(database: Database, table: str, version: int) -> Path:
    return Path(database.url, table, "_delta_log", entry_name(version))


def not_acknowledged(database: Database, table: str) -> None:
    """As if the power had failed before the newest commit to the table was said to be done."""
    (marker,) = Path(database.url, table, "_acknowledged").iterdir()
    marker.rename(marker.with_name(f"{int(marker.name) - 1:020d}"))


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    code = main(list(arguments))
    captured = capsys.readouterr()
    return code, captured.out + captured.err


def cuts(content: bytes) -> list[int]:
    """Where an entry is cut: nothing, in the first line, between lines, in the last line, before its end."""
    lines = [len(line) for line in content.splitlines(keepends=True)]
    first, last = lines[0], lines[-1]
    return [0, 1, first // 2, first - 1, first, first + 1, len(content) - last // 2, len(content) - 2]


@pytest.mark.parametrize("table", [MAPS, *CHILD_TABLES])
@pytest.mark.parametrize("cut", range(8))
def test_a_torn_newest_entry_is_set_aside(database: Database, table: str, cut: int) -> None:
    if table != MAPS:  # which does not name the rows yet whose entry is torn
        entry(database, MAPS, 2).unlink()
        not_acknowledged(database, MAPS)
    not_acknowledged(database, table)
    torn = entry(database, table, 2)
    content = torn.read_bytes()
    torn.write_bytes(content[: cuts(content)[cut]])
    said = rf"{table}: _delta_log/0*2.json: it .*; `featuredb repair`"
    with pytest.raises(StoreError, match=said):
        database.snapshot()
    if table == MAPS:
        with pytest.raises(StoreError, match=said):
            database.poll_version()
    assert [p.where for p in verify(database).problems] == [f"{table}/_delta_log/{torn.name}"]

    (step,) = repair(database)
    assert step.action.endswith(f"back to version 1 of {table}")
    assert torn.exists(), "a dry run changes nothing"
    assert repair(database, apply=True) == [step]
    assert not torn.exists()
    (aside,) = Path(database.url, table, "_set_aside").iterdir()
    assert aside.read_bytes() == content[: cuts(content)[cut]]
    assert verify(database).ok
    assert [m.map_id for m in database.snapshot().maps()] == ["map-1"]
    assert database.commit_map(random_map(2, extent_m=10.0)).created
    assert verify(database).ok


def test_the_commands_say_what_is_wrong_and_what_to_do(
    database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    not_acknowledged(database, MAPS)
    entry(database, MAPS, 2).write_bytes(b"")
    for command in (("maps",), ("sql", "select 1"), ("history",), ("retire", "map-1", "--reason", "x")):
        code, said = run(capsys, command[0], database.url, *command[1:])
        assert code == 2
        assert "it is empty (0 bytes); `featuredb repair`" in said
    code, said = run(capsys, "verify", database.url)
    assert code == 1
    assert "PROBLEM maps/_delta_log/00000000000000000002.json: it is empty" in said
    code, said = run(capsys, "repair", database.url)
    assert code == 1
    assert "would be done: set aside: back to version 1 of maps" in said
    assert run(capsys, "repair", database.url, "--apply")[0] == 0
    assert run(capsys, "repair", database.url)[0] == 0
    assert run(capsys, "verify", database.url)[0] == 0
    code, said = run(capsys, "repair", f"{database.url}-elsewhere")
    assert (code, "no featuredb table" in said) == (2, True)


@pytest.mark.parametrize("damage", ["missing", "empty"])
@pytest.mark.parametrize("table", [MAPS, *CHILD_TABLES])
def test_what_was_acknowledged_is_not_given_up_unasked(database: Database, table: str, damage: str) -> None:
    lost = entry(database, table, 2)
    if damage == "missing":
        lost.unlink()
    else:
        lost.write_bytes(b"")
    with pytest.raises(StoreError, match="acknowledged" if damage == "missing" else "empty"):
        database.snapshot()
    with pytest.raises(StoreError, match="featuredb repair"):
        database.commit_map(random_map(3, extent_m=10.0))
    assert [p.where for p in verify(database).problems] == [f"{table}/_delta_log/{lost.name}"]
    (step,) = repair(database, apply=True)
    assert step.action == ""
    assert "backup" in step.advice
    assert lost.exists() == (damage == "empty")

    repair(database, apply=True, give_up_lost=True)
    left = verify(database)
    assert left.version == (1 if table == MAPS else 2)
    assert left.ok == (table == MAPS), "a map whose rows are lost is still named, and found"
    if not left.ok:
        database.rollback(1)
        assert verify(database).ok


def test_an_older_entry_is_found_and_left_alone(database: Database) -> None:
    for damage in ("missing", "torn"):
        copy = Database(str(shutil.copytree(database.url, f"{database.url}-{damage}")))
        path = entry(copy, "points", 1)
        content = path.read_bytes()
        path.unlink()
        if damage == "torn":
            path.write_bytes(content[: content.index(b"\n") + 1])
        before = sorted(Path(copy.url).rglob("*"))
        assert verify(copy).problems[0].where == f"points/_delta_log/{path.name}"
        (step,) = repair(copy, apply=True, give_up_lost=True)
        assert (step.action, "backup" in step.advice) == ("", True)
        assert sorted(Path(copy.url).rglob("*")) == before


def test_a_database_without_acknowledgements_is_read_and_repaired(database: Database) -> None:
    """One of an older release."""
    for table in (MAPS, *CHILD_TABLES):
        shutil.rmtree(Path(database.url, table, "_acknowledged"))
    assert verify(database).ok
    entry(database, MAPS, 2).write_bytes(b"")
    assert not verify(database).ok
    repair(database, apply=True)
    assert [m.map_id for m in database.snapshot().maps()] == ["map-1"]
    assert database.commit_map(random_map(3, extent_m=10.0)).version == 2
    assert acknowledged(database.table(MAPS).storage) == 2


def test_the_last_acknowledged_version_is_the_highest(tmp_path: Path) -> None:
    files = fs.SubTreeFileSystem(str(tmp_path), fs.LocalFileSystem())
    for version in (5, 7, 6):
        acknowledge(files, version)
    assert acknowledged(files) == 7
    acknowledge(files, 8)
    assert [p.name for p in (tmp_path / "_acknowledged").iterdir()] == [f"{8:020d}"]


@pytest.mark.parametrize("name", ["_last_checkpoint", "00000000000000000004.checkpoint.parquet"])
def test_a_broken_checkpoint_is_set_aside(
    database: Database, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
    for seed in (3, 4, 5):
        database.commit_map(random_map(seed, extent_m=10.0))
    broken = Path(database.url, MAPS, "_delta_log", name)
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    assert f"maps/_delta_log/{name}" in [p.where for p in verify(database).problems]
    repair(database, apply=True)
    repair(database, apply=True)  # the name of a checkpoint that is gone
    report = verify(database)
    assert (report.ok, report.maps) == (True, 5)


def test_a_torn_entry_goes_with_its_checkpoint(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
    for seed in (3, 4):
        database.commit_map(random_map(seed, extent_m=10.0))
    torn = entry(database, MAPS, 4)
    assert torn.with_name(f"{4:020d}.checkpoint.parquet").exists()
    torn.write_bytes(torn.read_bytes()[:100])
    repair(database, apply=True, give_up_lost=True)
    report = verify(database)
    assert (report.ok, report.maps) == (True, 3)
    assert database.commit_map(random_map(4, extent_m=10.0)).created


def test_a_torn_name_of_the_checkpoint_hinders_no_commit(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
    for seed in (3, 4):
        Path(database.url, MAPS, "_delta_log", "_last_checkpoint").write_bytes(b"{")
        database.commit_map(random_map(seed, extent_m=10.0))
    assert verify(database).ok


def test_a_log_whose_columns_or_counts_are_damaged(database: Database) -> None:
    """One bit of an entry that still reads: a column's name, and the name of a file's number of rows."""
    for version, word, other in ((0, b"point_index", b"qoint_index"), (1, b"numRecords", b"oumRecords")):
        copy = Database(str(shutil.copytree(database.url, f"{database.url}-{version}")))
        path = entry(copy, "points", version)
        path.write_bytes(path.read_bytes().replace(word, other))
        assert "hashes differ" in str(verify(copy).problems)
        actions = [json.loads(line) for line in path.read_text().splitlines()]
        for action in actions:  # as an older release would have written it
            action.get("commitInfo", {}).pop(DIGEST, None)
        path.write_text("".join(json.dumps(action) + "\n" for action in actions))
        if version:
            assert "expected 0 rows by the log, found 60" in str(verify(copy).problems)
        else:
            with pytest.raises(StoreError, match=r"columns that no format has \(qoint_index\)"):
                verify(copy)
