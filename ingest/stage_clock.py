"""Wall times of an ingest's stages."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ingest.report import StageTiming


class StageClock:
    """Collects the stages as they run; `now` gives seconds and may be replaced in tests."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._timings: list[StageTiming] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[dict[str, int]]:
        """Time a stage; the caller may set "reused" and "total" in what this yields."""
        counts = {"reused": 0, "total": 0}
        start = self._now()
        yield counts
        self._timings.append(StageTiming(name=name, seconds=self._now() - start, **counts))

    @property
    def timings(self) -> tuple[StageTiming, ...]:
        """Finished stages in order."""
        return tuple(self._timings)
