"""Queries between Zenoh's callback and the workers: answered once each, in a bounded queue, in time."""

import logging
import threading
import time
import uuid
from collections import Counter
from typing import Literal

import zenoh

from reloc.service.logs import Tally, fields
from reloc.service.session import JSON
from reloc.wire.query import ErrorCode, ErrorReply, LocaliseReply, RequestError, encode

logger = logging.getLogger(__name__)


def session_of(query: zenoh.Query) -> str:
    """The session that asks, which nobody has verified; "" where it does not say."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


class PendingQuery:
    """A `zenoh.Query` between receipt and answer.

    A worker, the deadline and the shutdown may all want to answer; the first one does. Answering drops the
    Zenoh query, without which the client would wait for its timeout.
    """

    def __init__(
        self,
        query: zenoh.Query,
        key: str,
        deadline_s: float,
        tally: Tally,
        *,
        identity: str | None,  # name of the client, where the server authenticates its clients
    ) -> None:
        self.identity = identity
        self.asker = identity or session_of(query)  # who shares the server with others
        self._query = query
        self._key = key
        self._tally = tally
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self.answered = False  # or refused
        self.received = time.perf_counter()
        self.deadline = self.received + deadline_s
        self.request_id = uuid.uuid4().hex
        self.size = 0 if query.payload is None else len(query.payload)

    def watch(self) -> None:
        """Refuse the query when its deadline is over, also while a worker has it.

        Raises RequestError: BUSY, the machine has no thread left for that.
        """
        with self._lock:
            if self.answered:
                return
            left_s = max(0.0, self.deadline - time.perf_counter())
            self._timer = threading.Timer(left_s, lambda: self.refuse(self.deadline_error()))
            self._timer.daemon = True
            try:
                self._timer.start()
            except RuntimeError as error:
                self._timer = None
                raise RequestError(ErrorCode.BUSY, "no thread is free; try again in a second") from error

    def deadline_error(self) -> RequestError:
        """DEADLINE, with how long the query had."""
        allowed_ms = (self.deadline - self.received) * 1e3
        return RequestError(
            ErrorCode.DEADLINE,
            f"no answer within {allowed_ms:.0f} ms; the server is loaded or the image too large: "
            "ask again, send a smaller picture or allow more time",
        )

    def bytes_of(self, part: Literal["attachment", "payload"]) -> bytes:
        """A part of the request; empty where there is none or it was answered meanwhile."""
        with self._lock:
            found: zenoh.ZBytes | None = None if self.answered else getattr(self._query, part)
            return b"" if found is None else found.to_bytes()

    def answer(self, reply: LocaliseReply) -> bool:
        """Send the reply; False if somebody was faster."""
        latency_ms = (time.perf_counter() - self.received) * 1e3
        kind = "localised" if reply.reason is None else "not_localised"
        if not self._settled(encode(reply), kind, reply.reason or "", latency_ms):
            return False
        told = self._fields(
            "answered",
            status=reply.status,
            reason=reply.reason,
            inliers=reply.inliers,
            snapshot=reply.snapshot,
            latency_ms=round(latency_ms, 3),
        )
        logger.info("query answered", extra=told)
        return True

    def refuse(self, error: RequestError) -> None:
        """Send `reply_err`, unless somebody was faster."""
        reply = ErrorReply(code=error.code, message=error.message, request_id=self.request_id)
        if not self._settled(encode(reply), "error", error.code):
            return
        level = logging.ERROR if error.code == ErrorCode.INTERNAL else logging.INFO
        told = self._fields("refused", code=error.code, refusal=error.message)
        logger.log(level, "query refused", extra=told)

    def _settled(self, payload: bytes, kind: str, code: str, latency_ms: float | None = None) -> bool:
        """Count and send an answer; False if somebody was faster."""
        with self._lock:
            if self.answered:
                return False
            self.answered = True
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None  # it holds this query
            self._tally.add(kind, code, latency_ms)
            try:
                with self._query as query:
                    if kind == "error":
                        query.reply_err(payload, encoding=JSON)
                    else:
                        query.reply(self._key, payload, encoding=JSON, express=True)
            except zenoh.ZError:  # the client went away, or asked with a selector that takes no such key
                told = fields("reply_failed", request_id=self.request_id)
                logger.warning("reply could not be sent", exc_info=True, extra=told)
            return True

    def _fields(self, event: str, **values: object) -> dict[str, object]:
        return fields(event, request_id=self.request_id, client=self.identity, bytes=self.size, **values)


class QueryQueue:
    """Bounded in number and in bytes, and fair to those who ask; `put` never blocks.

    The next query is the oldest of the asker with the fewest in hand; of several such, of the one who has had
    least of the workers' time since he was idle. In a full queue who has most waiting makes room.
    """

    def __init__(self, max_length: int, max_bytes: int) -> None:
        self._max_length, self._max_bytes = max_length, max_bytes
        self._waiting: dict[str, list[PendingQuery]] = {}  # by asker, the oldest first; none is empty
        self._in_hand: Counter[str] = Counter()
        self._spent_s: dict[str, float] = {}
        self._closed = False
        self._changed = threading.Condition()

    def put(self, item: PendingQuery) -> None:
        """Append a query; others may be refused for it.

        Raises:
            RequestError: BUSY when full, SHUTTING_DOWN when closed.
        """
        with self._changed:
            if self._closed:
                raise RequestError(ErrorCode.SHUTTING_DOWN, "the server is stopping; ask again later")
            self._remove([i for i in self._all() if i.answered])
            length, size = len(self._all()), sum(i.size for i in self._all())
            told = f"{length} queries ({size} bytes) are waiting, the queue is full; try again in a second"
            busy = RequestError(ErrorCode.BUSY, told)
            refused = self._who_makes_room(item, length, size)
            if refused is None:
                raise busy
            self._remove(refused)
            self._spent_s.setdefault(item.asker, min(self._spent_s.values(), default=0.0))
            self._waiting.setdefault(item.asker, []).append(item)
            self._changed.notify()
        for other in refused:
            other.refuse(busy)

    def get(self) -> PendingQuery | None:
        """The next query, blocking, to be followed by `done`; None once closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            if not self._waiting:
                return None
            asker = min(self._waiting, key=lambda name: (self._in_hand[name], self._spent_s[name]))
            self._in_hand[asker] += 1
            item = self._waiting[asker][0]
            self._remove([item])
            return item

    def done(self, item: PendingQuery, seconds: float) -> None:
        """A worker has had the query for so long."""
        with self._changed:
            self._in_hand[item.asker] -= 1
            self._spent_s[item.asker] += seconds
            if not self._in_hand[item.asker]:
                del self._in_hand[item.asker]
                if item.asker not in self._waiting:
                    del self._spent_s[item.asker]

    def close(self) -> None:
        """Take no more; what waits is still handed out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def drain(self) -> list[PendingQuery]:
        """Take out all that wait."""
        with self._changed:
            items = self._all()
            self._waiting.clear()
            return items

    def __len__(self) -> int:
        with self._changed:
            return len(self._all())

    def _all(self) -> list[PendingQuery]:
        return [item for waiting in self._waiting.values() for item in waiting]

    def _who_makes_room(self, item: PendingQuery, length: int, size: int) -> list[PendingQuery] | None:
        """Those of others that go for it; None where who has most waiting has no more than its asker."""
        waiting = {asker: list(items) for asker, items in self._waiting.items()}
        own = len(waiting.get(item.asker, ()))
        going: list[PendingQuery] = []
        while length >= self._max_length or size + item.size > self._max_bytes:
            most = max(waiting.values(), key=len, default=[])
            if len(most) <= own + 1:
                return None
            going.append(most.pop())
            length, size = length - 1, size - going[-1].size
        return going

    def _remove(self, items: list[PendingQuery]) -> None:
        for item in items:
            self._waiting[item.asker].remove(item)
            if not self._waiting[item.asker]:
                del self._waiting[item.asker]
