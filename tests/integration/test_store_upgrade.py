"""Databases as older releases have written them, kept in `tests/data`: read, and made as those of today."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from deltalake import DeltaTable

from featuredb.cli.main import main
from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store.canaries import list_canaries, load_canary_image
from featuredb.store.candidates.photos import list_candidates, load_images
from featuredb.store.delta import Table
from featuredb.store.durable import making
from featuredb.store.durable import upgrade as upgrade_module
from featuredb.store.durable.log import acknowledged
from featuredb.store.durable.making import is_of_an_older_release
from featuredb.store.durable.upgrade import upgrade
from featuredb.store.encode import content_digest
from featuredb.store.tables import FORMAT_VERSION
from featuredb.store.verify import verify
from tests.support.command_line import only_command
from tests.support.contributions import contribution
from tests.support.maps import random_map, random_unplaced_map
from tests.support.power_cut import Disk, State, write_state

DATA = Path(__file__).parent.parent / "data"
# Written by the release before maps without a place; by the one before durable commits, which left files
# beside removed rows that Arrow cannot filter, and photos in statistics.
GOLDEN = ("format1.db", "format2.db")


@pytest.fixture(params=GOLDEN)
def old(request: pytest.FixtureRequest, tmp_path: Path) -> Database:
    shutil.copytree(DATA / request.param, tmp_path / "old.db")
    return Database.open(tmp_path / "old.db")


def tables_of(database: Database) -> list[Table]:
    return [database.table(path.name) for path in sorted(Path(database.url).iterdir())]


def old_files(database: Database) -> list[str]:
    fragments = [f for table in tables_of(database) for f in table.dataset().get_fragments()]
    return [f.path for f in fragments if is_of_an_older_release(f)]


def is_of_today(database: Database) -> bool:
    tables = tables_of(database)
    formats = {table.format for table in tables}
    return formats == {FORMAT_VERSION} and all(acknowledged(t.storage) == t.version for t in tables)


def test_an_upgrade_changes_nothing_that_is_there(old: Database) -> None:
    before = old.snapshot()
    digests = {row["map_id"]: row["content_digest"] for row in before.rows()}
    assert upgrade(old)
    assert is_of_today(old)
    assert old_files(old) == []
    assert upgrade(old) == []
    for snapshot in (old.snapshot(), old.snapshot(before.version)):
        assert {m: content_digest(snapshot.load_any(m)) for m in digests} == digests
    old.commit_maps([random_map(8, extent_m=10.0), random_unplaced_map(9)])
    assert verify(old).problems == ()
    for name in ("maps", "points"):
        stored = DeltaTable(f"{old.url}/{name}").metadata().configuration
        fresh = DeltaTable(f"{Database.create(old.url + '-new').url}/{name}").metadata().configuration
        assert stored == fresh


def test_what_an_older_release_made_unreadable_comes_back(tmp_path: Path) -> None:
    shutil.copytree(DATA / "format2.db", tmp_path / "old.db")
    old = Database.open(tmp_path / "old.db")
    assert any("run `featuredb upgrade`" in p.what for p in verify(old).problems)
    assert len(old_files(old)) == 6
    with pytest.raises(StoreError):
        old.snapshot().load_map("map-1")
    upgrade(old)
    assert verify(old).problems == ()
    assert [c.candidate_id for c in list_candidates(old, state="withdrawn")]
    (waiting,) = list_candidates(old, state="waiting")
    assert dict(load_images(old, [waiting.candidate_id])) == {waiting.candidate_id: contribution(1).image}
    images = {c.name: load_canary_image(old, c) for c in list_canaries(old)}
    assert images == {"gate": contribution(7).image, "sea": contribution(8).image}


@pytest.mark.parametrize(("commit_bytes", "commits"), [(2**30, 1), (1, 6)])
def test_old_files_are_written_anew_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, commit_bytes: int, commits: int
) -> None:
    database = Database.create(tmp_path / "many.db")
    for seed in range(6):
        database.commit_map(random_map(seed, extent_m=10.0))
    for row in database.snapshot().rows():  # leaves types that are not written any more, in a file each
        one = f"write_id = '{row['write_id']}' AND point_index = 0"
        DeltaTable(f"{database.url}/points").delete(one)
    number = len(old_files(database))
    assert number == 6
    looked, before = list[str](), database.table("points").version

    def look(fragment: Any) -> bool:
        looked.append(fragment.path)
        return is_of_an_older_release(fragment)

    monkeypatch.setattr(upgrade_module, "is_of_an_older_release", look)
    monkeypatch.setattr(upgrade_module, "_COMMIT_BYTES", commit_bytes)
    rows = database.table("points").dataset().count_rows()
    assert upgrade(database) == [f"points: {number} files of an older release written anew"]
    assert len(looked) == len(set(looked))
    assert database.table("points").version == before + commits
    assert old_files(database) == []
    assert database.table("points").dataset().count_rows() == rows


def test_an_upgrade_that_was_cut_off_goes_on(
    old: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = {row["map_id"]: row["content_digest"] for row in old.snapshot().rows()}
    found, states = old.format, list[State]()
    with monkeypatch.context() as patch:
        disk = Disk(Path(old.url), patch, lambda: states.append(disk.surviving(names=True)))
        upgrade(old)
    for state in [s for i, s in enumerate(states) if s not in states[:i]][::12]:
        write_state(state, tmp_path / "left.db")
        left = Database.open(tmp_path / "left.db")
        assert left.format in (found, FORMAT_VERSION)
        upgrade(left)
        assert is_of_today(left)
        assert verify(left).problems == ()
        assert {m: content_digest(left.snapshot().load_any(m)) for m in digests} == digests
        shutil.rmtree(tmp_path / "left.db")


def test_the_command_says_what_it_did(
    old: Database, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with only_command(monkeypatch, "db", "featuredb.cli.database:register"):
        assert main(["upgrade", old.url]) == 0
        said = capsys.readouterr().out.splitlines()
        assert any(line.startswith("maps: ") for line in said)
        assert main(["upgrade", old.url]) == 0
        assert capsys.readouterr().out == f"format {FORMAT_VERSION}, nothing to do\n"
        monkeypatch.setattr(making, "READABLE_FORMATS", (1,))
        assert main(["upgrade", old.url]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "has featuredb format 2, expected 1 or older; use a newer featuredb" in err
