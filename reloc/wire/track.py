"""The messages of a live session on the wire: opening, frames, poses, events. See `reloc.wire.query`."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, model_validator

from reloc.wire.query import (
    Answer,
    CameraRequest,
    Count,
    Intrinsics,
    NotNegative,
    PlacedAnswer,
    PriorRequest,
    Request,
)

# JSON's numbers are exact up to here.
Sequence = Annotated[int, Field(ge=0, le=2**53 - 1)]


class EndReason(StrEnum):
    """Why a session is over."""

    CLIENT_GONE = "CLIENT_GONE"  # the client's liveliness token is gone: it has closed the session, or died
    IDLE = "IDLE"  # no frame that could be used for too long
    MADE_ROOM = "MADE_ROOM"  # for a client who has fewer sessions
    SHUTTING_DOWN = "SHUTTING_DOWN"  # the server stops
    INTERNAL = "INTERNAL"  # a defect of the server; its log has the session


class TrackOpenRequest(Request):
    """Attachment of the query that opens a session."""

    # Of the frames, of any size of the same picture; without it they are estimated with the first pose.
    camera: CameraRequest | None = None
    prior: PriorRequest | None = None  # where the first frame may have been taken

    @model_validator(mode="after")
    def _exact_lens(self) -> "TrackOpenRequest":
        if self.camera is not None and self.camera.sigmas is not None:
            raise ValueError("camera.sigmas: expected none, since a session holds its lens as it is given")
        return self


class TrackLimits(Answer):
    """Of one frame; those with longer sides than `tracked_side_px` are made smaller by the server."""

    max_payload_bytes: Count
    max_pixels: Count
    tracked_side_px: Count


class TrackOpened(Answer):
    """Answer to the query that opens a session: it takes frames from now on."""

    session: str
    database: str
    server_id: str
    snapshot: Count
    idle_timeout_s: NotNegative
    limits: TrackLimits


class TrackFrame(Request):
    """Attachment of a frame; the payload is the bytes of an image file. Both grow from frame to frame."""

    sequence: Sequence  # of the client's frames from 0, also those that it does not send
    time_s: Annotated[float, Field(ge=-1e12, le=1e12)]  # on the client's own clock


TrackState = Literal["tracking", "relocalised", "lost"]


class TrackPose(PlacedAnswer):
    """Publication on `.../<session>/poses`: one for each frame that was looked at, in their order.

    The pose's fields are those of a localise reply, and null while the track is lost; `detail` then says why.
    `dropped`: frames of this session up to this one that were not looked at. `received_at`, `answered_at`: by
    the server's clock.
    """

    session: str
    sequence: Sequence
    time_s: float
    state: TrackState
    detail: str
    camera: Intrinsics | None = None
    inliers: Count
    map_id: str | None = None
    snapshot: Count
    dropped: Count
    received_at: str
    answered_at: str
    timings_ms: dict[str, NotNegative]

    @model_validator(mode="after")
    def _pose_unless_lost(self) -> "TrackPose":
        pose = (
            *(self.position, self.quaternion, self.height_datum, self.utm),
            *(self.covariance, self.accuracy, self.camera, self.map_id),
        )
        if self.state != "lost" and any(p is None for p in pose):
            raise ValueError("a frame that is tracked needs every field of the pose")
        if self.state == "lost" and (any(p is not None for p in pose) or not self.detail):
            raise ValueError("a frame that is lost needs a detail and no pose")
        return self


class TrackEvent(Answer):
    """Publication on `.../track/<client>/<session>/events`.

    `refused`: a frame cannot be used, the session goes on; `code` is one of reloc.wire.query.ErrorCode,
    `sequence` the frame's number where it could be read. `ended`: the session is over; `code` is an
    EndReason.
    """

    type: Literal["refused", "ended"]
    session: str
    code: str
    message: str
    sequence: Sequence | None
    time: str


class LiveFrameCounts(Answer):
    """Frames since the start; those that are neither answered nor refused nor dropped are in hand."""

    received: Count
    answered: dict[str, Count]
    refused: dict[str, Count]
    dropped: Count


class LiveLatency(Answer):
    """Milliseconds from receipt to pose over the latest answered frames; null before the first."""

    count: Count
    p50: NotNegative | None
    p95: NotNegative | None
    max: NotNegative | None


class LiveStatus(Answer):
    """Live sessions: open now, how many may be, opened and ended since the start."""

    open: Count
    capacity: Count
    opened: Count
    refused: dict[str, Count]
    ended: dict[str, Count]
    frames: LiveFrameCounts
    latency_ms: LiveLatency
