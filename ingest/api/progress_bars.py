"""Progress bars with remaining time for the terminal; one line per stage elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from featuredb.cli.common import count_bars, drawn
from ingest.executor import Progress

_TITLES = {
    "scan": "Reading files",
    "extract": "Extracting features",
    "match": "Matching each photo with others",
    "reconstruct": "Reconstructing",
    "build": "Building maps",
}


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Yields a callback progress(stage, done, total) that draws on stderr."""
    if quiet:
        yield lambda stage, done, total: None
    elif (counting := count_bars()).console.is_terminal:
        with counting as bars:
            yield drawn(bars, _TITLES)
    else:
        yield _logged()


def _logged() -> Progress:
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
