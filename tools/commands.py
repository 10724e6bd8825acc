"""Commands of featuredb, each in a process of its own, as programs that measure something run them."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

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
    """Whether `featuredb anchor` places a map without a person.

    Args:
        photos: folder of the map's photos. out: for its report.
        start: arguments that say where to start.
    """
    words = ("anchor", str(database), map_id, "--photos", str(photos), *start)
    return featuredb(*words, "--out", str(out), "--auto", "--quiet", refusals=refusals).returncode == 0


def newest_copy(source: Path, target: Path) -> Path:
    """A copy of a database, made anew."""
    shutil.rmtree(target, ignore_errors=True)
    return Path(shutil.copytree(source, target))
