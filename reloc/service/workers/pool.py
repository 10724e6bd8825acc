"""A thread and a process for each worker: what the one takes from the queue, the other localises."""

import logging
import math
import threading
import time
from datetime import UTC, datetime
from functools import partial

from featuredb.stage_clock import StageClock
from featuredb.store.candidates.states import ANONYMOUS, candidate_id_of
from reloc.service.contributions.inbox import Inbox, contribution_of
from reloc.service.handler import answer_query
from reloc.service.logs import fields
from reloc.service.options import ServeOptions
from reloc.service.queueing import PendingQuery, QueryQueue
from reloc.service.session import ServiceStartError
from reloc.service.source import ServedArea
from reloc.service.workers.area_files import AreaFiles
from reloc.service.workers.process import WorkerFailedError, WorkerProcess
from reloc.wire.query import (
    ContributionReply,
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    RequestError,
    parse_attachment,
)

logger = logging.getLogger(__name__)

_RETRY_S, _MAX_RETRY_S = 0.1, 10.0  # between starts of a process that does not come up


class WorkerPool:
    """Takes queries from the queue and answers each from the area in service at that moment.

    A process that is still at a query when its time is over, or that ends before its answer, is replaced.
    """

    def __init__(self, queue: QueryQueue, options: ServeOptions, inbox: Inbox | None) -> None:
        self._queue, self._options, self._inbox = queue, options, inbox
        self._limits = options.worker_limits
        self._answerer = partial(answer_query, limits=options.limits)
        self._files = AreaFiles()
        self._busy: dict[PendingQuery, WorkerProcess | None] = {}
        self._up: set[WorkerProcess] = set()
        self._failed: dict[str, str] = {}  # why a worker's latest process did not come up, by its thread
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, name=f"localise-{i}", daemon=True)
            for i in range(options.workers)
        ]

    @property
    def busy(self) -> int:
        return len(self._busy)

    @property
    def ready(self) -> int:
        """Workers whose process is up, and not beyond its query's deadline."""
        return len(self._up)

    def publish(self, area: ServedArea) -> None:
        """Answer from this area, beginning with the next query of each worker."""
        self.published = self._files.of(area.localiser)

    def start(self) -> None:
        """Start the workers; returns when one of them is ready.

        Raises:
            ServiceStartError: none of the processes comes up.
        """
        for thread in self._threads:
            thread.start()
        with self._changed:
            self._changed.wait_for(lambda: self._up or len(self._failed) == len(self._threads))
            if not self._up:
                self._closing.set()
                self._queue.close()
                raise ServiceStartError(f"no worker process comes up: {next(iter(self._failed.values()))}")

    def abandon(self, item: PendingQuery) -> None:
        """End the process that has this query in hand, if one has."""
        with self._changed:
            process = self._busy.get(item)
            if process is not None:
                self._up.discard(process)
                process.kill()

    def join(self, timeout_s: float) -> list[PendingQuery]:
        """Wait for the workers to finish the closed queue; returns what they still have in hand."""
        end = time.perf_counter() + timeout_s
        self._closing.set()
        for thread in self._threads:
            thread.join(max(0.0, end - time.perf_counter()))
        with self._changed:
            return list(self._busy)

    def _run(self) -> None:
        process = self._replaced(None)
        while (item := self._queue.get()) is not None:
            start = time.perf_counter()
            try:
                process = self._replaced(process)
                with self._changed:
                    self._busy[item] = process
                start = time.perf_counter()
                if process is None:
                    item.refuse(RequestError(ErrorCode.SHUTTING_DOWN, "the server is stopping"))
                elif not item.answered:
                    self._answer(item, process)
            finally:
                with self._changed:
                    self._busy.pop(item, None)
                self._queue.done(item, time.perf_counter() - start)
            process = self._replaced(process)
        if process is not None:
            self._gone(process)

    def _replaced(self, process: WorkerProcess | None) -> WorkerProcess | None:
        """The process while it lives, else a new one that is up; None where none comes up before the end."""
        wait_s = _RETRY_S
        while process is None or not process.is_alive():
            if process is not None:
                self._gone(process)
                process = None
            try:
                process = WorkerProcess(self._limits, self._answerer)
                process.open(self.published)
            except Exception as error:
                if process is not None:
                    self._gone(process)
                process = None
                logger.exception("a worker does not come up", extra=fields("worker_failed"))
                with self._changed:
                    self._failed[threading.current_thread().name] = str(error)
                    self._changed.notify_all()
                if self._closing.wait(wait_s):
                    return None
                wait_s = min(2 * wait_s, _MAX_RETRY_S)
            else:
                with self._changed:
                    self._up.add(process)
                    self._changed.notify_all()
        return process

    def _gone(self, process: WorkerProcess) -> None:
        with self._changed:
            self._up.discard(process)
        process.close()

    def _answer(self, item: PendingQuery, process: WorkerProcess) -> None:
        try:
            self._localise(item, process)
        except RequestError as error:
            item.request_id = error.request_id or item.request_id
            item.refuse(error)
        except Exception as error:
            if item.answered:  # and the process ended since
                return
            logger.exception("query failed", extra=fields("internal", request_id=item.request_id))
            what = error if isinstance(error, WorkerFailedError) else "the server failed"
            text = f"{what} on this query, which concerns no other; the server's log says why"
            item.refuse(RequestError(ErrorCode.INTERNAL, f"{text} under request id {item.request_id}"))

    def _localise(self, item: PendingQuery, process: WorkerProcess) -> None:
        clock = StageClock(start=item.received)
        clock.lap("queue")
        request = parse_attachment(LocaliseWireRequest, item.bytes_of("attachment"))
        item.request_id = request.request_id or item.request_id
        if request.contribute and self._inbox is None:
            instead = "leave it out, or start the server with --contributions on"
            text = f"contribute: this server takes no contributions; {instead}"
            raise RequestError(ErrorCode.UNSUPPORTED, text)
        wished_s = (request.options.deadline_ms or math.inf) / 1e3
        work_end = time.perf_counter() + self._options.work_s
        item.deadline = min(item.deadline, item.received + wished_s, work_end)
        data = item.bytes_of("payload")
        clock.lap("request")
        if item.answered:
            return
        asked = request.model_copy(update={"request_id": item.request_id})
        left_s = item.deadline - time.perf_counter()
        if left_s <= 0.0:
            raise item.deadline_error()
        reply = process.ask(self.published, asked, data, LocaliseReply, left_s, item.deadline_error())
        clock.lap("worker", reply.timings_ms)
        reply = reply.model_copy(update={"timings_ms": clock.milliseconds()})
        if request.contribute:
            self._answer_and_keep(item, data, request, reply, clock)
        else:
            item.answer(reply)

    def _answer_and_keep(
        self,
        item: PendingQuery,
        data: bytes,
        request: LocaliseWireRequest,
        reply: LocaliseReply,
        clock: StageClock,
    ) -> None:
        """Answer, and hand the photo to the inbox if it has a place; what the answer says is then done."""
        assert self._inbox is not None

        def answer(said: ContributionReply) -> bool:
            clock.lap("contribution")
            told = {"contribution": said, "timings_ms": clock.milliseconds()}
            return item.answer(reply.model_copy(update=told))

        received_at = datetime.now(UTC)
        owner = item.identity or ANONYMOUS  # never what the request claims
        place = self._inbox.reserve(owner, len(data))
        if isinstance(place, ContributionReply):
            answer(place)
            return
        answered = False
        try:
            name, queued = candidate_id_of(data), "queued for the inbox"
            answered = answer(ContributionReply(accepted=True, candidate_id=name, reason=None, detail=queued))
        finally:
            if not answered:
                self._inbox.cancel(place)
        if answered:
            self._inbox.submit(place, lambda: contribution_of(data, request, reply, received_at, owner))
