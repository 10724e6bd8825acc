"""A whole video: frames in, a trajectory out, and a film with the track drawn over it on request."""

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import file_sha256
from featuredb.errors import VideoError
from featuredb.features.exif.read import unnamed_model
from featuredb.geometry.camera import Camera
from featuredb.stage_clock import StageClock
from featuredb.video.film import Video, VideoFrame, VideoInfo, VideoOptions
from featuredb.video.frames import open_video
from featuredb.video.opening import Source
from featuredb.video.writer import VideoWriter, VideoWriterOptions
from reloc.localise.result import LocaliseRequest
from reloc.tracking.film_end import STOPPED, until_it_ends
from reloc.tracking.ground import Finder, TrackedFrame
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint, point_of

# Frames that one core decodes while the other tracks one, when no keyframe is in hand: some are left over.
_READ_ON = 4
# Of pictures that wait, for their greys and, as 4:2:0, their colours: at 3840x2160 ten frames.
_MOST_BYTES = 1 << 27

_LANDMARK_RGB, _OTHER_RGB = (60, 220, 60), (40, 160, 240)
_STATE_RGB = {"tracking": (60, 220, 60), "relocalised": (250, 210, 40), "lost": (240, 40, 40)}


def draw_frame(rgb: NDArray[np.uint8], frame: TrackedFrame, point: TrajectoryPoint) -> NDArray[np.uint8]:
    """A copy of the frame (h, w, 3) uint8, red first, drawn over.

    Circles are landmarks where the flow has them; dots are points of the map where the pose says they are.
    """
    picture = np.ascontiguousarray(rgb).copy()
    scale = max(picture.shape[:2]) / 1280
    if frame.cam_from_local is not None and frame.ground is not None and frame.camera is not None:
        for x, y in frame.ground.visible(frame.camera, frame.cam_from_local):
            cv2.circle(picture, (round(x), round(y)), max(1, round(scale)), _OTHER_RGB, -1, cv2.LINE_AA)
        for x, y in frame.pixels if frame.pixels is not None else ():
            cv2.circle(picture, (round(x), round(y)), round(4 * scale) + 1, _LANDMARK_RGB, 1, cv2.LINE_AA)
    words, colour = _words(point), _STATE_RGB[point.state]
    box = picture[: round((14 + 26 * len(words)) * scale), : round(640 * scale)]
    box //= 3
    for row, text in enumerate(words):
        place = (round(12 * scale), round((28 + 26 * row) * scale))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6 * scale, colour, 1, cv2.LINE_AA)
    return picture


def _words(point: TrajectoryPoint) -> list[str]:
    head = f"frame {point.index}  {point.time_s:.2f} s  {point.state}"
    if point.in_map is not None:
        x, y, z = point.in_map.cam_from_map.center
        unit = "m" if point.in_map.frame.metric else "units"
        return [
            f"{head}  {point.inliers} landmarks",
            f"map {point.in_map.map_id[:12]}, no place on Earth",
            f"x {x:.3f}  y {y:.3f}  z {z:.3f} {unit} in its frame",
        ]
    if point.pose is None:
        return [head, point.detail[:80]]
    east, north, up = point.pose.utm
    sigma = float(np.sqrt(np.diag(point.pose.covariance)[3:].sum()))
    heading, pitch, _ = point.pose.geopose.heading_pitch_roll_deg
    return [
        f"{head}  {point.inliers} landmarks",
        f"EPSG:{point.pose.epsg}  {east:.2f} {north:.2f} {up:.2f}  sigma {sigma:.2f} m",
        f"heading {heading:.1f}  pitch {pitch:.1f}",
    ]


