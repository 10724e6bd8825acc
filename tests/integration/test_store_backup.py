"""Backups: a state of the database that was, whole or not there, and a database again by `restore`."""

import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.cli.main import main
from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, withdraw
from featuredb.store.durable import backup as backup_module
from featuredb.store.durable.backup import backup, restore
from featuredb.store.durable.copies import LIST, CopyPlace
from featuredb.store.maintenance import compact, vacuum
from featuredb.store.verify import verify
from tests.support.bit_flips import rich_database, seen
from tests.support.command_line import only_command
from tests.support.contributions import contribution
from tests.support.maps import random_map
from tests.support.power_cut import Disk, State, write_state
from tests.support.store_suite import NOTHING_KEPT


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database to be copied."""
    return Path(rich_database(tmp_path_factory.mktemp("rich") / "maps.db").url)


@pytest.fixture
def database(rich: Path, tmp_path: Path) -> Database:
    return Database(str(shutil.copytree(rich, tmp_path / "maps.db")))


@pytest.fixture
def target(tmp_path: Path) -> str:
    return str(tmp_path / "backup.db")


def restored(target: str, place: Path) -> Database:
    """A database of the backup, which is removed by the next call."""
    shutil.rmtree(place, ignore_errors=True)
    restore(target, Database(str(place)))
    return Database.open(place)


def test_a_restored_database_goes_on_where_the_backup_was_made(
    database: Database, target: str, tmp_path: Path
) -> None:
    before = seen(database)
    first = backup(database, target)
    assert (first.version, first.kept) == (database.poll_version(), 0)
    assert verify(Database.open(target)).ok
    place = tmp_path / "restored.db"
    assert seen(restored(target, place)) == before

    database.commit_map(random_map(4, extent_m=10.0))
    second = backup(database, target)
    entries = 4  # one in each table of maps, and a file for each
    assert (second.files, second.kept) == (2 * entries, first.files)
    again = restored(target, place)
    assert not Path(again.url, LIST).exists()
    assert seen(again) == seen(database)
    assert verify(again).ok
    assert [e.operation for e in again.history()] == [e.operation for e in database.history()]
    again.rollback(1)  # what `maps` was at each kept version is in the backup, too
    assert [m.map_id for m in again.snapshot().maps()] == ["map-1"]


def test_a_backup_while_others_write(database: Database, target: str, tmp_path: Path) -> None:
    ends = threading.Event()

    def write() -> None:
        for seed in range(10, 1000):
            if ends.is_set():
                return
            # A map in the place of another, and what that had is vacuumed at once.
            database.commit_map(replace(random_map(seed, extent_m=10.0), map_id="map-1"), replaces="map-1")
            compact(database)
            vacuum(database, NOTHING_KEPT)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        versions = set()
        for _ in range(6):
            versions.add(backup(database, target).version)
            report = verify(restored(target, tmp_path / "restored.db"))
            assert report.problems == ()
    finally:
        ends.set()
        writer.join()
    assert len(versions) > 3


def test_children_are_those_that_the_version_names(
    database: Database, target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between a look at `maps` and one at its children, what it names is replaced and vacuumed."""
    whole, calls = database.table, []

    def table(name: str, version: int | None = None) -> object:
        if name == "images" and not calls:
            calls.append(name)
            new = replace(random_map(9, extent_m=10.0), map_id="map-1")
            other = Database.open(database.url)
            other.commit_map(new, replaces="map-1")
            vacuum(other, NOTHING_KEPT)
        return whole(name, version)

    monkeypatch.setattr(database, "table", table)
    backup(database, target)
    assert calls
    assert verify(restored(target, tmp_path / "restored.db")).problems == ()


def test_withdrawn_photos_leave_the_next_backup(database: Database, target: str) -> None:
    (photo,) = contribute(database, [contribution(2)])
    compact(database)  # both photos in one file
    backup(database, target)
    held = set(Path(target, "candidate_images").glob("*.parquet"))
    assert held
    withdraw(database, [photo], "asked")
    assert backup(database, target).removed > 0
    assert not held & set(Path(target, "candidate_images").glob("*.parquet"))
    assert verify(Database.open(target)).ok


