"""A server's live sessions on Zenoh: opened by a query, fed by publications, ended with their clients."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime

import zenoh
from pydantic import BaseModel
from zenoh.handlers import Callback

from featuredb.errors import IncompatibleExtractorError
from reloc.localise.candidates import usable_areas
from reloc.service.live.frames import FrameAnswerer
from reloc.service.live.session import Arrival, Follower, LiveSession
from reloc.service.logs import Tally, fields
from reloc.service.options import LiveOptions
from reloc.service.queueing import session_of
from reloc.service.session import JSON, publish
from reloc.service.source import ServedArea
from reloc.wire.keys import NAME_EXPECTED, Keys, is_name
from reloc.wire.query import (
    MAX_ATTACHMENT_BYTES,
    ErrorCode,
    ErrorReply,
    RequestError,
    bad_request,
    encode,
    parse_attachment,
)
from reloc.wire.track import (
    EndReason,
    LiveFrameCounts,
    LiveLatency,
    LiveStatus,
    TrackLimits,
    TrackOpened,
    TrackOpenRequest,
)

logger = logging.getLogger(__name__)


class LiveSessions:
    """Opens and ends sessions; at most `LiveOptions.max_sessions` at a time, shared by who asks.

    Where all are open, the asker who has most gives up his newest for one who has at least two fewer. With
    those that are ending there are at most twice as many.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        area: Callable[[], ServedArea],  # in service now
        follower: Callable[[FrameAnswerer], Follower],
        options: LiveOptions,
        server_id: str,
        *,
        authenticates: bool,  # clients' names are proven; else who asks is the session it says it is
    ) -> None:
        self._session, self._keys, self._area, self._follower = session, keys, area, follower
        self._options, self._server_id, self._authenticates = options, server_id, authenticates
        self._tally = Tally()
        self._lock = threading.Lock()
        self._open: dict[str, LiveSession] = {}  # by key
        self._frames: dict[str, zenoh.Subscriber[None]] = {}
        self._closed = False
        self._declared = ExitStack()

    def start(self) -> None:
        """Take sessions from now on."""
        declared, keys = self._declared.enter_context, self._keys
        alive = self._session.liveliness()
        declared(alive.declare_subscriber(keys.track("*", "*", "client"), self._on_token))
        # `complete`: of several servers of one database the nearest takes the session.
        declared(self._session.declare_queryable(keys.track("*", "*"), self._on_open, complete=True))

    def close(self, timeout_s: float) -> None:
        """End all sessions, and wait for that at most so long; take no more."""
        with self._lock:
            self._closed = True
            sessions = list(self._open.values())
        for session in sessions:
            session.end(EndReason.SHUTTING_DOWN)
        end = time.perf_counter() + timeout_s
        for session in sessions:
            session.join(max(0.0, end - time.perf_counter()))
        self._declared.close()

    def status(self) -> LiveStatus:
        """Counts since the start."""
        tally = self._tally
        return LiveStatus(
            open=len(self._open),
            capacity=self._options.max_sessions,
            opened=tally.count("opened"),
            refused=tally.by_code("refused"),
            ended=tally.by_code("ended"),
            frames=LiveFrameCounts(
                received=tally.count("frame received"),
                answered=tally.by_code("frame answered"),
                refused=tally.by_code("frame refused"),
                dropped=tally.count("frame dropped"),
            ),
            latency_ms=LiveLatency(**tally.latency(50, 95)),
        )

    # Zenoh calls these in threads of its own; they must return at once.

    def _on_open(self, query: zenoh.Query) -> None:
        rest, _, name = str(query.key_expr).rpartition("/")
        client = rest.rpartition("/")[2]
        with query:
            try:
                reply = encode(self._opened(client, name, query))
            except RequestError as error:
                self._refuse(query, client, name, error)
                return
            except Exception:
                logger.exception("live session not opened", extra=fields("internal"))
                text = "the server failed to open the session; its log says why"
                self._refuse(query, client, name, RequestError(ErrorCode.INTERNAL, text))
                return
            query.reply(self._keys.track(client, name), reply, encoding=JSON)
        logger.info("live session opened", extra=fields("live_opened", client=client, session=name))

    def _refuse(self, query: zenoh.Query, client: str, name: str, error: RequestError) -> None:
        self._tally.add("refused", error.code)
        refusal = ErrorReply(code=error.code, message=error.message, request_id=None)
        query.reply_err(encode(refusal), encoding=JSON)
        asked = {"client": client[:80], "session": name[:80]}
        said = {"code": error.code, "refusal": error.message}
        logger.info("live session refused", extra=fields("live_refused", **asked, **said))

    def _on_token(self, sample: zenoh.Sample) -> None:
        """A client's token has come or gone."""
        if sample.kind != zenoh.SampleKind.DELETE:
            return
        with self._lock:
            session = self._open.get(str(sample.key_expr).rpartition("/")[0])
        if session is not None:
            session.end(EndReason.CLIENT_GONE)

    def _opened(self, client: str, name: str, query: zenoh.Query) -> TrackOpened:
        """Open the client's session of this name. Raises RequestError: why it is not opened."""
        for what, found in (("client", client), ("session", name)):
            if not is_name(found):
                raise bad_request(f"{what}: {NAME_EXPECTED}, found {found[:80]!r}")
        key = self._keys.track(client, name)
        attachment = None if query.attachment is None else query.attachment.to_bytes()
        request = parse_attachment(TrackOpenRequest, attachment)
        answerer, area = FrameAnswerer(name, request, self._options), self._area()
        asker = client if self._authenticates else session_of(query)
        try:
            usable_areas(area.localiser.areas, area.localiser.options.extractor.fingerprint)
        except IncompatibleExtractorError as error:
            raise RequestError(ErrorCode.INCOMPATIBLE_EXTRACTOR, str(error)) from error
        with ExitStack() as undo, self._lock:
            self._make_room(key, asker)
            session = LiveSession(
                name,
                asker,
                self._follower(answerer),
                idle_timeout_s=self._options.idle_timeout_s,
                publish=lambda leaf, message: self._publish(f"{key}/{leaf}", message),
                tally=self._tally,
                on_end=lambda: self._forget(key),
            )

            def take(sample: zenoh.Sample) -> None:
                self._on_frame(session, sample)

            # Called by Zenoh's own thread, not by one behind an unbounded queue of samples.
            frames = self._session.declare_subscriber(f"{key}/frames", Callback(take, indirect=False))
            undo.callback(frames.undeclare)
            session.start()
            undo.pop_all()
            self._frames[key], self._open[key] = frames, session
        self._tally.add("opened")
        limits = self._options.limits
        return TrackOpened(
            session=name,
            database=self._keys.database,
            server_id=self._server_id,
            snapshot=area.snapshot,
            idle_timeout_s=self._options.idle_timeout_s,
            limits=TrackLimits(
                max_payload_bytes=limits.max_bytes,
                max_pixels=limits.max_pixels,
                tracked_side_px=self._options.max_side_px,
            ),
        )

    def _make_room(self, key: str, asker: str) -> None:
        if self._closed:
            raise RequestError(ErrorCode.SHUTTING_DOWN, "the server is stopping; ask again later")
        if self._options.max_sessions == 0:
            raise RequestError(
                ErrorCode.UNSUPPORTED,
                "this server takes no live sessions; start it with --live-sessions 1 or more",
            )
        if key in self._open:
            raise bad_request(
                f"session: {key.rpartition('/')[2]!r} is open; choose another name, at random",
            )
        # Each has its process until it is forgotten, those that are ending as well.
        full = len(self._open) >= 2 * self._options.max_sessions
        running = [session for session in self._open.values() if not session.ending]
        if not full and len(running) < self._options.max_sessions:
            return
        held = Counter(session.asker for session in running)
        most = max(held, key=lambda name: held[name], default=asker)
        own = sum(session.asker == asker for session in self._open.values())
        if full or held[most] <= own + 1:
            raise RequestError(
                ErrorCode.BUSY,
                f"{len(self._open)} live sessions are open or ending, as many as this server takes; "
                "try again later, ask another server, or start it with more --live-sessions",
            )
        [session for session in running if session.asker == most][-1].end(EndReason.MADE_ROOM)

    def _on_frame(self, session: LiveSession, sample: zenoh.Sample) -> None:
        """Take a frame over; what is too large is not copied, and refused by the session's thread."""
        size = len(sample.payload)
        header = b"" if sample.attachment is None else sample.attachment.to_bytes()
        session.offer(
            Arrival(
                # One byte over the limit is refused as all of them would be.
                header=header[: MAX_ATTACHMENT_BYTES + 1],
                payload=sample.payload.to_bytes() if size <= self._options.limits.max_bytes else b"",
                size=size,
                received=time.perf_counter(),
                received_at=datetime.now(UTC),
            )
        )

    def _forget(self, key: str) -> None:
        """Nothing is left of the session; called by its thread."""
        with self._lock:
            frames = self._frames.pop(key)
        try:
            frames.undeclare()
        except zenoh.ZError:
            logger.exception("a live session's frames could not be undeclared")
        with self._lock:
            del self._open[key]

    def _publish(self, key: str, message: BaseModel) -> None:
        # A client that does not read loses poses; nobody waits for it.
        publish(self._session, key, message, zenoh.CongestionControl.DROP)
