"""A film or a camera streamed to a live session, at its own speed."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from featuredb.errors import ServiceError, VideoError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoOptions
from featuredb.video.frames import open_video
from featuredb.video.opening import Source
from reloc.answered_view import geopose_of
from reloc.client.client import Client
from reloc.client.live import LiveTrack
from reloc.tracking.film_end import STOPPED, until_it_ends
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from reloc.wire.query import CameraRequest, PriorRequest
from reloc.wire.track import TrackPose

OnPose = Callable[[TrackPose, float | None], None]

SENT_SIDE_PX = 1280  # frames are made smaller before they are sent; a server tracks no larger ones by default
_JPEG_QUALITY = 80
# A frame of a file that is later than this against the film's clock is not sent: this machine is too slow,
# and a live source would have gone on.
_MAX_LATE_S = 0.1
_LAST_WAIT_S = 2.0  # for the pose of the last frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamedFilm:
    """What came of a stream."""

    trajectory: Trajectory  # the frames that were answered
    frames: int  # of the film
    sent: int  # of them
    latency_ms: FloatArray  # (n,) from sending a frame to its pose, of the answered ones
    refusals: tuple[str, ...]  # why frames could not be used, the latest
    complaints: tuple[str, ...]  # what was wrong with the film
    stopped: bool  # by hand, before the end of a film that has one
    lost: str  # why the session ended before the film; empty where it did not


class _Answers:
    """Poses so far, taken as they come by a thread: a camera's next frame does not hold them up."""

    def __init__(self, live: LiveTrack, on_pose: OnPose | None, pool: ThreadPoolExecutor) -> None:
        self._live, self._on_pose = live, on_pose
        self.points: list[TrajectoryPoint] = []
        self.latency_ms: list[float] = []
        self._changed = threading.Condition()
        self._taking = pool.submit(self._take_all)  # ends with the session
        self._taking.add_done_callback(self._tell)

    def check(self) -> None:
        """Raise what has ended the thread before its time."""
        if self._taking.done():
            self._taking.result()

    def await_frame(self, index: int) -> None:
        """Wait for the pose of the frame that was sent last, -1: none; the server never drops it."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._taking.done() or index < 0 or (self.points and self.points[-1].index >= index),
                _LAST_WAIT_S,
            )
        self.check()

    def _take_all(self) -> None:
        for pose in self._live:
            latency_ms = self._live.latency_ms(pose.sequence)
            if self._on_pose is not None:
                self._on_pose(pose, latency_ms)
            if latency_ms is not None:
                self.latency_ms.append(latency_ms)
            self.points.append(point_of_message(pose))
            self._tell()

    def _tell(self, *_: object) -> None:
        with self._changed:
            self._changed.notify_all()


def point_of_message(message: TrackPose) -> TrajectoryPoint:
    """A message's frame as a point of a trajectory."""
    utm, pose = message.utm, None
    if utm is not None:
        pose = EarthPose(
            epsg=utm.epsg,
            utm=np.array([utm.easting, utm.northing, utm.height]),
            height_datum=message.height_datum or "unknown",
            cam_from_utm_xyzw=np.array(utm.cam_from_utm_xyzw),
            geopose=geopose_of(message),
            covariance=np.array(message.covariance),
            map_id=message.map_id or "",
        )
    same = {name: getattr(message, name) for name in ("time_s", "state", "inliers", "detail")}
    return TrajectoryPoint(index=message.sequence, pose=pose, **same)


def stream_film(
    client: Client,
    source: Source,
    *,
    camera: CameraRequest | None = None,  # of the film's frames, of any size; None: estimated
    prior: PriorRequest | None = None,  # where the film begins
    options: VideoOptions | None = None,
    on_pose: OnPose | None = None,  # told each pose, and how many ms it took, in a thread of its own
) -> StreamedFilm:
    """Send the frames of a film when they are due, those of a camera as they come, and collect the poses.

    Ctrl-C ends the stream, and what came until then is the result; so does the end of the session.

    Raises:
        VideoError: the film cannot be read at all, or has no frames.
        ServiceError: no session could be opened.
    """
    options = options or VideoOptions(max_side_px=SENT_SIDE_PX)
    trouble: list[str] = []
    lost = ""
    sent, last, last_sent = 0, -1, -1
    with (
        open_video(source, options) as video,
        ThreadPoolExecutor(1, "poses") as pool,
        client.track(camera, prior) as live,
    ):
        answers, info = _Answers(live, on_pose, pool), video.info
        begun: float | None = None
        try:
            for frame in until_it_ends(video, trouble):
                last = frame.index
                now = time.perf_counter()
                begun = now - frame.time_s if begun is None else begun
                due = now if info.live else begun + frame.time_s
                time.sleep(max(0.0, due - time.perf_counter()))
                answers.check()
                if time.perf_counter() - due <= _MAX_LATE_S:
                    jpeg = cv2.imencode(".jpg", frame.gray, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
                    live.send(jpeg.tobytes(), frame.time_s, frame.index)
                    sent, last_sent = sent + 1, frame.index
            answers.await_frame(last_sent)
        except ServiceError as error:
            lost = f"the session ended: {error}"
        refusals = tuple(f"frame {event.sequence}: {event.message}" for event in live.refusals)
        complaints = (*trouble, *video.report.complaints())
    if last < 0:
        raise VideoError(f"{info.name}: no frames in the film, or none in the stretch asked for")
    return StreamedFilm(
        trajectory=Trajectory(source=info.name, points=tuple(answers.points), start=info.creation_time),
        frames=last + 1,
        sent=sent,
        latency_ms=np.array(answers.latency_ms),
        refusals=refusals,
        complaints=complaints,
        stopped=STOPPED in trouble and not info.live,
        lost=lost,
    )
