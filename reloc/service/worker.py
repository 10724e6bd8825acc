"""The threads that answer queries."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime

from featuredb.stage_clock import StageClock
from featuredb.store.candidates.states import ANONYMOUS, candidate_id_of
from reloc.service.contributions.database_inbox import contribution_of
from reloc.service.contributions.inbox import Inbox, InboxRefusal
from reloc.service.handler import answer_query
from reloc.service.options import ServeOptions
from reloc.service.pending import PendingQuery
from reloc.service.queueing import DeadlineWatch, QueryQueue, deadline_error
from reloc.service.source import ServedArea
from reloc.service.threads import capped_process, capped_thread
from reloc.wire.query import (
    ContributionReply,
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    RequestError,
    parse_request,
)

logger = logging.getLogger(__name__)


class WorkerPool:
    """Takes queries from the queue and answers each from the area in service at that moment."""

    def __init__(
        self,
        queue: QueryQueue,
        watch: DeadlineWatch,
        area: Callable[[], ServedArea],
        options: ServeOptions,
        inbox: Inbox | None = None,
    ) -> None:
        self._queue = queue
        self._watch = watch
        self._area = area
        self._options = options
        self._inbox = inbox
        # A photo is named while it is localised: the query does not wait for a hash of its megabytes.
        self._namer = ThreadPoolExecutor(1, thread_name_prefix="name-photo")
        self._busy: set[PendingQuery] = set()
        self._lock = threading.Lock()
        self._caps = ExitStack()
        self._threads = [
            threading.Thread(target=self._run, name=f"localise-{i}", daemon=True)
            for i in range(options.workers)
        ]

    @property
    def busy(self) -> int:
        return len(self._busy)

    def start(self) -> None:
        self._caps.enter_context(capped_process(self._options.threads_per_worker))
        for thread in self._threads:
            thread.start()

    def join(self, timeout_s: float) -> list[PendingQuery]:
        """Wait for the workers to finish the closed queue; returns what they still have in hand."""
        end = time.perf_counter() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, end - time.perf_counter()))
        self._caps.close()
        self._namer.shutdown(wait=False, cancel_futures=False)
        with self._lock:
            return list(self._busy)

    def _run(self) -> None:
        with capped_thread(self._options.threads_per_worker):
            while (item := self._queue.get()) is not None:
                with self._lock:
                    self._busy.add(item)
                try:
                    self._answer(item)
                finally:
                    with self._lock:
                        self._busy.discard(item)

    def _answer(self, item: PendingQuery) -> None:
        try:
            self._localise(item)
        except RequestError as error:
            item.request_id = error.request_id or item.request_id
            item.refuse(error)
        except Exception:
            logger.exception(
                "query failed", extra={"fields": {"event": "internal", "request_id": item.request_id}}
            )
            item.refuse(
                RequestError(
                    ErrorCode.INTERNAL,
                    f"the server failed on this query; its log says why under request id {item.request_id}",
                )
            )

    def _localise(self, item: PendingQuery) -> None:
        clock = StageClock(start=item.received)
        clock.lap("queue")
        request = parse_request(item.attachment())
        item.request_id = request.request_id or item.request_id
        if request.contribute and self._inbox is None:
            raise RequestError(
                ErrorCode.UNSUPPORTED,
                "contribute: this server takes no contributions; leave it out, or start the server with "
                "--contributions on",
            )
        if request.options.deadline_ms is not None:
            wished = item.received + request.options.deadline_ms / 1e3
            if wished < item.deadline:
                item.deadline = wished
                self._watch.add(item)
        _check_deadline(item)
        data = item.payload()
        clock.lap("request")
        if item.answered:
            return
        name = self._namer.submit(candidate_id_of, data) if request.contribute else None
        reply = answer_query(
            data,
            request,
            self._area().localiser,
            limits=self._options.limits,
            request_id=item.request_id,
            clock=clock,
            before_localising=lambda: _check_deadline(item),
        )
        _check_deadline(item)
        if name is not None and self._inbox is not None:
            _answer_and_keep(item, data, request, reply, clock, self._inbox, name)
        else:
            item.answer(reply)


def _answer_and_keep(
    item: PendingQuery,
    data: bytes,
    request: LocaliseWireRequest,
    reply: LocaliseReply,
    clock: StageClock,
    inbox: Inbox,
    name: "Future[str]",
) -> None:
    """Answer, and hand the photo to the inbox if it has a place; what is said in the answer is then done."""
    received_at = datetime.now(UTC)
    owner = item.identity or ANONYMOUS  # never what the request claims
    place = inbox.reserve(owner, len(data))
    if isinstance(place, InboxRefusal):
        said = ContributionReply(accepted=False, candidate_id=None, reason=place.reason, detail=place.detail)
        item.answer(_with_contribution(reply, said, clock))
        return
    answered = False
    try:
        said = ContributionReply(
            accepted=True, candidate_id=name.result(), reason=None, detail="queued for the inbox"
        )
        answered = item.answer(_with_contribution(reply, said, clock))
    finally:
        if not answered:
            place.cancel()
    if answered:
        place.submit(lambda: contribution_of(data, request, reply, received_at, owner))


def _with_contribution(reply: LocaliseReply, said: ContributionReply, clock: StageClock) -> LocaliseReply:
    clock.lap("contribution")
    return reply.model_copy(update={"contribution": said, "timings_ms": clock.milliseconds()})


def _check_deadline(item: PendingQuery) -> None:
    if time.perf_counter() >= item.deadline:
        raise deadline_error(item)
