"""Frames of one live session in, poses out: parse, decode, track, word the answer. No network here."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, IncompatibleExtractorError, InvalidValueError
from featuredb.features.decode import decode_gray
from featuredb.geometry.camera import Camera
from featuredb.stage_clock import StageClock
from featuredb.video.film import fitted_size
from reloc.localise.result import LocaliseRequest
from reloc.service.handler import geo_prior
from reloc.service.live.latest import Arrival
from reloc.service.live.options import LiveOptions
from reloc.service.source import ServedArea
from reloc.tracking.map_ground import MapFinder, usable_areas
from reloc.tracking.pose_message import pose_message
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.values import point_of
from reloc.wire.query import CameraRequest, ErrorCode, RequestError, parse_attachment
from reloc.wire.track import TrackFrame, TrackOpenRequest, TrackPose


class FrameError(RequestError):
    """A frame cannot be used.

    Attributes:
        sequence: its number, where it could be read.
    """

    def __init__(self, code: ErrorCode, message: str, sequence: int | None) -> None:
        super().__init__(code, message)
        self.sequence = sequence


class FrameAnswerer:
    """Answers the frames of one session, in their order, from one thread. A context manager."""

    def __init__(
        self,
        session: str,
        request: TrackOpenRequest,
        area: Callable[[], ServedArea],
        options: LiveOptions,
    ) -> None:
        """
        Args:
            area: gives the area in service, which may be another one from frame to frame.

        Raises:
            RequestError: the camera or the prior is none, or no map can be compared with the frames.
        """
        self._session, self._area, self._options = session, area, options
        self._camera = None if request.camera is None else _camera(request.camera)
        prior = None if request.prior is None else geo_prior(request.prior)
        self._adopted = area()
        localise = self._adopted.localiser.options
        self._tracker_options = replace(options.track, live=True, localise=localise)
        try:
            areas = usable_areas(self._adopted.localiser.areas, localise.extractor.fingerprint)
        except IncompatibleExtractorError as error:
            raise RequestError(ErrorCode.INCOMPATIBLE_EXTRACTOR, str(error)) from error
        self._finder = MapFinder(areas)
        self._request = LocaliseRequest(prior=prior)
        self._tracker: Tracker | None = None
        self._size: tuple[int, int] | None = None
        self._last: TrackFrame | None = None  # whose header was in order
        self._last_time_s: float | None = None  # of the last frame that was tracked
        self._looked_at = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        if self._tracker is not None:
            self._tracker.__exit__(*failed)

    @property
    def snapshot(self) -> int:
        """Version of the database that it answers from."""
        return self._adopted.snapshot

    def answer(self, arrival: Arrival) -> TrackPose:
        """The pose of a frame, or that the track is lost.

        Raises:
            FrameError: a header that is none or goes back, too many bytes or pixels, a broken image, one of
                another size than those before, or that the session's camera does not fit.
        """
        clock = StageClock(start=arrival.received)
        clock.lap("queue")
        header = self._header(arrival)
        try:
            gray = self._decoded(arrival)
            clock.lap("decode")
            tracker = self._tracker_for(gray)
        except RequestError as error:
            raise FrameError(ErrorCode(error.code), error.message, header.sequence) from error
        self._last_time_s = header.time_s
        self._adopt()
        height, width = gray.shape
        tracked = tracker.track(_smaller(gray, self._options.max_side_px), header.time_s)
        clock.lap("track")
        point = point_of(tracked)
        camera = None if tracked.camera is None else tracked.camera.scaled_to(width, height)
        clock.lap("reply")
        return pose_message(
            point,
            camera,
            session=self._session,
            sequence=header.sequence,
            snapshot=self.snapshot,
            dropped=header.sequence + 1 - self._looked_at,
            received_at=arrival.received_at.isoformat(),
            answered_at=datetime.now(UTC).isoformat(),
            timings_ms=clock.milliseconds(),
        )

    def _header(self, arrival: Arrival) -> TrackFrame:
        try:
            header = parse_attachment(TrackFrame, arrival.header)
        except RequestError as error:
            raise FrameError(ErrorCode(error.code), error.message, None) from error
        if self._last is not None and header.sequence <= self._last.sequence:
            raise FrameError(
                ErrorCode.BAD_REQUEST,
                f"sequence: expected more than {self._last.sequence}, that of the frame before, found "
                f"{header.sequence}; number the frames from 0, and open a new session to begin again",
                header.sequence,
            )
        self._last = header
        self._looked_at += 1
        if self._last_time_s is not None and header.time_s <= self._last_time_s:
            raise FrameError(
                ErrorCode.BAD_REQUEST,
                f"time_s: expected more than {self._last_time_s}, that of the frame before, found "
                f"{header.time_s}",
                header.sequence,
            )
        return header

    def _decoded(self, arrival: Arrival) -> NDArray[np.uint8]:
        limits = self._options.limits
        if arrival.size > limits.max_bytes:
            raise RequestError(
                ErrorCode.TOO_LARGE,
                f"payload: expected at most {limits.max_bytes} bytes, found {arrival.size}; send smaller or "
                "more compressed frames",
            )
        if not arrival.payload:
            raise RequestError(
                ErrorCode.BAD_IMAGE, "payload: expected the bytes of an image file, found none"
            )
        try:
            gray = decode_gray(arrival.payload, limits)
        except ImageError as error:
            code = ErrorCode.TOO_LARGE if error.code == "too_large" else ErrorCode.BAD_IMAGE
            raise RequestError(code, f"image: {error}") from error
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

    def _tracker_for(self, gray: NDArray[np.uint8]) -> Tracker:
        """The session's tracker, which begins with the first frame: the camera is scaled to its size."""
        if self._tracker is None:
            height, width = gray.shape
            camera = None
            if self._camera is not None:
                try:
                    camera = self._camera.scaled_to(*fitted_size(width, height, self._options.max_side_px))
                except InvalidValueError as error:
                    raise RequestError(
                        ErrorCode.BAD_REQUEST, f"camera: {error} (the frame has {width}x{height})"
                    ) from error
            self._tracker = Tracker(self._finder, camera, self._tracker_options, self._request)
            self._size = (width, height)
        return self._tracker

    def _adopt(self) -> None:
        """Track by the area in service now.

        A newer one whose maps are all of another extractor answers nothing, as one without maps.
        """
        area = self._area()
        if area is self._adopted or self._tracker is None:
            return
        self._adopted = area
        wanted = self._tracker_options.localise.extractor.fingerprint
        areas = [a for a in area.localiser.areas if a.area.extractor_fingerprint == wanted]
        self._tracker.use(MapFinder(areas))


def _smaller(gray: NDArray[np.uint8], max_side_px: int) -> NDArray[np.uint8]:
    height, width = gray.shape
    size = fitted_size(width, height, max_side_px)
    if size == (width, height):
        return gray
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _camera(camera: CameraRequest) -> Camera:
    try:
        return Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params)
    except InvalidValueError as error:
        raise RequestError(ErrorCode.BAD_REQUEST, f"camera: {error}") from error
