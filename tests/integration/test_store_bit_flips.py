"""A single bit turned over, a log cut off anywhere: found by `verify` or harmless, never an exception."""

import shutil
from pathlib import Path

import pytest

from featuredb.store import Database
from featuredb.store.durable import local
from tests.support.bit_flips import flip_bits, outcome, rich_database, seen

FLIPS = 15  # `python -m tests.support.bit_flips` makes as many as wanted


@pytest.fixture
def database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Database:
    monkeypatch.setattr(local, "CHECKPOINT_INTERVAL", 2)
    return rich_database(tmp_path / "maps.db")


@pytest.mark.slow
def test_single_bits(database: Database, tmp_path: Path) -> None:
    found = flip_bits(database, tmp_path / "copy.db", FLIPS, seed=1)
    assert {kind for kind, what in found if what == "missed"} == set()
    assert sum(count for (_, what), count in found.items() if what == "found") > FLIPS / 2


@pytest.mark.parametrize(
    "damage",
    ["cut off", *(pytest.param(name, marks=pytest.mark.evaluation) for name in ("missing", "empty"))],
)
def test_every_log_entry(database: Database, damage: str, tmp_path: Path) -> None:
    truth = seen(database)
    entries = sorted(Path(database.url).glob("*/_delta_log/*.json"))
    assert len(entries) > 12
    copy = tmp_path / "copy.db"
    for entry in entries:
        shutil.copytree(database.url, copy)
        for path in sorted((copy / entry.relative_to(database.url)).parent.glob("*.json")):
            if path.name == entry.name or (damage == "cut off" and path.name > entry.name):
                path.unlink()
        if damage == "empty":
            (copy / entry.relative_to(database.url)).touch()
        assert outcome(Database(str(copy)), truth) == "found", entry
        shutil.rmtree(copy)
