"""Scans that are added by processes that stop, are killed, or run at once."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from featuredb.errors import (
    ConflictError,
    ScanError,
)
from featuredb.lidar.add import AddOptions, add_scan, work_folder
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.store import Database
from featuredb.store.scans import list_scans
from featuredb.store.verify import verify
from tests.support.las_files import grid_points, write_scan


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database(str(tmp_path / "scans.db"))


def folder_state(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_job_that_was_stopped_goes_on(database: Database, tmp_path: Path) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points(6000))
    options = AddOptions(block_points=800)
    seen: list[str] = []

    def stop_in_the_middle(step: str, done: int, total: int) -> None:
        seen.append(step)
        if step == "clean" and done > 3000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        add_scan(database, [path], options, on_progress=stop_in_the_middle)
    assert list_scans(database) == []
    work = Path(database.url) / "_work"
    done = {p: p.stat().st_mtime_ns for p in work.rglob("*.npy")}
    assert done
    seen.clear()
    left: dict[Path, int] = {}

    def look(step: str, done: int, total: int) -> None:
        seen.append(step)
        if step == "clean" and done == total:
            left.update({p: p.stat().st_mtime_ns for p in work.rglob("*.npy")})

    result = add_scan(database, [path], options, on_progress=look)
    assert result.created
    assert {p: left[p] for p in done} == done  # not done again
    assert len(left) > len(done)
    assert "read" not in seen
    assert not work.exists()
    assert verify(database).ok
    fresh = Database(str(tmp_path / "fresh.db"))
    assert add_scan(fresh, [path], options).scan.row["points_checksum"] == result.scan.row["points_checksum"]


KILLED_JOB = """
import os, signal, sys
from pathlib import Path
from featuredb.lidar.add import add_scan
from featuredb.lidar.add import AddOptions
from featuredb.store import Database

def on_progress(step, done, total):
    if step == sys.argv[3] and done > 3000:
        os.kill(os.getpid(), signal.SIGKILL)

options = AddOptions(block_points=800)
add_scan(Database(sys.argv[1]), [Path(sys.argv[2])], options, on_progress=on_progress)
"""


@pytest.mark.parametrize("step", ["read", "clean", "write"])
def test_a_process_that_was_killed_leaves_what_the_next_one_needs(
    database: Database, tmp_path: Path, step: str
) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points(6000))
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_JOB, database.url, str(path), step], timeout=300, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert list_scans(database) == []
    result = add_scan(database, [path], AddOptions(block_points=800))
    assert result.created
    assert result.scan.points == 6000
    report = verify(database)
    assert report.ok
    assert len(load_cloud(database, scan_frame(result.scan))) == 6000
    assert not (Path(database.url) / "_work").exists()


def test_one_process_at_a_time(database: Database, tmp_path: Path) -> None:
    work = tmp_path / "work"
    with (
        work_folder(database, work, "job", 10),
        pytest.raises(ConflictError, match="another process"),
        work_folder(database, work, "job", 10),
    ):
        pass
    with pytest.raises(ScanError, match="GB free"), work_folder(database, work, "big", 10**15):
        pass
    assert folder_state(work) == []
