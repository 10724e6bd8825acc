"""What was measured: one line of JSON for each row and commit, in a file that is committed."""

import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "measurements.jsonl"
_CODE = ("featuredb", "ingest", "reloc", "schemas", "tools", "pyproject.toml", "uv.lock")


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """A row as it was measured; by default on this machine, today.

    Attributes:
        row: its name. commit: short hash of the last one that changed the program; `+` follows where the
            working tree differs from it. date: of the run, YYYY-MM-DD.
        figures: as read; empty where the command failed. failure: why it did.
        seconds: wall time of all commands. cores, python: of the machine.
    """

    row: str
    commit: str
    date: str = field(default_factory=lambda: f"{datetime.now(UTC):%Y-%m-%d}")
    figures: Mapping[str, float | int | str | None]
    seconds: float
    cores: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    python: str = field(default_factory=platform.python_version)
    failure: str = ""

    @property
    def clean(self) -> bool:
        """Whether the commit has exactly what was run."""
        return not self.commit.endswith("+")


def code_commit() -> str:
    """Short hash of the last commit that changed the program, with `+` if something is not committed."""
    commit = _git("log", "-1", "--format=%h", "--abbrev=10", "--", *_CODE)
    return commit + ("+" if _git("status", "--porcelain", "--", *_CODE) else "")


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def read_results(path: Path = RESULTS) -> list[Result]:
    """All results, oldest first; none where there is no file."""
    if not path.is_file():
        return []
    return [Result(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def write_results(results: Iterable[Result], path: Path = RESULTS) -> None:
    """Write them: of a row and a commit the last one, of trees that are no commit's the newest alone."""
    kept: dict[tuple[str, str], Result] = {}
    for result in results:
        key = (result.row, result.commit if result.clean else "+")
        kept.pop(key, None)
        kept[key] = result
    lines = [json.dumps(asdict(result), sort_keys=True) + "\n" for result in kept.values()]
    part = path.with_suffix(".part")
    part.write_text("".join(lines), encoding="utf-8")
    part.rename(path)


def newest(results: Iterable[Result]) -> dict[str, Result]:
    """The last result of each row."""
    return {result.row: result for result in results}
