"""kill -9 at each stage of a commit: nothing half visible, the same commit works afterwards."""

import random
import signal
import time
from pathlib import Path

import pytest

from featuredb.store.maintenance import VacuumOptions, vacuum
from featuredb.store.verify import verify
from tests.support.maps import assert_same_map, random_map
from tests.support.store_suite import Place, go

NO_GRACE = VacuumOptions(orphan_grace_h=0, file_grace_h=0)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(url=str(tmp_path / "maps.db"))


@pytest.mark.parametrize("writes", [0, 1, 2, 3])
def test_killed_before_a_write(place: Place, writes: int) -> None:
    database = place.create()
    database.commit_map(random_map(1))
    worker = place.worker("die-before-write", str(writes), "2")
    go(worker)
    worker.communicate(timeout=60)
    assert worker.returncode == -signal.SIGKILL

    assert [m.map_id for m in database.snapshot().maps()] == ["map-1"]
    report = verify(database)
    assert report.ok
    assert len(report.orphans) == (1 if writes else 0)
    # Within the grace a vacuum leaves them alone: a living process might be about to name them.
    assert vacuum(database).write_ids == ()
    assert verify(database).orphans == report.orphans

    assert database.commit_map(random_map(2)).created
    assert vacuum(database, NO_GRACE).write_ids == report.orphans
    after = verify(database)
    assert after.ok
    assert after.orphans == ()
    for seed in (1, 2):
        assert_same_map(database.snapshot().load_map(f"map-{seed}"), random_map(seed))


@pytest.mark.evaluation
def test_killed_at_random_moments(place: Place) -> None:
    """Whatever was visible at the kill is whole, and the same command again ends with the same maps."""
    database = place.create()
    rng = random.Random(7)
    for _ in range(4):
        worker = place.worker("commit", "1", "2", "3", "4", "5")
        go(worker)
        time.sleep(rng.uniform(0.0, 0.4))
        worker.kill()
        worker.communicate(timeout=10)
        snapshot = database.snapshot()
        for summary in snapshot.maps():
            seed = int(summary.map_id.removeprefix("map-"))
            assert_same_map(snapshot.load_map(summary.map_id), random_map(seed))
        assert verify(database).ok
    for seed in range(1, 6):
        database.commit_map(random_map(seed))
    vacuum(database, NO_GRACE)
    report = verify(database)
    assert report.ok
    assert report.orphans == ()
    assert len(database.snapshot().rows()) == 5
