"""An ingest that is killed anywhere and started again gives the map of one that was not."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.encode import content_digest
from featuredb.store.verify import verify
from tests.conftest import REPOSITORY
from tests.support.hill_photos import write_hill_photos
from tests.support.ingest_command import run

pytestmark = pytest.mark.slow

_TIMEOUT_S = 120.0


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hills")
    write_hill_photos(folder, columns=3, rows=2)
    return folder


@pytest.fixture(scope="module")
def whole(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database of an ingest that nothing disturbed."""
    database = tmp_path_factory.mktemp("undisturbed") / "db"
    assert run(_words(database, photos)) == 0
    return database


@pytest.fixture(scope="module")
def undisturbed(whole: Path) -> FeatureMap:
    return _only_map(whole)


def _words(database: Path, photos: Path, *more: str, workers: int = 1) -> list[str]:
    words = ["ingest", "photos", str(database), str(photos), "--workers", str(workers), "--quiet"]
    return [*words, "--max-features", "800", "--gps-sigma", "0.02", *more]


def _start(database: Path, photos: Path, workers: int = 1) -> "subprocess.Popen[bytes]":
    """The command in a process group of its own. Starting workers is most of its time."""
    return subprocess.Popen(
        [sys.executable, "-m", "tests.support.ingest_command", *_words(database, photos, workers=workers)],
        cwd=REPOSITORY,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def _only_map(database: Path) -> FeatureMap:
    snapshot = Database.open(database).snapshot()
    (summary,) = snapshot.maps()
    return snapshot.load_map(summary.map_id)


def _assert_same(found: FeatureMap, wanted: FeatureMap) -> None:
    assert found.map_id == wanted.map_id
    assert len(found.points) == len(wanted.points)
    assert [i.sha256 for i in found.images] == [i.sha256 for i in wanted.images]
    assert found.cameras == wanted.cameras
    np.testing.assert_array_equal(found.points.utm, wanted.points.utm)
    for name in ("point_index", "image_id", "xy", "descriptors"):
        np.testing.assert_array_equal(
            getattr(found.observations, name), getattr(wanted.observations, name), err_msg=name
        )
    assert content_digest(found) == content_digest(wanted)  # and everything else


def _kill_when(process: "subprocess.Popen[bytes]", condition: Callable[[], bool]) -> bool:
    """SIGKILL to the command alone once the condition holds; False if it had ended before."""
    end = time.monotonic() + _TIMEOUT_S
    while not condition():
        if process.poll() is not None:
            return False
        assert time.monotonic() < end
        time.sleep(0.002)
    process.kill()
    process.wait()
    return True


def _is_there(database: Path, pattern: str) -> bool:
    try:
        return any(database.glob(pattern))
    except FileNotFoundError:  # a scratch folder that went while it was looked into
        return False


def _wait_for_workers(group: int) -> None:
    """The workers of a killed command end by themselves."""
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.02)
    os.killpg(group, signal.SIGKILL)
    pytest.fail("workers outlived the killed command by 30 s")


@pytest.mark.parametrize(
    "pattern",
    [
        pytest.param("_work/scan/*.json", marks=pytest.mark.evaluation),
        pytest.param("_work/features/*/*.npz", marks=pytest.mark.evaluation),
        pytest.param("_work/matches/*/*/*.npz", marks=pytest.mark.evaluation),
        pytest.param("_work/models/*/.tmp-*", marks=pytest.mark.evaluation),
        "_work/models/*/*",
        "points/**/*.parquet",
        "maps/_delta_log/*1.json",
    ],
)
def test_killed_at_a_stage(
    pattern: str, photos: Path, whole: Path, undisturbed: FeatureMap, tmp_path: Path
) -> None:
    database = tmp_path / "db"
    # What comes after the models is the command's own work: it needs no workers, which take long to start,
    # and begins with the models of the ingest that nothing disturbed.
    if not pattern.startswith("_work/"):
        shutil.copytree(whole / "_work", database / "_work")
    process = _start(database, photos, workers=2 if pattern.startswith("_work/") else 1)
    killed = _kill_when(process, lambda: _is_there(database, pattern))
    if killed:
        _wait_for_workers(process.pid)
    committed = killed and pattern.startswith("maps/")
    visible = Database.open(database).snapshot().maps()
    assert len(visible) <= (1 if committed or not killed else 0) or pattern.startswith("points/")
    if visible:
        _assert_same(_only_map(database), undisturbed)
    assert run(_words(database, photos)) == 0
    _assert_same(_only_map(database), undisturbed)
    assert verify(Database.open(database)).ok


@pytest.mark.evaluation
@pytest.mark.parametrize("seed", [1, 2])
def test_killed_again_and_again_at_random(
    seed: int, photos: Path, undisturbed: FeatureMap, tmp_path: Path
) -> None:
    database, random_times = tmp_path / "db", random.Random(seed)
    for _ in range(3):
        process = _start(database, photos, workers=2)
        try:
            process.wait(random_times.uniform(0.5, 6.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            _wait_for_workers(process.pid)
    assert run(_words(database, photos)) == 0
    _assert_same(_only_map(database), undisturbed)
    assert verify(Database.open(database)).ok


@pytest.mark.evaluation
def test_stopped_after_each_stage(photos: Path, undisturbed: FeatureMap, tmp_path: Path) -> None:
    database = tmp_path / "db"
    for stage in ("scan", "extract", "match", "reconstruct", "build"):
        assert run(_words(database, photos, "--stop-after", stage)) == 0
        assert not Database.open(database).snapshot().maps()
    assert run(_words(database, photos)) == 0
    _assert_same(_only_map(database), undisturbed)


def test_two_ingests_at_once_both_land(photos: Path, undisturbed: FeatureMap, tmp_path: Path) -> None:
    other = tmp_path / "other"
    write_hill_photos(other, columns=2, rows=2, texture_seed=5, east_m=300.0)
    database = tmp_path / "db"
    processes = [_start(database, folder) for folder in (photos, other)]
    assert run(_words(database, photos)) == 0
    assert [p.wait(_TIMEOUT_S) for p in processes] == [0, 0]
    opened = Database.open(database)
    maps = {m.map_id: m for m in opened.snapshot().maps()}
    assert sorted(m.images for m in maps.values()) == [4, 6]
    _assert_same(opened.snapshot().load_map(undisturbed.map_id), undisturbed)
    assert verify(opened).ok
