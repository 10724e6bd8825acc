"""The power fails at any moment of a commit: the state before or after is left, and what was done stays."""

import random
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, count_candidates, withdraw
from featuredb.store.candidates.states import Contribution
from featuredb.store.durable import publish
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.verify import verify
from tests.support.maps import random_map
from tests.support.power_cut import Disk, State, write_state

NOTHING_KEPT = VacuumOptions(history_h=0, orphan_grace_h=0, file_grace_h=0)
PHOTO = random.Random(7).randbytes(2000)


def give(database: Database) -> list[str]:
    now = datetime.now(UTC)
    photo = Contribution(image=PHOTO, width=9, height=9, credit="ann", licence="CC0-1.0", received_at=now)
    return contribute(database, [photo])


@pytest.fixture
def database(tmp_path: Path) -> Database:
    database = Database.create(tmp_path / "maps.db")
    for seed in (1, 2):
        database.commit_map(random_map(seed, extent_m=10.0))
    return database


def seen(database: Database) -> object:
    """What a reader sees: maps with their states, photos with theirs."""
    maps = {row["map_id"]: (row["write_id"], row["status"]) for row in database.snapshot().rows()}
    return maps, count_candidates(database)


OPERATIONS: dict[str, Callable[[Database], object]] = {
    "commit": lambda d: d.commit_map(random_map(3, extent_m=10.0)),
    "retire": lambda d: d.retire("map-1", "wrong"),
    "compact": compact,
    "vacuum": lambda d: vacuum(d, NOTHING_KEPT),
    "contribute": give,
    "withdraw": lambda d: withdraw(d, give(d), "asked"),
}


# The operations differ in what they do, not in how a commit is made to last.
OFTEN = ("commit", "contribute")


@pytest.mark.parametrize(
    "operation",
    [pytest.param(name, marks=() if name in OFTEN else pytest.mark.evaluation) for name in OPERATIONS],
)
def test_a_power_cut_leaves_the_state_before_or_after(
    database: Database, operation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if operation == "withdraw":
        give(database)
    if operation == "vacuum":
        database.retire("map-2", "wrong")
        compact(database)
    states: list[State] = []

    def cut() -> None:
        states.extend(disk.surviving(names=names) for names in (False, True))

    before = seen(database)
    with monkeypatch.context() as patch:
        disk = Disk(Path(database.url), patch, cut)
        OPERATIONS[operation](database)
        acknowledged = [disk.surviving(names=names) for names in (False, True)]
    after = seen(database)
    assert before != after or operation in ("compact", "vacuum")
    looked_at: list[State] = []
    for state, allowed in [*((s, (before, after)) for s in states), *((s, (after,)) for s in acknowledged)]:
        if state in looked_at and allowed != (after,):
            continue
        looked_at.append(state)
        place = tmp_path / "after-the-cut.db"
        write_state(state, place)
        left = Database.open(place)
        assert seen(left) in allowed
        report = verify(left)
        # The event that a photo is withdrawn comes before its bytes go.
        begun = [p for p in report.problems if "withdraw it again" in p.what]
        assert report.problems == (tuple(begun) if operation == "withdraw" and before in allowed else ())
        shutil.rmtree(place)
    if operation == "withdraw":
        assert not any(PHOTO in (content or b"") for state in acknowledged for content in state.values())


def test_a_new_database_survives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path, monkeypatch, lambda: None)
    Database.create(tmp_path / "deep" / "maps.db")
    state = disk.surviving(names=False)
    monkeypatch.undo()
    write_state(state, tmp_path / "left")
    assert Database.open(tmp_path / "left" / "deep" / "maps.db").snapshot().maps() == []


def test_checkpoints_are_made_and_read(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
    disk = Disk(tmp_path, monkeypatch, lambda: None)
    for seed in range(3, 8):
        database.commit_map(random_map(seed, extent_m=10.0))
    log = Path(database.url, "maps", "_delta_log")
    assert [p.name[:20] for p in sorted(log.glob("*.parquet"))] == [f"{v:020d}" for v in (4, 6)]
    monkeypatch.undo()
    write_state(disk.surviving(names=False), tmp_path / "left")
    left = Database.open(tmp_path / "left" / "maps.db")
    assert verify(left).maps == 7
    # Read from the checkpoint on: the entries before it are not needed.
    for version in range(6):
        (tmp_path / "left" / "maps.db" / "maps" / "_delta_log" / f"{version:020d}.json").unlink()
    assert len(left.snapshot().maps()) == 7


def test_what_a_dead_writer_left_in_its_scratch_folder_goes(database: Database) -> None:
    left = Path(database.url, "points", "_scratch-dead")
    (left / "zone=1").mkdir(parents=True)
    (left / "zone=1" / "part.parquet").write_bytes(b"half a file")
    assert verify(database).ok
    vacuum(database)
    assert left.exists(), "its writer may be at work"
    assert f"points/{left.name}" in vacuum(database, NOTHING_KEPT).files
    assert not left.exists()