@pytest.mark.parametrize("every", [40, pytest.param(1, marks=pytest.mark.evaluation)])
@pytest.mark.parametrize("what", ["backup", "restore"])
def test_a_power_cut_leaves_the_backup_before_or_after(
    database: Database, target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str, every: int
) -> None:
    """Whatever is left, the same command goes on, and `restore` never makes half a database."""
    place = tmp_path / "place.db"
    backup(database, target)
    before = seen(database)
    if what == "backup":
        shutil.copytree(target, place)
        database.commit_map(random_map(4, extent_m=10.0))
        compact(database)
        vacuum(database, NOTHING_KEPT)
    after, states = seen(database), list[State]()

    def run(folder: Path) -> object:
        return backup(database, str(folder)) if what == "backup" else restore(target, Database(str(folder)))

    with monkeypatch.context() as patch:
        place.mkdir(exist_ok=True)
        disk = Disk(place, patch, lambda: states.extend(disk.surviving(names=n) for n in (False, True)))
        run(place)
        done = disk.surviving(names=False)
    left = tmp_path / "left.db"
    for state in [s for i, s in enumerate(states) if s not in states[:i]][::every]:
        write_state(state, left)
        if what == "backup":
            assert seen(restored(str(left), tmp_path / "restored.db")) in (before, after)
            whole = LIST in state and CopyPlace(str(left), None).read_list().whole  # type: ignore[union-attr]
            assert verify(Database(str(left))).ok == whole
        if what == "backup" or LIST in state or "maps" not in state:  # not where the restore was done
            run(left)
        assert seen(Database.open(left)) == after
        assert verify(Database.open(left)).ok
        shutil.rmtree(left)
    write_state(done, left)
    assert seen(Database.open(left)) == after
    assert verify(Database.open(left)).ok


@pytest.mark.parametrize("listed", ["in order", "by name"])
def test_a_restore_that_was_cut_off_is_no_database(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: str
) -> None:
    """Also of a backup that was made in several runs, whose first files are those of an older state."""
    database = Database.create(tmp_path / "two.db")
    database.commit_maps([random_map(1, extent_m=10.0), random_map(2, extent_m=10.0)])
    backup(database, target)
    database.retire("map-2", "wrong")
    copies = backup(database, target)
    if listed == "by name":
        place = CopyPlace(target, None)
        found = place.read_list()
        assert found is not None
        place.write_list(replace(found, files=dict(sorted(found.files.items()))))
    left, take, begun = Database(str(tmp_path / "left.db")), CopyPlace.take, list[str]()

    def cut(self: CopyPlace, path: str, *args: object) -> object:
        begun.append(path)
        with pytest.raises(StoreError):  # its tables alone are not one either
            left.snapshot()
        for enter in (Database.open, Database.create):
            with pytest.raises(StoreError, match=r"restore from .* run the same restore again$"):
                enter(left.url)
        return take(self, path, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(CopyPlace, "take", cut)
    restore(target, left)
    assert len(begun) == copies.files + copies.kept
    assert [m.map_id for m in Database.open(left.url).snapshot().maps()] == ["map-1"]


def test_damage_is_found_while_copying(database: Database, target: str, tmp_path: Path) -> None:
    backup(database, target)
    truth = seen(database)
    database.commit_map(random_map(4, extent_m=10.0))
    new = max(Path(database.url, "points").rglob("*.parquet"), key=lambda p: p.stat().st_mtime)
    content = new.read_bytes()
    new.write_bytes(content[:90] + bytes([content[90] ^ 1]) + content[91:])
    with pytest.raises(StoreError, match=rf"{new.name}: its bytes are not those .*featuredb verify"):
        backup(database, target)
    new.unlink()
    with pytest.raises(StoreError, match=f"lost .*{new.name}.*featuredb verify"):
        backup(database, target)
    assert seen(restored(target, tmp_path / "restored.db")) == truth, "the backup before is still there"

    held = next(Path(target, "points").rglob("*.parquet"))
    content = held.read_bytes()
    held.write_bytes(content[:90] + bytes([content[90] ^ 1]) + content[91:])
    with pytest.raises(StoreError, match=f"{held.name}: its bytes are not those .*back up again"):
        restore(target, Database(str(tmp_path / "other.db")))
    held.unlink()
    with pytest.raises(StoreError, match=f"damaged .*{held.name}.*another one"):
        restore(target, Database(str(tmp_path / "another.db")))


def test_the_next_backup_heals_damaged_files(database: Database, target: str, tmp_path: Path) -> None:
    backup(database, target)
    entry = Path(target, "maps", "_delta_log", f"{1:020d}.json")
    for held in (next(Path(target, "points").rglob("*.parquet")), entry):
        content = held.read_bytes()
        held.write_bytes(content[:90] + bytes([content[90] ^ 1]) + content[91:])
        assert backup(database, target).files == 1
        assert held.read_bytes() == content
    assert seen(restored(target, tmp_path / "restored.db")) == seen(database)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]"])
