"""Between Zenoh's callback and the workers: a bounded queue and the watch over deadlines."""

import heapq
import itertools
import threading
import time
from collections import deque

from reloc.service.pending import PendingQuery
from reloc.wire.query import ErrorCode, RequestError


class QueryQueue:
    """First in, first out, bounded in number and in bytes; `put` never blocks."""

    def __init__(self, max_length: int, max_bytes: int) -> None:
        self._max_length = max_length
        self._max_bytes = max_bytes
        self._items: deque[PendingQuery] = deque()
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, item: PendingQuery) -> None:
        """Append a query.

        Raises:
            RequestError: BUSY when full, SHUTTING_DOWN when closed.
        """
        with self._changed:
            if self._closed:
                raise RequestError(ErrorCode.SHUTTING_DOWN, "the server is stopping; ask again later")
            if len(self._items) >= self._max_length or self._bytes + item.size > self._max_bytes:
                raise RequestError(
                    ErrorCode.BUSY,
                    f"{len(self._items)} queries ({self._bytes} bytes) are waiting, the queue is full; "
                    "try again in a second",
                )
            self._items.append(item)
            self._bytes += item.size
            self._changed.notify()

    def get(self) -> PendingQuery | None:
        """The oldest query, blocking; None once closed and empty."""
        with self._changed:
            while not self._items:
                if self._closed:
                    return None
                self._changed.wait()
            item = self._items.popleft()
            self._bytes -= item.size
            return item

    def close(self) -> None:
        """Take no more; what waits is still handed out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def drain(self) -> list[PendingQuery]:
        """Take out all that wait."""
        with self._changed:
            items = list(self._items)
            self._items.clear()
            self._bytes = 0
            return items

    def __len__(self) -> int:
        return len(self._items)


class DeadlineWatch:
    """Answers DEADLINE the moment a query's time is over, also while a worker still has it in hand."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, PendingQuery]] = []
        self._order = itertools.count()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="deadline-watch", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def add(self, item: PendingQuery) -> None:
        """Watch the query; again when its deadline has become earlier."""
        with self._changed:
            heapq.heappush(self._heap, (item.deadline, next(self._order), item))
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._heap and self._heap[0][2].answered:
                    heapq.heappop(self._heap)
                if self._closed:
                    return
                wait_s = self._heap[0][0] - time.perf_counter() if self._heap else None
                if wait_s is None or wait_s > 0:
                    self._changed.wait(wait_s)
                    continue
                item = heapq.heappop(self._heap)[2]
            item.refuse(deadline_error(item))


def deadline_error(item: PendingQuery) -> RequestError:
    """DEADLINE, with how long the query had."""
    allowed_ms = (item.deadline - item.received) * 1e3
    return RequestError(
        ErrorCode.DEADLINE,
        f"no answer within {allowed_ms:.0f} ms; the server is loaded or the image too large: "
        "ask again, send a smaller picture or allow more time",
    )
