"""A whole video: frames in, a trajectory out, and a film with the track drawn over it on request."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2

from featuredb.errors import VideoError
from featuredb.features.film_lens import unnamed_model
from featuredb.file_digest import file_sha256
from featuredb.geometry.camera import Camera
from featuredb.stage_clock import StageClock
from featuredb.video.ahead import ReadAhead
from featuredb.video.film import VideoInfo, VideoOptions
from featuredb.video.frames import Source, open_video
from featuredb.video.writer import VideoWriter, VideoWriterOptions
from reloc.localise.result import LocaliseRequest
from reloc.tracking.film_end import until_it_ends
from reloc.tracking.film_overlay import draw_frame
from reloc.tracking.ground import Finder
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracked_frame import TrackedFrame
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint, point_of

# Frames that one core decodes while the other tracks one, when no keyframe is in hand: some are left over.
_READ_ON = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackVideoOptions:
    """How a video is tracked.

    Attributes:
        max_side_px: frames are made smaller for tracking; flow costs as their area, and 1280 pixels tell a
            pose to centimetres at the distances of drones. The overlay is of this size, too.
        start_s, end_s: the stretch of the film; None: all of it.
        fps: frames per second of a folder of pictures without a file of times.
        track: the tracker's settings.
    """

    max_side_px: int = 1280
    start_s: float | None = None
    end_s: float | None = None
    fps: float | None = None
    track: TrackOptions = field(default_factory=TrackOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedVideo:
    """What came of a video.

    Attributes:
        camera: intrinsics of the frames as they were tracked; None where nothing was localised.
        seconds: where the time went: `total`; of it `tracking` and `drawing`, the rest is waiting for frames;
            `decoding`, also of frames that were decoded beside the tracking; `longest_gap` between the poses
            of two frames.
        complaints: what was wrong with the film, for people.
    """

    trajectory: Trajectory
    camera: Camera | None
    seconds: dict[str, float]
    complaints: tuple[str, ...]


def track_video(
    source: Source,
    finder: Finder,
    *,
    camera: Camera | None = None,
    request: LocaliseRequest | None = None,
    overlay: Path | None = None,
    options: TrackVideoOptions | None = None,
) -> TrackedVideo:
    """Track every frame of a film.

    The overlay shows frames as they were known when they were shown; the trajectory has those that were found
    a little later, too.

    Args:
        finder: finds the first frame, on maps or on a scan.
        camera: intrinsics of the film's frames, upright, of any size; None: of the first frame that is found.
        request: what else is known of the first frame.
        overlay: an mp4 to be written.

    Raises:
        VideoError: the film cannot be read at all, or has no frames; the overlay cannot be written. Where it
            breaks off, or is stopped by Ctrl-C, what was tracked until then is the result.
        InvalidValueError: the camera is of another shape than the film.
    """
    options = options or TrackVideoOptions()
    points: list[TrajectoryPoint] = []
    trouble: list[str] = []
    clock = StageClock()
    last = gap = 0.0
    settings = VideoOptions(
        max_side_px=options.max_side_px, start_s=options.start_s, end_s=options.end_s, fps=options.fps
    )
    threads = cv2.getNumThreads()
    # Flow of a few hundred points gains nothing by a second thread; the keyframes have that core.
    cv2.setNumThreads(1)
    try:
        with ExitStack() as stack:
            video = stack.enter_context(open_video(source, settings))
            info = video.info
            lens = None if camera is None else camera.scaled_to(info.frame_width, info.frame_height)
            request = _with_film(request or LocaliseRequest(), info, source)
            tracker = stack.enter_context(Tracker(finder, lens, options.track, request))
            writer = None
            if overlay is not None:
                writer = stack.enter_context(
                    VideoWriter(
                        overlay,
                        width=info.frame_width // 2 * 2,
                        height=info.frame_height // 2 * 2,
                        fps=None,
                        options=VideoWriterOptions(crf=23, preset="veryfast"),
                    )
                )
            first_s: float | None = None
            ahead = stack.enter_context(ReadAhead(video))
            clock.lap("tracking")
            for frame in until_it_ends(ahead, trouble):
                clock.lap("waiting")
                tracked = tracker.track(frame.gray, frame.time_s)
                point = point_of(tracked)
                points.append(point)
                _filled(points, tracker.late)
                now = time.perf_counter()
                gap, last = (max(gap, now - last) if len(points) > 1 else 0.0), now
                clock.lap("tracking")
                if writer is not None:
                    first_s = frame.time_s if first_s is None else first_s
                    picture = draw_frame(frame.rgb(), tracked, point)
                    writer.write(picture[: writer.height, : writer.width], frame.time_s - first_s)
                    clock.lap("drawing")
                if not tracker.busy:
                    ahead.read_on(_READ_ON)
                clock.lap("tracking")
            if not points:
                raise VideoError(f"{info.name}: no frames in the film, or none in the stretch asked for")
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
            "decoding": ahead.seconds,
            "tracking": seconds["tracking"],
            "drawing": seconds.get("drawing", 0.0),
            "longest_gap": gap,
        },
        complaints=complaints,
    )


def _filled(points: list[TrajectoryPoint], late: Sequence[TrackedFrame]) -> None:
    """Lost points whose poses were found since; the last one then goes on from them."""
    first = points[-1].index - len(points) + 1
    for frame in late:
        row = frame.index - first
        if points[row].found:
            continue
        goes_on = row > 0 and points[row - 1].found
        points[row] = replace(point_of(frame), state="tracking" if goes_on else "relocalised")
    if late and points[-1].state == "relocalised" and len(points) > 1 and points[-2].found:
        points[-1] = replace(points[-1], state="tracking")


def _with_film(request: LocaliseRequest, info: VideoInfo, source: Source) -> LocaliseRequest:
    """What is known of the frames, with what the film says of its camera where nothing else was said."""
    if request.camera_key is not None or request.exif_focal_px is not None:
        return request
    focal_px = None if info.focal_px is None else info.focal_px * info.frame_width / info.width
    named = bool(info.camera_key or info.make or info.model)
    film = None if named or not isinstance(source, str | Path) else _digest(Path(source))
    return replace(request, camera_key=info.camera_key or None, film=film, exif_focal_px=focal_px)


def _digest(film: Path) -> str | None:
    """By which maps of a film know it; None for what is no file."""
    return unnamed_model(file_sha256(film)) if film.is_file() else None
