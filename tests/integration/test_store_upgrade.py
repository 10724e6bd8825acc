"""Databases of each format, kept in `tests/data`: read, and those of older ones made as those of today."""

import shutil
from pathlib import Path

import pytest
from deltalake import DeltaTable

from featuredb.cli.main import main
from featuredb.store import Database
from featuredb.store.canaries import list_canaries, load_canary_image
from featuredb.store.candidates.photos import list_candidates, load_images
from featuredb.store.delta import Table
from featuredb.store.durable import making
from featuredb.store.encode import content_digest
from featuredb.store.maintenance import upgrade
from featuredb.store.tables import FORMAT_VERSION
from featuredb.store.verify import verify
from tests.support.command_line import only_command
from tests.support.contributions import contribution
from tests.support.maps import random_map, random_unplaced_map
from tests.support.power_cut import Disk, State, write_state

DATA = Path(__file__).parent.parent / "data"
OLD = DATA / "format1.db"  # written before maps without a place


@pytest.fixture
def old(tmp_path: Path) -> Database:
    shutil.copytree(OLD, tmp_path / "old.db")
    return Database.open(tmp_path / "old.db")


def tables_of(database: Database) -> list[Table]:
    return [database.table(path.name) for path in sorted(Path(database.url).iterdir())]


def is_of_today(database: Database) -> bool:
    return {table.format for table in tables_of(database)} == {FORMAT_VERSION}


def test_an_upgrade_changes_nothing_that_is_there(old: Database) -> None:
    before = old.snapshot()
    digests = {row["map_id"]: row["content_digest"] for row in before.rows()}
    assert upgrade(old)
    assert is_of_today(old)
    assert upgrade(old) == []
    for snapshot in (old.snapshot(), old.snapshot(before.version)):
        assert {m: content_digest(snapshot.load_any(m)) for m in digests} == digests
    old.commit_maps([random_map(8, extent_m=10.0), random_unplaced_map(9)])
    assert verify(old).problems == ()
    for name in ("maps", "points"):
        stored = DeltaTable(f"{old.url}/{name}").metadata().configuration
        fresh = DeltaTable(f"{Database.create(old.url + '-new').url}/{name}").metadata().configuration
        assert stored == fresh


def test_a_database_of_the_newest_format_is_read(tmp_path: Path) -> None:
    shutil.copytree(DATA / "format2.db", tmp_path / "there.db")
    there = Database.open(tmp_path / "there.db")
    assert upgrade(there) == []
    assert verify(there).problems == ()
    for row in there.snapshot().rows():
        assert content_digest(there.snapshot().load_any(row["map_id"])) == row["content_digest"]
    assert [c.candidate_id for c in list_candidates(there, state="withdrawn")]
    (waiting,) = list_candidates(there, state="waiting")
    assert dict(load_images(there, [waiting.candidate_id])) == {waiting.candidate_id: contribution(1).image}
    images = {c.name: load_canary_image(there, c) for c in list_canaries(there)}
    assert images == {"gate": contribution(7).image, "sea": contribution(8).image}


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
