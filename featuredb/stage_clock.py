"""Wall seconds by stage."""

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class StageClock:
    """Adds up wall seconds by the name of a stage, in the order in which stages first ended.

    Attributes:
        seconds: by stage. counts: what the caller of `stage` noted about it, by stage.
    """

    def __init__(self, start: float | None = None) -> None:
        """The first lap begins at `start`, a moment of `time.perf_counter`; None: now."""
        self.seconds: dict[str, float] = {}
        self.counts: dict[str, dict[str, int]] = {}
        self._last = time.perf_counter() if start is None else start

    @contextmanager
    def stage(self, name: str) -> Iterator[dict[str, int]]:
        """Times what is done inside; what is put into the yielded dictionary is kept in `counts`."""
        start, counts = time.perf_counter(), self.counts.setdefault(name, {})
        yield counts
        self._add(name, time.perf_counter() - start)

    def lap(self, name: str, parts_ms: Mapping[str, float] | None = None) -> None:
        """The time since the last lap belongs to this stage, but for what its parts account for.

        Args:
            parts_ms: milliseconds of parts that go under names of their own; a `total` among them is theirs.
        """
        now = time.perf_counter()
        rest, self._last = now - self._last, now
        for part, ms in (parts_ms or {}).items():
            if part != "total":
                self._add(part, ms / 1e3)
                rest -= ms / 1e3
        self._add(name, max(0.0, rest))

    def milliseconds(self) -> dict[str, float]:
        """All stages and their sum as `total`, rounded to microseconds."""
        rounded = {name: round(1e3 * s, 3) for name, s in self.seconds.items()}
        return {**rounded, "total": round(math.fsum(rounded.values()), 3)}

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
