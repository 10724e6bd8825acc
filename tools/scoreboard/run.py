"""Runs a row: its commands in processes of their own, and the figures that the last one wrote."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from tools.scoreboard.results import ROOT, Result
from tools.scoreboard.row import Row

_LAST_LINES = 3  # of a command that failed, in its result


@dataclass(frozen=True, slots=True, kw_only=True)
class Folders:
    """Folders: of the real sets, and for work."""

    data: Path
    work: Path

    def missing(self, row: Row) -> list[Path]:
        """What the row needs and the data have not."""
        return [self.data / name for name in row.needs() if not (self.data / name).exists()]


def run(row: Row, places: Folders, commit: str) -> Result:
    """Measure a row. A command that fails leaves a result that says so; its output stays in `row.log`."""
    work, cache = places.work / row.name / commit, places.work / "cache"
    goes_on = row.resumes and not commit.endswith("+")
    for old in work.parent.glob("*"):
        if old != work or not goes_on:
            shutil.rmtree(old, ignore_errors=True)
    for folder in (work, cache):
        folder.mkdir(parents=True, exist_ok=True)
    names = {"data": str(places.data.resolve()), "work": str(work), "cache": str(cache)}
    start, code, failure = time.monotonic(), 0, ""
    figures_file = work / "figures.json"
    with (places.work / f"{row.name}.log").open("w+", encoding="utf-8") as log:
        for words in row.calls():
            command = [sys.executable, "-m", *(word.format(**names) for word in words)]
            log.write(f"$ {' '.join(command[1:])}\n")
            log.flush()
            code = _call(command, log)
            if code not in (0, 1):  # 1: measured, and some line of the program's own does not hold
                failure = f"exit code {code}"
                break
        log.seek(0)
        tail = " / ".join(log.read().strip().splitlines()[-_LAST_LINES:])
    seconds = round(time.monotonic() - start, 1)
    if not failure and not figures_file.is_file():
        failure = f"no figures were written, exit code {code}"
    figures: dict[str, Any] = {}
    if failure:
        failure = f"{failure}: {tail[-300:]}"
    else:
        figures = row.read(json.loads(figures_file.read_text(encoding="utf-8"))) | {"seconds": seconds}
        if row.resumes:  # the next run begins anew
            shutil.rmtree(work)
    return Result(row=row.name, commit=commit, figures=figures, seconds=seconds, failure=failure)


def _call(command: Sequence[str], log: TextIO) -> int:
    """The exit code of a command; whoever stops the scoreboard stops all processes that the command has."""
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, env=os.environ, start_new_session=True
    )
    try:
        return process.wait()
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
