"""One query in hand: answered exactly once, whoever comes first, and then dropped."""

import logging
import threading
import time
import uuid

import zenoh

from reloc.service.logs import fields
from reloc.service.tally import Tally
from reloc.wire.query import ErrorCode, ErrorReply, LocaliseReply, RequestError, encode

logger = logging.getLogger(__name__)

_JSON = zenoh.Encoding.APPLICATION_JSON


def session_of(query: zenoh.Query) -> str:
    """The session that asks, which nobody has verified; "" where it does not say."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


class PendingQuery:
    """A `zenoh.Query` between receipt and answer.

    A worker, the deadline watch and the shutdown may all want to answer; the first one does. Answering
    drops the Zenoh query, without which the client would wait for its timeout.

    Attributes:
        identity: name of the client, where the server authenticates its clients.
        asker: who shares the server with others: the identity, else the session that the query came from as
            it says itself.
        answered: whether it was, or refused.
    """

    def __init__(
        self,
        query: zenoh.Query,
        key: str,
        deadline_s: float,
        tally: Tally,
        *,
        identity: str | None,
    ) -> None:
        self.identity = identity
        self.asker = identity or session_of(query)
        self._query = query
        self._key = key
        self._tally = tally
        self._lock = threading.Lock()
        self.answered = False
        self.received = time.perf_counter()
        self.deadline = self.received + deadline_s
        self.request_id = uuid.uuid4().hex
        self.size = 0 if query.payload is None else len(query.payload)

    def attachment(self) -> bytes | None:
        """The request's attachment; None where there is none or it was answered meanwhile."""
        with self._lock:
            if self.answered or self._query.attachment is None:
                return None
            return self._query.attachment.to_bytes()

    def payload(self) -> bytes:
        """The request's payload; empty where there is none or it was answered meanwhile."""
        with self._lock:
            if self.answered or self._query.payload is None:
                return b""
            return self._query.payload.to_bytes()

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
            self._tally.add(kind, code, latency_ms)
            try:
                with self._query as query:
                    if kind == "error":
                        query.reply_err(payload, encoding=_JSON)
                    else:
                        query.reply(self._key, payload, encoding=_JSON, express=True)
            except zenoh.ZError:  # the client went away, or asked with a selector that takes no such key
                told = fields("reply_failed", request_id=self.request_id)
                logger.warning("reply could not be sent", exc_info=True, extra=told)
            return True

    def _fields(self, event: str, **values: object) -> dict[str, object]:
        return fields(event, request_id=self.request_id, client=self.identity, bytes=self.size, **values)
