"""Time by stage."""

import time


class Stopwatch:
    """Splits wall time into named stages that add up to the total; repeated names add up."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.timings_ms: dict[str, float] = {}

    def split(self, stage: str) -> None:
        """Everything since the last split (or the start) belongs to `stage`."""
        now = time.perf_counter()
        self.timings_ms[stage] = self.timings_ms.get(stage, 0.0) + 1000.0 * (now - self._last)
        self._last = now
