"""The server's end of a live session: headers are checked here, frames looked at in a process of its own."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Self

from featuredb.stage_clock import StageClock
from reloc.service.live.frames import FrameAnswerer, FrameAsk
from reloc.service.logs import fields
from reloc.service.options import ServeOptions
from reloc.service.workers.area_files import LocaliserFiles
from reloc.service.workers.process import WorkerDefectError, WorkerEndedError, WorkerProcess
from reloc.wire.query import ErrorCode, RequestError, parse_attachment
from reloc.wire.track import TrackFrame, TrackPose

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """A frame as it came."""

    header: bytes  # its attachment
    payload: bytes  # the image file's bytes; empty where `size` is over the limit
    size: int  # bytes that were sent
    received: float  # `time.perf_counter` at receipt
    received_at: datetime  # the same by the clock


class FrameError(RequestError):
    """A frame cannot be used; `sequence`: its number, where it could be read."""

    def __init__(self, code: ErrorCode, message: str, sequence: int | None) -> None:
        super().__init__(code, message)
        self.sequence = sequence


class FollowerStoppedError(Exception):
    """The follower was told to stop."""


class Follower:
    """Answers the frames of one session, in their order, from one thread but for `stop`. A context manager.

    The track lives in the process. A frame that the process does not survive is refused; with the next one a
    new process begins, in which the track is looked for anew.
    """

    def __init__(
        self,
        answerer: FrameAnswerer,
        options: ServeOptions,
        files: Callable[[], LocaliserFiles],
    ) -> None:
        """
        Args:
            options: of the server; a frame has the limits of a query.
            files: the area in service, which may be another one from frame to frame.
        """
        self._answerer, self._files = answerer, files
        self._limits, self._frame_s = options.worker_limits, options.work_s
        self._max_bytes = options.live.limits.max_bytes
        self._process: WorkerProcess | None = None
        self._last: TrackFrame | None = None  # whose header was in order
        self._last_time_s: float | None = None  # of the last frame that was tracked
        self._looked_at = 0
        self._stopped = False

    def __enter__(self) -> Self:
        """Raises WorkerEndedError: no process comes up; FollowerStoppedError: as told."""
        try:
            self._ready()
        except WorkerEndedError as error:
            self._close()
            self._check_not_stopped(error)
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

    def answer(self, arrival: Arrival) -> TrackPose:
        """The pose of a frame, or that the track is lost.

        Raises:
            FrameError: a header that is none or goes back, what `FrameAnswerer.answer` refuses, or a frame
                that is beyond the limits or ends the process.
            FollowerStoppedError: as told.
        """
        clock = StageClock(start=arrival.received)
        sequence: int | None = None
        try:
            header = parse_attachment(TrackFrame, arrival.header)
            sequence = header.sequence
            self._check(header, arrival.size)
            process = self._ready()
            clock.lap("queue")
            frame = FrameAsk(
                sequence=header.sequence,
                time_s=header.time_s,
                dropped=header.sequence + 1 - self._looked_at,
                received_at=arrival.received_at.isoformat(),
            )
            pose = self._asked(process, frame, arrival.payload)
        except RequestError as error:
            raise FrameError(ErrorCode(error.code), error.message, sequence) from error
        except (WorkerEndedError, WorkerDefectError) as error:
            self._close()
            self._check_not_stopped(error)
            logger.exception("a frame failed", extra=fields("frame_failed"))
            how = error if isinstance(error, WorkerEndedError) else "a defect"
            raise FrameError(
                ErrorCode.INTERNAL,
                f"{how} on this frame; the server's log has it. The track begins anew",
                sequence,
            ) from error
        self._last_time_s = header.time_s
        clock.lap("worker", pose.timings_ms)
        return pose.model_copy(update={"timings_ms": clock.milliseconds()})

    def _asked(self, process: WorkerProcess, frame: FrameAsk, data: bytes) -> TrackPose:
        late = threading.Event()

        def end() -> None:
            late.set()
            process.kill()

        watch = threading.Timer(self._frame_s, end)
        watch.start()
        try:
            return process.ask(frame, data, TrackPose)
        except WorkerEndedError as error:
            if late.is_set():
                raise RequestError(
                    ErrorCode.DEADLINE,
                    f"the frame was not done within {self._frame_s:g} s; send smaller ones",
                ) from error
            raise
        finally:
            watch.cancel()

    def _ready(self) -> WorkerProcess:
        """The process, a new one where it has ended, over the area in service."""
        if self._process is None or not self._process.is_alive():
            self._close()
            self._process = WorkerProcess(self._limits, self._answerer.answer)
            if self._stopped:  # while it was started
                self._process.kill()
        self._process.open(self._files())
        return self._process

    def _check_not_stopped(self, error: Exception) -> None:
        if self._stopped:
            raise FollowerStoppedError from error

    def _close(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None

    def _check(self, header: TrackFrame, size: int) -> None:
        """Raises RequestError: the header goes back, or the payload is too large."""
        if self._last is not None and header.sequence <= self._last.sequence:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"sequence: expected more than {self._last.sequence}, that of the frame before, found "
                f"{header.sequence}; number the frames from 0, and open a new session to begin again",
            )
        self._last = header
        self._looked_at += 1
        if self._last_time_s is not None and header.time_s <= self._last_time_s:
            raise RequestError(
                ErrorCode.BAD_REQUEST,
                f"time_s: expected more than {self._last_time_s}, that of the frame before, found "
                f"{header.time_s}",
            )
        if size > self._max_bytes:
            raise RequestError(
                ErrorCode.TOO_LARGE,
                f"payload: expected at most {self._max_bytes} bytes, found {size}; send smaller or more "
                "compressed frames",
            )
