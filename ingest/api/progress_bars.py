"""Progress bars with remaining time for the terminal; one line per stage elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import Progress, TaskID

from featuredb.cli.common import count_bars
from ingest.executor import Progress as ProgressCallback

_TITLES = {
    "scan": "Reading files",
    "extract": "Extracting features",
    "match": "Matching each photo with others",
    "reconstruct": "Reconstructing",
    "build": "Building maps",
}


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[ProgressCallback]:
    """Yields a callback progress(stage, done, total) that draws on stderr."""
    if quiet:
        yield lambda stage, done, total: None
    elif (counting := count_bars()).console.is_terminal:
        with counting as bars:
            yield _drawn(bars)
    else:
        yield _logged()


def _drawn(bars: Progress) -> ProgressCallback:
    tasks: dict[str, TaskID] = {}

    def draw(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(_TITLES.get(stage, stage), total=total)
        bars.update(tasks[stage], completed=done, total=total)

    return draw


def _logged() -> ProgressCallback:
    """A finished stage is one line: files and pipes want no redrawing."""
    before = time.monotonic()  # when the stage before ended
    told: set[str] = set()

    def log(stage: str, done: int, total: int) -> None:
        nonlocal before
        if done >= total and stage not in told:
            told.add(stage)
            now = time.monotonic()
            sys.stderr.write(f"{_TITLES.get(stage, stage)}: {total} ({now - before:.1f} s)\n")
            sys.stderr.flush()
            before = now

    return log
