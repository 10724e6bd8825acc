"""One live session: a thread that takes the latest frame, has a process follow it and hands out its pose."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Self

from pydantic import BaseModel

from featuredb.stage_clock import StageClock
from reloc.service.live.frames import FrameAnswerer, FrameAsk
from reloc.service.logs import Tally, fields
from reloc.service.options import ServeOptions
from reloc.service.workers.area_files import LocaliserFiles
from reloc.service.workers.process import WorkerFailedError, WorkerProcess
from reloc.wire.query import ErrorCode, RequestError, bad_request, parse_attachment
from reloc.wire.track import EndReason, TrackEvent, TrackFrame, TrackPose

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """A frame as it came."""

    header: bytes  # its attachment
    payload: bytes  # the image file's bytes; empty where `size` is over the limit
    size: int  # bytes that were sent
    received: float  # `time.perf_counter` at receipt
    received_at: datetime  # the same by the clock


class Follower:
    """Answers the frames of one session, in their order, from one thread but for `stop`. A context manager.

    The track lives in the process. A frame that the process does not survive is refused; with the next one a
    new process begins, in which the track is looked for anew.
    """

    def __init__(
        self,
        answerer: FrameAnswerer,
        options: ServeOptions,  # a frame has the limits of a query
        files: Callable[[], LocaliserFiles],  # the area in service, maybe another one from frame to frame
    ) -> None:
        self._answerer, self._files = answerer, files
        self._limits, self._frame_s = options.worker_limits, options.work_s
        self._max_bytes = options.live.limits.max_bytes
        self._process: WorkerProcess | None = None
        self._last: TrackFrame | None = None  # whose header was in order
        self._last_time_s: float | None = None  # of the last frame that was tracked
        self._looked_at = 0
        self._stopped = False

    def __enter__(self) -> Self:
        """Raises WorkerFailedError: no process comes up, or as told."""
        try:
            self._ready().open(self._files())
        except WorkerFailedError:
            self._close()
            raise
        return self

    def __exit__(self, *failed: object) -> None:
        self._close()

    def stop(self) -> None:
        """Kill the process, whatever it is at; returns at once."""
        self._stopped = True
        process = self._process
        if process is not None:
            process.kill()

    def answer(self, header: TrackFrame, arrival: Arrival) -> TrackPose:
        """The pose of a frame, or that the track is lost.

        Raises:
            RequestError: a header that goes back, what `FrameAnswerer.answer` refuses, or a frame that is
                beyond the limits or ends the process. WorkerFailedError: it was told to stop.
        """
        clock = StageClock(start=arrival.received)
        self._check(header, arrival.size)
        try:
            process = self._ready()
            clock.lap("queue")
            frame = FrameAsk(
                sequence=header.sequence,
                time_s=header.time_s,
                dropped=header.sequence + 1 - self._looked_at,
                received_at=arrival.received_at.isoformat(),
            )
            late = RequestError(
                ErrorCode.DEADLINE, f"the frame was not done within {self._frame_s:g} s; send smaller ones"
            )
            pose = process.ask(self._files(), frame, arrival.payload, TrackPose, self._frame_s, late)
        except WorkerFailedError as error:
            self._close()
            if self._stopped:
                raise
            logger.exception("a frame failed", extra=fields("frame_failed"))
            text = f"{error} on this frame; the server's log has it. The track begins anew"
            raise RequestError(ErrorCode.INTERNAL, text) from error
        self._last_time_s = header.time_s
        clock.lap("worker", pose.timings_ms)
        return pose.model_copy(update={"timings_ms": clock.milliseconds()})

    def _ready(self) -> WorkerProcess:
        """The process, a new one where it has ended."""
        if self._process is None or not self._process.is_alive():
            self._close()
            self._process = WorkerProcess(self._limits, self._answerer.answer)
            if self._stopped:  # while it was started
                self._process.kill()
        return self._process

    def _close(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None

    def _check(self, header: TrackFrame, size: int) -> None:
        """Raises RequestError: the header goes back, or the payload is too large."""
        if self._last is not None and header.sequence <= self._last.sequence:
            raise bad_request(
                f"sequence: expected more than {self._last.sequence}, that of the frame before, found "
                f"{header.sequence}; number the frames from 0, and open a new session to begin again",
            )
        self._last = header
        self._looked_at += 1
        if self._last_time_s is not None and header.time_s <= self._last_time_s:
            before = f"{self._last_time_s}, that of the frame before"
            raise bad_request(f"time_s: expected more than {before}, found {header.time_s}")
        if size > self._max_bytes:
            raise RequestError(
                ErrorCode.TOO_LARGE,
                f"payload: expected at most {self._max_bytes} bytes, found {size}; send smaller or more "
                "compressed frames",
            )


_END_TEXT = {
    EndReason.CLIENT_GONE: "the client has closed the session, or is gone",
    EndReason.MADE_ROOM: "another client asks for a session, and this one's has several",
    EndReason.SHUTTING_DOWN: "the server is stopping; open a session of another one or later",
    EndReason.INTERNAL: "the server failed on this session; its log says why under the session's name",
}
# For these nobody waits for the frame in hand, and its process is wanted for somebody else.
_AT_ONCE = (EndReason.CLIENT_GONE, EndReason.MADE_ROOM)


class LiveSession:
    """Begins with `start` and ends by itself (idle, a defect), or by `end`; never more than one frame waits.

    `name`: of the session on the wire. `asker`: who shares the server with others, as of a query.
    """

    def __init__(
        self,
        name: str,
        asker: str,
        follower: Follower,
        *,
        idle_timeout_s: float,
        publish: Callable[[str, BaseModel], None],  # under a leaf of its key; never waits for the client
        tally: Tally,
        on_end: Callable[[], None],  # by the session's thread when nothing is left of it, before it says so
    ) -> None:
        self.name, self.asker = name, asker
        self._follower = follower
        self._idle_timeout_s = idle_timeout_s
        self._publish = publish
        self._tally = tally
        self._on_end = on_end
        self._waiting: Arrival | None = None
        self._reason: EndReason | None = None
        self._changed = threading.Condition()  # the two above
        self._cut_off = False  # its process was ended, whatever it was at
        self._states: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._run, name=f"live-{name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def offer(self, arrival: Arrival) -> None:
        """Leave a frame for the thread; the one that waits, if any, is dropped for it."""
        self._tally.add("frame received")
        with self._changed:
            dropped = self.ending or self._waiting is not None
            if not self.ending:
                self._waiting = arrival
                self._changed.notify()
        if dropped:
            self._tally.add("frame dropped")

    def end(self, reason: EndReason) -> None:
        """Take no more frames; the first reason counts. Returns at once.

        The frame in hand is answered, but for a client that is gone or has to make room.
        """
        with self._changed:
            self._reason = self._reason or reason
            self._changed.notify()
        if reason in _AT_ONCE:
            self._cut_off = True
            self._follower.stop()

    @property
    def ending(self) -> bool:
        """Whether it takes no more frames."""
        return self._reason is not None

    def join(self, timeout_s: float) -> None:
        """Wait for the end."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            with self._follower:
                self._answer_frames()
        except Exception as error:
            if not (self._cut_off and isinstance(error, WorkerFailedError)):
                logger.exception("live session failed", extra=fields("internal", session=self.name))
                self.end(EndReason.INTERNAL)
        self._on_end()
        self._say_ended()

    def _answer_frames(self) -> None:
        usable_until = time.perf_counter() + self._idle_timeout_s
        while self._reason is None:
            arrival = self._next(usable_until - time.perf_counter())
            if arrival is not None and self._answered(arrival):
                usable_until = time.perf_counter() + self._idle_timeout_s
            elif self._reason is None and time.perf_counter() >= usable_until:
                self.end(EndReason.IDLE)

    def _next(self, timeout_s: float) -> Arrival | None:
        """The latest frame, as soon as there is one; None when none came in time, and at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self.ending or self._waiting is not None, max(timeout_s, 0.0))
            arrival, self._waiting = self._waiting, None
            return None if self.ending else arrival

    def _answered(self, arrival: Arrival) -> bool:
        """Whether the frame could be used: it has been answered then."""
        sequence: int | None = None
        try:
            header = parse_attachment(TrackFrame, arrival.header)
            sequence = header.sequence
            pose = self._follower.answer(header, arrival)
        except RequestError as error:
            self._tally.add("frame refused", error.code)
            self._states["refused"] += 1
            self._event("refused", error.code, error.message, sequence)
            return False
        self._states[pose.state] += 1
        latency_ms = (time.perf_counter() - arrival.received) * 1e3
        self._tally.add("frame answered", pose.state, latency_ms)
        self._publish("poses", pose)
        return True

    def _say_ended(self) -> None:
        reason = self._reason or EndReason.INTERNAL
        text = _END_TEXT.get(reason, f"no usable frame for {self._idle_timeout_s:g} s")
        self._event("ended", reason, text, None)
        self._tally.add("ended", reason)
        said = {"session": self.name, "reason": reason, "frames": dict(self._states)}
        logger.info("live session ended", extra=fields("live_ended", **said))

    def _event(self, kind: str, code: str, message: str, sequence: int | None) -> None:
        said = {"type": kind, "code": code, "message": message, "sequence": sequence}
        now = datetime.now(UTC).isoformat()
        self._publish("events", TrackEvent.model_validate({**said, "session": self.name, "time": now}))
