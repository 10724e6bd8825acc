"""What a server publishes: maps that come and go, reloads, its end."""

import queue
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from reloc.client import Client
from reloc.wire.server import Event


class EventStream:
    """Events in the order in which they arrived."""

    def __init__(self) -> None:
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()

    def receive(self, sample: zenoh.Sample) -> None:
        self._events.put(Event.model_validate_json(sample.payload.to_bytes()))

    def next(self, timeout_s: float) -> Event | None:
        """The next event; None when none came within the time."""
        try:
            return self._events.get(timeout=timeout_s)
        except queue.Empty:
            return None


@contextmanager
def watch_events(client: Client) -> Iterator[EventStream]:
    """Within the block, the events of the client's database."""
    stream = EventStream()
    with client._session().declare_subscriber(client._keys.of("events"), stream.receive):
        yield stream
