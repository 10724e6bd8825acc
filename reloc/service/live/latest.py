"""Between Zenoh's callback and a session's thread: one place, in which the latest frame waits."""

import threading
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """A frame as it came.

    Attributes:
        header: its attachment. payload: the image file's bytes; empty where `size` is over the limit.
        size: bytes that were sent.
        received: `time.perf_counter` at receipt. received_at: the same by the clock.
    """

    header: bytes
    payload: bytes
    size: int
    received: float
    received_at: datetime


class LatestFrame:
    """Holds one frame: a newer one takes the place of one that nobody has taken yet. `put` never waits."""

    def __init__(self) -> None:
        self._arrival: Arrival | None = None
        self._closed = False
        self._changed = threading.Condition()

    def put(self, arrival: Arrival) -> bool:
        """Leave a frame; False if it was dropped, or another one for it."""
        with self._changed:
            if self._closed:
                return False
            free = self._arrival is None
            self._arrival = arrival
            self._changed.notify()
            return free

    def take(self, timeout_s: float) -> Arrival | None:
        """The frame, as soon as there is one; None once closed, and when none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._arrival is not None, max(timeout_s, 0.0))
            arrival, self._arrival = self._arrival, None
            return None if self._closed else arrival

    def close(self) -> None:
        """Take and give no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
