"""Commands of featuredb, each in a process of its own, as programs that measure something run them."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent


def featuredb(*words: str, may_refuse: bool = False, refusals: Sequence[int] = (1,)) -> int:
    """Run a command of featuredb and show what it says; `refusals` are answers where it may refuse."""
    if words[0] == "ingest":  # it makes a database, but no folders around it
        Path(words[2]).parent.mkdir(parents=True, exist_ok=True)
    done = _run(words)
    sys.stdout.write(done.stdout)
    if done.returncode != 0 and not (may_refuse and done.returncode in refusals):
        raise SystemExit(f"exit code {done.returncode}\n{done.stderr}")
    sys.stdout.write(done.stderr if done.returncode > 1 else "")
    return done.returncode


def said(*words: str) -> str:
    """What a command of featuredb says, which is shown, whatever it comes to."""
    done = _run(words)
    sys.stdout.write(done.stdout + done.stderr)
    sys.stdout.flush()
    return done.stdout + done.stderr


def anchor(
    database: Path, map_id: str, photos: Path, out: Path, *start: str, refusals: Sequence[int] = (1,)
) -> bool:
    """Whether `featuredb anchor` places a map without a person.

    Args:
        photos: folder of the map's photos. out: for its report.
        start: arguments that say where to start.
    """
    words = ("anchor", str(database), map_id, "--photos", str(photos), *start)
    last = ("--out", str(out), "--auto", "--quiet")
    return featuredb(*words, *last, may_refuse=True, refusals=refusals) == 0


def newest_copy(source: Path, target: Path) -> Path:
    """A copy of a database, made anew."""
    shutil.rmtree(target, ignore_errors=True)
    return Path(shutil.copytree(source, target))


def _run(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    sys.stdout.write(f"$ featuredb {' '.join(words)}\n")
    sys.stdout.flush()
    command = [sys.executable, "-m", "featuredb.cli", *words]
    return subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, check=False)
