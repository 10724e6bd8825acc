"""What servers publish, one after the other."""

import queue

import zenoh
from pydantic import ValidationError

from reloc.wire.server import Event


class EventStream:
    """Events in the order in which they arrived."""

    def __init__(self) -> None:
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()

    def receive(self, sample: zenoh.Sample) -> None:
        """Take one publication; what is no event is left out."""
        try:
            self._events.put(Event.model_validate_json(sample.payload.to_bytes()))
        except ValidationError:
            return

    def next(self, timeout_s: float | None = None) -> Event | None:
        """The next event; None when none came within the time."""
        try:
            return self._events.get(timeout=timeout_s)
        except queue.Empty:
            return None
