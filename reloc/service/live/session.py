"""One live session: a thread that takes the latest frame, has it tracked and hands out its pose."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime

from pydantic import BaseModel

from reloc.service.live.follower import Arrival, Follower, FollowerStoppedError, FrameError
from reloc.service.logs import fields
from reloc.service.tally import Tally
from reloc.wire.track import EndReason, TrackEvent

logger = logging.getLogger(__name__)

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
        publish: Callable[[str, BaseModel], None],
        tally: Tally,
        on_end: Callable[[], None],
    ) -> None:
        """
        Args:
            publish: sends a message under a leaf of the session's key; never waits for the client.
            on_end: called by the session's thread when nothing is left of it, before it says so.
        """
        self.name, self.asker = name, asker
        self._follower = follower
        self._idle_timeout_s = idle_timeout_s
        self._publish = publish
        self._tally = tally
        self._on_end = on_end
        self._waiting: Arrival | None = None
        self._reason: EndReason | None = None
        self._changed = threading.Condition()  # the two above
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
        except FollowerStoppedError:
            pass
        except Exception:
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
        try:
            pose = self._follower.answer(arrival)
        except FrameError as error:
            self._tally.add("frame refused", error.code)
            self._states["refused"] += 1
            self._event("refused", error.code, error.message, error.sequence)
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
