"""Commands of featuredb, each in a process of its own, and what they make."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from featuredb.geo.local_frame import LocalFrame
from featuredb.lidar.add import add_scan
from featuredb.lidar.load import PlanBox, load_cloud, scan_frame
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from tools.serve_process import watched_memory

_ROOT = Path(__file__).resolve().parent.parent


def featuredb(*words: str, refusals: Sequence[int] = ()) -> subprocess.CompletedProcess[str]:
    """Run a command of featuredb and show what it says; `refusals`: exit codes by which it may refuse.

    Raises SystemExit: it fails otherwise.
    """
    if words[0] == "ingest":  # it makes a database, but no folders around it
        Path(words[2]).parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(f"$ featuredb {' '.join(words)}\n")
    sys.stdout.flush()
    command = [sys.executable, "-m", "featuredb.cli", *words]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
    sys.stdout.write(done.stdout + done.stderr)
    sys.stdout.flush()
    if done.returncode not in (0, *refusals):
        raise SystemExit(f"exit code {done.returncode}")
    return done


def anchor(
    database: Path, map_id: str, photos: Path, out: Path, *start: str, refusals: Sequence[int] = (1,)
) -> bool:
    """Whether `featuredb anchor` places a map without a person; `start`: arguments that say where from."""
    words = ("anchor", str(database), map_id, "--photos", str(photos), *start)
    return featuredb(*words, "--out", str(out), "--auto", "--quiet", refusals=refusals).returncode == 0


def newest_copy(source: Path, target: Path) -> Path:
    """A copy of a database, made anew."""
    shutil.rmtree(target, ignore_errors=True)
    return Path(shutil.copytree(source, target))


def make(database: Path, kind: str, source: Path, more: Sequence[str] = ()) -> dict[str, float]:
    """Ingest photos or a film, with more arguments, and count what is in maps.

    Photos in the largest map and in any (mapped), maps with a place and without, those placed, seconds of the
    command, and the root mean square that is left of the first placed map.
    """
    start = time.monotonic()
    featuredb("ingest", kind, str(database), str(source), "--quiet", *more, refusals=(1,))
    seconds = time.monotonic() - start
    snapshot = Database.open(database).snapshot()
    placed = snapshot.maps()
    sizes = [*(m.images for m in placed), *(m.images for m in snapshot.unplaced_maps())]
    residual_m = [snapshot.load_map(m.map_id).placement.residual_rms_m for m in placed[:1]]
    return {
        "largest": max(sizes, default=0),
        "mapped": sum(sizes),
        "maps": len(sizes),
        "placed": len(placed),
        "seconds": seconds,
        "residual_m": residual_m[0] if residual_m else float("nan"),
    }


def once(target: Path, make: Callable[[Path], object]) -> Path:
    """`target`, which `make` makes once under another name: what is half made is made anew."""
    if not target.exists():
        making = target.with_name(f"making{target.suffix}")
        shutil.rmtree(making, ignore_errors=True)
        make(making)
        making.rename(target)
    return target


def with_scan(source: Path, scan: Path, target: Path) -> Path:
    """A copy of a database with a scan, made once."""

    def add(making: Path) -> None:
        shutil.copytree(source, making)
        featuredb("lidar", "add", str(making), str(scan), "--quiet")

    return once(target, add)


def all_maps(database: Path) -> list[AnyMap]:
    """The maps of a database, with a place and without."""
    snapshot = Database.open(database).snapshot()
    return [snapshot.load_any(one.map_id) for one in (*snapshot.maps(), *snapshot.unplaced_maps())]


def largest_map(database: Path) -> Any:
    """The one with most images, of those with a place and without."""
    return max(all_maps(database), key=lambda one: len(one.images))


def first_map(database: Database) -> FeatureMap:
    """The oldest that has a place."""
    snapshot = database.snapshot()
    return snapshot.load_map(snapshot.maps()[0].map_id)


class Cost(NamedTuple):
    """Processor seconds of a process and all that it started, megabytes of the largest of them, mebibytes of
    all together at the most (what they share counts once), and the output."""

    seconds: float
    largest_mb: float
    tree_mib: float
    told: str


def cost_of(*argv: str, sample_s: float = 1.0) -> Cost:
    """Run Python with these arguments; memory is looked at so often. Raises SystemExit: it fails."""
    process = subprocess.Popen([sys.executable, *argv], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with watched_memory(process.pid, sample_s) as seen:
        told = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"exit code {process.returncode}: {' '.join(argv[:4])}")
    return Cost(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, max(seen), told)


def cloud_of(
    scan: Path, database: Path, frame: LocalFrame | None = None, box: PlanBox | None = None
) -> PointCloud:
    """A scan, once it is added to a database, in a local frame or one at its centre; a box of it, or all."""
    made = Database.create(database)
    return load_cloud(made, frame or scan_frame(add_scan(made, [scan]).scan), box)