def read_ahead(
    video: Video, idle: Callable[[], bool] = lambda: True, most: int = 24
) -> Generator[VideoFrame, None, None]:
    """The frames of an open film, in order; what goes wrong as they are read is raised at its frame.

    While it is `idle` after a frame, a thread decodes further ones: up to `most`, fewer where they are large.
    The film's `report` knows of them. Live sources are not read ahead: what they show now is wanted.
    """
    info, frames = video.info, iter(video)
    bytes_each = info.frame_width * info.frame_height + 3 * info.width * info.height // 2
    most = 0 if info.live else min(most, max(1, _MOST_BYTES // bytes_each))
    ahead: deque[Future[VideoFrame | None]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="decoding") as pool:
        try:
            # Nothing is decoded here while anything is there: frames stay in order.
            while (frame := ahead.popleft().result() if ahead else next(frames, None)) is not None:
                yield frame
                wanted = min(_READ_ON, most - len(ahead)) if idle() else 0
                ahead.extend(pool.submit(next, frames, None) for _ in range(wanted))
        finally:
            pool.shutdown(cancel_futures=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackVideoOptions(VideoOptions):
    """How a video is read, as in VideoOptions, and tracked.

    Attributes:
        max_side_px: frames are made smaller for tracking; flow costs as their area, and 1280 pixels tell a
            pose to centimetres at the distances of drones. The overlay is of this size, too.
        start_s, end_s: the stretch of the film; None: all of it.
        fps: frames per second of a folder of pictures without a file of times.
        track: the tracker's settings.
    """

    max_side_px: int | None = 1280
    track: TrackOptions = field(default_factory=TrackOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedVideo:
    """What came of a video."""

    trajectory: Trajectory
    camera: Camera | None  # of the frames as they were tracked; None where nothing was localised
    seconds: dict[str, float]  # `total`; of it `tracking`, `drawing` and `waiting` for frames
    complaints: tuple[str, ...]  # what was wrong with the film, for people
    stopped: bool = False  # by hand, before the end of a film that has one
    undrawn: str = ""  # why there is no overlay, where one was asked for


class _Overlay:
    """The film with the track drawn over it; where it can be written no more, tracking goes on without."""

    def __init__(self, path: Path | None, info: VideoInfo) -> None:
        self.undrawn = ""
        self._first_s: float | None = None
        self._writer = path and VideoWriter(
            path,
            width=info.frame_width // 2 * 2,
            height=info.frame_height // 2 * 2,
            fps=None,
            options=VideoWriterOptions(crf=23, preset="veryfast"),
        )

    def __enter__(self) -> Self:
        if self._writer:
            self._writer.__enter__()
        return self

    def write(self, frame: VideoFrame, tracked: TrackedFrame, point: TrajectoryPoint) -> bool:
        """Whether the frame was drawn."""
        if not self._writer:
            return False
        self._first_s = frame.time_s if self._first_s is None else self._first_s
        picture = draw_frame(frame.rgb(), tracked, point)[: self._writer.height, : self._writer.width]
        try:
            self._writer.write(picture, frame.time_s - self._first_s)
        except VideoError as error:
            self._writer.__exit__(type(error), error, error.__traceback__)
            self._writer, self.undrawn = None, str(error)
        return True

    def __exit__(self, *failed: Any) -> None:
        try:
            if self._writer:
                self._writer.__exit__(*failed)
        except VideoError as error:
            self.undrawn = str(error)


def track_video(
    source: Source,
    finder: Finder,  # of the first frame, on maps or on a scan
    *,
    camera: Camera | None = None,  # of upright frames of any size; None: of the first frame that is found
    request: LocaliseRequest | None = None,  # what else is known of the first frame
    overlay: Path | None = None,  # an mp4 to be written
    options: TrackVideoOptions | None = None,
) -> TrackedVideo:
    """Track every frame of a film.

    The overlay shows frames as they were known when they were shown; the trajectory has those that were found
    a little later, too.

    Raises:
        VideoError: the film cannot be read at all, or has no frames; the overlay cannot be begun. Where it
            breaks off, or is stopped by Ctrl-C, what was tracked until then is the result.
        InvalidValueError: the camera is of another shape than the film.
    """
    options = options or TrackVideoOptions()
    points: list[TrajectoryPoint] = []
    trouble: list[str] = []
    clock = StageClock()
    threads = cv2.getNumThreads()
    # Flow of a few hundred points gains nothing by a second thread; the keyframes have that core.
    cv2.setNumThreads(1)
    try:
        with ExitStack() as stack:
            video = stack.enter_context(open_video(source, options))
            info = video.info
            lens = None if camera is None else camera.scaled_to(info.frame_width, info.frame_height)
            request = _with_film(request or LocaliseRequest(), info, source)
            tracker = stack.enter_context(Tracker(finder, lens, options.track, request))
            drawn = stack.enter_context(_Overlay(overlay, info))
            frames = stack.enter_context(closing(read_ahead(video, lambda: not tracker.busy)))
            clock.lap("tracking")
            for frame in until_it_ends(frames, trouble):
                clock.lap("waiting")
                tracked = tracker.track(frame.gray, frame.time_s, frame.camera_key)
                point = point_of(tracked)
                points.append(point)
                _filled(points, tracker.late)
                clock.lap("tracking")
                if drawn.write(frame, tracked, point):
                    clock.lap("drawing")
            if not points:
                raise info.no_frames()
            _filled(points, tracker.finish())
            complaints = (*trouble, *video.report.complaints())
            lens = tracker.camera
    finally:
        cv2.setNumThreads(threads)
    clock.lap("tracking")
    seconds = clock.seconds
    return TrackedVideo(
        trajectory=Trajectory(source=info.name, points=tuple(points), start=info.creation_time),
        camera=lens,
        seconds={
            "total": sum(seconds.values()),
            "waiting": seconds.get("waiting", 0.0),
            "tracking": seconds["tracking"],
            "drawing": seconds.get("drawing", 0.0),
        },
        complaints=complaints,
        stopped=STOPPED in trouble and not info.live,
        undrawn=drawn.undrawn,
    )


def _filled(points: list[TrajectoryPoint], late: Sequence[TrackedFrame]) -> None:
    """Lost points whose poses were found since; the last one then goes on from them."""
    first = points[-1].index - len(points) + 1
    for frame in late:
        row = frame.index - first
        if points[row].found:
            continue
        points[row] = point_of(frame)
        if points[row].found:
            goes_on = row > 0 and points[row - 1].found
            points[row] = replace(points[row], state="tracking" if goes_on else "relocalised")
    if late and points[-1].state == "relocalised" and len(points) > 1 and points[-2].found:
        points[-1] = replace(points[-1], state="tracking")


def _with_film(request: LocaliseRequest, info: VideoInfo, source: Source) -> LocaliseRequest:
    """What is known of the frames, with what the film says of its camera where nothing else was said.

    Maps know a film that does not name its camera by the file's digest.
    """
    if request.camera_key is not None or request.exif_focal_px is not None:
        return request
    focal_px = None if info.focal_px is None else info.focal_px * info.frame_width / info.width
    named = bool(info.camera_key or info.make or info.model)
    file = Path(source) if isinstance(source, str | Path) and not named else None
    film = unnamed_model(file_sha256(file)) if file is not None and file.is_file() else None
    return replace(request, camera_key=info.camera_key or None, film=film, exif_focal_px=focal_px)
