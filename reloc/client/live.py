"""A live session with a relocalisation server: frames out, poses in. Needs nothing but eclipse-zenoh."""

import threading
import time
import uuid
from collections import OrderedDict, deque
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Self

import zenoh
from zenoh.handlers import Callback

from featuredb.errors import ServiceError
from reloc.client.connection import NO_SERVER, TIMEOUT, first_reply, read_message
from reloc.wire.keys import Keys
from reloc.wire.query import CameraRequest, PriorRequest, encode
from reloc.wire.track import TrackEvent, TrackFrame, TrackOpened, TrackOpenRequest, TrackPose

_KEPT = 10_000  # poses that nobody has read, and frames whose times are remembered; the oldest go
_KEPT_REFUSALS = 100
# Silence after which the client asks whether the server is there still.
_SILENCE_S = 1.0
_SERVER_ANSWERS_S = 5.0


class LiveTrack:
    """One live session; a context manager, open within the block. `Client.track` makes it.

    Frames are sent from one thread, and may be received in another. A frame that comes while the server has
    another one in hand waits for it, until a newer one takes its place: it is dropped then and has no pose.
    `refusals` says why frames could not be used, the latest hundred. `opened`: what the server said of the
    session, its limits and time-out.
    """

    opened: TrackOpened
    _frames: zenoh.Publisher

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        client: str,
        camera: CameraRequest | None = None,
        prior: PriorRequest | None = None,
        timeout_s: float = 10.0,
    ) -> None:
        """`keys`: of the database on the wire; `client`: the name of this client; see `Client.track`."""
        self.name = uuid.uuid4().hex  # of the session on the wire
        self.refusals: deque[TrackEvent] = deque(maxlen=_KEPT_REFUSALS)
        self._session, self._keys = session, keys
        self._key = keys.track(client, self.name)
        self._request = TrackOpenRequest(camera=camera, prior=prior)
        self._timeout_s = timeout_s
        self._declared = ExitStack()
        self._next = 0
        self._changed = threading.Condition()
        self._poses: deque[TrackPose] = deque(maxlen=_KEPT)
        self._end: ServiceError | None = None
        self._heard = time.monotonic()
        self._sent: OrderedDict[int, float] = OrderedDict()
        self._latency_ms: OrderedDict[int, float] = OrderedDict()

    def __enter__(self) -> Self:
        """Ask the server for the session.

        Raises:
            ServiceError: BUSY, UNSUPPORTED, BAD_REQUEST and so on as the server says; TIMEOUT.
        """
        session, declared = self._session, self._declared.enter_context
        # Both on Zenoh's own thread, so that the end does not come before the last pose.
        for leaf, callback in (("poses", self._on_pose), ("events", self._on_event)):
            declared(session.declare_subscriber(f"{self._key}/{leaf}", Callback(callback, indirect=False)))
        declared(session.liveliness().declare_token(f"{self._key}/client"))
        try:
            opened = first_reply(
                session, self._key, TrackOpened, self._timeout_s, attachment=encode(self._request)
            )
            if opened is None:
                where = f"within {self._timeout_s:g} s at {self._key}"
                raise ServiceError(TIMEOUT, f"no server opened a live session {where}")
        except ServiceError:
            self._declared.close()
            raise
        self.opened = opened
        # A frame that the network has no room for is dropped: the next one is newer.
        self._frames = declared(
            session.declare_publisher(
                f"{self._key}/frames", congestion_control=zenoh.CongestionControl.DROP, express=True
            )
        )
        self._heard = time.monotonic()
        return self

    def __exit__(self, *failed: object) -> None:
        self._over(ServiceError("CLOSED", "the session was closed by this client"))
        self._declared.close()  # the server hears of it by the token that goes

    def send(self, image: bytes, time_s: float, sequence: int | None = None) -> int:
        """Send a frame, without waiting for anything; its number.

        Args:
            image: bytes of an image file (JPEG, PNG, ...), of the same size as the frames before.
            time_s: when it was taken, by any clock that grows.
            sequence: its number among all frames of the camera, from 0; None: one more than the last.

        Raises:
            ServiceError: the session is over; `code` says why.
        """
        if self._end is not None:
            raise self._end
        sequence = self._next if sequence is None else sequence
        self._next = sequence + 1
        header = encode(TrackFrame(sequence=sequence, time_s=time_s))
        with self._changed:
            _remember(self._sent, sequence, time.perf_counter())
        self._frames.put(image, attachment=header)
        return sequence

    def next(self, timeout_s: float | None = None) -> TrackPose | None:
        """The next pose; None when none came within the time.

        Raises:
            ServiceError: no more will come: the session has ended (`code` is a reloc.wire.track.EndReason, or
                CLOSED), or NO_SERVER: the server is gone.
        """
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_s = _SILENCE_S if end is None else max(0.0, min(_SILENCE_S, end - time.monotonic()))
            with self._changed:
                self._changed.wait_for(lambda: self._poses or self._end is not None, left_s)
                if self._poses:
                    return self._poses.popleft()
                if self._end is not None:
                    raise self._end
            if time.monotonic() - self._heard > _SILENCE_S:
                self._check_server()
            if end is not None and time.monotonic() >= end:
                return None

    def __iter__(self) -> Iterator[TrackPose]:
        """Poses as they come, until the session is closed by this client.

        Raises:
            ServiceError: it has ended in another way.
        """
        while True:
            try:
                pose = self.next()
            except ServiceError as error:
                if error.code == "CLOSED":
                    return
                raise
            if pose is not None:
                yield pose

    def latency_ms(self, sequence: int) -> float | None:
        """From sending a frame to its pose, here; None where there is none, or long ago."""
        return self._latency_ms.get(sequence)

    def _check_server(self) -> None:
        """End the session when its server is not there any more."""
        token = self._keys.server_token(self.opened.server_id)
        replies = self._session.liveliness().get(token, timeout=_SERVER_ANSWERS_S)
        self._heard = time.monotonic()
        if not any(reply.ok is not None for reply in replies):
            self._over(ServiceError(NO_SERVER, "the server of this session is gone"))

    def _over(self, why: ServiceError) -> None:
        with self._changed:
            self._end = self._end or why
            self._changed.notify_all()

    # Zenoh calls these in a thread of its own; they must return at once.

    def _on_pose(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        try:
            pose = read_message(sample.payload.to_bytes(), TrackPose)
        except ServiceError as error:
            self._over(error)
            return
        with self._changed:
            self._heard = time.monotonic()
            sent = self._sent.pop(pose.sequence, None)
            if sent is not None:
                _remember(self._latency_ms, pose.sequence, (now - sent) * 1e3)
            self._poses.append(pose)
            self._changed.notify_all()

    def _on_event(self, sample: zenoh.Sample) -> None:
        try:
            event = read_message(sample.payload.to_bytes(), TrackEvent)
        except ServiceError as error:
            self._over(error)
            return
        self._heard = time.monotonic()
        if event.type == "ended":
            self._over(ServiceError(event.code, event.message))
        else:
            self.refusals.append(event)


def _remember(times: OrderedDict[int, float], sequence: int, value: float) -> None:
    times[sequence] = value
    while len(times) > _KEPT:
        times.popitem(last=False)
