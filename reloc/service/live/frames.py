"""A live session's frames in its worker process: decode, track, word the answer."""

import os
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.features.decode import decode_gray, probe
from featuredb.features.shrink import fitted_size, shrunk
from featuredb.geometry.camera import Camera
from featuredb.stage_clock import StageClock
from reloc.answered_view import geo_prior
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from reloc.service.handler import image_refused, place_fields, query_camera
from reloc.service.options import LiveOptions
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.values import TrajectoryPoint, point_of
from reloc.wire.query import ErrorCode, Intrinsics, RequestError
from reloc.wire.track import TrackOpenRequest, TrackPose

# Pixels to decode that 4K video has at most. Frames of more are served behind queries.
_VIDEO_PIXELS = 4096 * 2160
_YIELDING = 10  # niceness: a ninth of the processor that a query gets beside it


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAsk:
    """A frame whose header is in order; the image's bytes follow."""

    sequence: int
    time_s: float
    dropped: int  # frames before it that were not looked at
    received_at: str  # ISO 8601


class FrameAnswerer:
    """Answers the frames of one session, in their order; where it begins anew, the track does.

    Its `answer` is a `reloc.service.workers.answering.Answerer`: until its first frame it can be sent to a
    process.
    """

    def __init__(self, session: str, request: TrackOpenRequest, options: LiveOptions) -> None:
        """Raises RequestError: the camera or the prior is none."""
        self._session, self._options = session, options
        self._lens = lens = request.camera
        if lens is not None:
            query_camera(lens, lens.width, lens.height)
        prior = None if request.prior is None else geo_prior(request.prior)
        self._request = LocaliseRequest(prior=prior)
        self._localiser: Localiser | None = None
        self._tracker: Tracker | None = None
        self._size: tuple[int, int] | None = None

    def answer(self, ask: FrameAsk, data: bytes, localiser: Localiser) -> TrackPose:
        """The pose of a frame, or that the track is lost.

        Raises:
            RequestError: too many pixels, a broken image, one of another size than those before, or that the
                session's camera does not fit.
        """
        clock = StageClock()
        gray = self._decoded(data)
        clock.lap("decode")
        tracker = self._tracker_for(gray, localiser)
        height, width = gray.shape
        tracked = tracker.track(shrunk(gray, self._options.max_side_px), ask.time_s)
        clock.lap("track")
        point = point_of(tracked)
        camera = None if tracked.camera is None else tracked.camera.scaled_to(width, height)
        clock.lap("reply")
        return pose_message(
            point,
            camera,
            session=self._session,
            snapshot=localiser.snapshot,
            answered_at=datetime.now(UTC).isoformat(),
            timings_ms=clock.milliseconds(),
            **asdict(ask),
        )

    def _decoded(self, data: bytes) -> NDArray[np.uint8]:
        limits = self._options.limits
        try:
            header = probe(data, limits)
            if header.width * header.height * header.scans > _VIDEO_PIXELS:
                _yield_to_queries()
            gray = decode_gray(data, limits)
        except ImageError as error:
            raise image_refused(error) from error
        size = (gray.shape[1], gray.shape[0])
        if min(fitted_size(*size, self._options.max_side_px)) < limits.min_side_px:
            raise RequestError(
                ErrorCode.BAD_IMAGE, f"image: {size[0]}x{size[1]} pixels are too narrow a picture to track"
            )
        if self._size is not None and size != self._size:
            raise RequestError(
                ErrorCode.BAD_IMAGE,
                f"image: expected {self._size[0]}x{self._size[1]} pixels as in the frames before, found "
                f"{size[0]}x{size[1]}; open a new session for another size",
            )
        return gray

    def _tracker_for(self, gray: NDArray[np.uint8], localiser: Localiser) -> Tracker:
        """The session's tracker, over the maps in service: it begins with the first frame and its size.

        Maps that are all of another extractor answer nothing, as none.
        """
        if self._tracker is not None and localiser is self._localiser:
            return self._tracker
        localise = localiser.options
        wanted = localise.extractor.fingerprint
        finder = MapFinder([a for a in localiser.areas if a.area.extractor_fingerprint == wanted])
        if self._tracker is None:
            options = replace(self._options.track, live=True, localise=localise)
            self._size = (gray.shape[1], gray.shape[0])
            tracked_size = fitted_size(*self._size, self._options.max_side_px)
            camera = None if self._lens is None else query_camera(self._lens, *tracked_size)
            self._tracker = Tracker(finder, camera, options, self._request)
        else:
            self._tracker.use(finder)
        self._localiser = localiser
        return self._tracker


def pose_message(point: TrajectoryPoint, camera: Camera | None, **about: Any) -> TrackPose:
    """A frame on Earth as the wire says it, with its camera as the client sent it where there is a pose.

    `about`: the other fields of TrackPose; a time goes before the point's.
    """
    pose: dict[str, Any] = {}
    if point.pose is not None:
        assert camera is not None
        lens = Intrinsics(**asdict(camera))
        pose = {**place_fields(point.pose), "camera": lens, "map_id": point.pose.map_id}
    same = {name: getattr(point, name) for name in ("time_s", "state", "detail", "inliers")}
    return TrackPose(**same | about | pose)


def _yield_to_queries() -> None:
    """This process, a session's own, works behind queries from now on: a priority does not come back."""
    if os.nice(0) >= _YIELDING:
        return
    tasks = Path("/proc/self/task")  # Linux has priorities by thread; those to come inherit it
    for task in [int(one.name) for one in tasks.iterdir()] if tasks.exists() else [0]:
        with suppress(OSError):  # it has ended meanwhile
            os.setpriority(os.PRIO_PROCESS, task, _YIELDING)