def test_a_damaged_list_is_a_problem_of_the_backup(database: Database, target: str, content: bytes) -> None:
    backup(database, target)
    Path(target, LIST).write_bytes(content)
    (problem,) = verify(Database.open(target)).problems
    assert problem.where == LIST
    assert "is damaged" in problem.what


def test_what_is_there_is_not_overwritten(database: Database, target: str, tmp_path: Path) -> None:
    backup(database, target)
    other = Database.create(tmp_path / "other.db")
    with pytest.raises(StoreError, match="another database or a later state"):
        backup(other, target)
    with pytest.raises(StoreError, match=r"other.db holds files.*choose an empty folder"):
        backup(database, other.url)
    with pytest.raises(StoreError, match="to itself"):
        backup(database, database.url)
    for place in (other.url, target):
        with pytest.raises(
            StoreError, match=r"holds (files|a copy of another kind), and a restore overwrites"
        ):
            restore(target, Database(place))
    with pytest.raises(StoreError, match=r"no backup at .*featuredb backup"):
        restore(database.url, Database(str(tmp_path / "new.db")))

    # A restored database is a state of before: its backup may not take the later one's place.
    earlier = restored(target, tmp_path / "restored.db")
    database.retire("map-1", "wrong")
    backup(database, target)
    with pytest.raises(StoreError, match="a later state; choose another folder"):
        backup(earlier, target)
    Database.open(target).commit_map(random_map(5))  # a backup that was taken for a database
    with pytest.raises(StoreError, match="a later state; choose another folder"):
        backup(database, target)


def test_two_backups_at_once(database: Database, target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    backup(database, target)
    database.retire("map-1", "wrong")
    real = CopyPlace.take

    def take(self: CopyPlace, *args: object) -> object:
        monkeypatch.undo()
        backup(Database.open(database.url), target)
        return real(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(CopyPlace, "take", take)
    with pytest.raises(StoreError, match="at work: let it finish"):
        backup(database, target)
    assert verify(Database.open(target)).ok


def test_two_backups_that_write_one_file(
    database: Database, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other has shown what this one was writing: no file of the database is lost."""
    real = CopyPlace._show

    def show(self: CopyPlace, path: str) -> None:
        real(self, path)
        if path.endswith(".parquet"):
            real(self, path)

    monkeypatch.setattr(CopyPlace, "_show", show)
    with pytest.raises(StoreError, match=r"another copy to .* is at work: let it finish"):
        backup(database, target)


def test_the_commands(
    database: Database, target: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with only_command(monkeypatch, "db", "featuredb.cli.database:register"):
        assert main(["backup", database.url, target]) == 0
        assert capsys.readouterr().out.startswith(f"backup at {target}: version 3, 31 files copied (0.2 MB)")
        monkeypatch.setattr(
            backup_module, "_acknowledge", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        assert main(["restore", target, target + "-2"]) == 130
        monkeypatch.undo()
    with only_command(monkeypatch, "db", "featuredb.cli.database:register"):
        capsys.readouterr()
        assert main(["verify", target + "-2"]) == 1
        assert f"PROBLEM {LIST}: a restore from {target} to here was cut off" in capsys.readouterr().out
        assert main(["restore", target, target + "-2"]) == 0
        assert "0 files copied (0.0 MB), 31 there already" in capsys.readouterr().out
        assert main(["restore", target, target + "-2"]) == 2
        assert "choose an empty folder" in capsys.readouterr().err
