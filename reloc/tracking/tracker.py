"""The pose of every frame of a video: flow between frames, keyframes against the map in the background."""

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from types import TracebackType
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from reloc.candidates import IndexedArea
from reloc.result import LocaliseRequest
from reloc.tracking.flow import follow
from reloc.tracking.keyframe import Keyframe, Unmatched, find_frame, match_keyframe
from reloc.tracking.landmarks import Landmarks
from reloc.tracking.options import TrackOptions
from reloc.tracking.pose_fit import FittedPose, fit_pose
from reloc.tracking.recent import RecentFrame, RecentFrames

TrackState = Literal["tracking", "relocalised", "lost"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFrame:
    """What is known of one frame.

    Attributes:
        index, time_s: of the frame.
        state: tracking; relocalised, on the first frame after the track was lost or begun; lost: no pose.
        cam_from_local: pose in the area's frame, None where the track is lost.
        covariance: (6, 6), see `FittedPose`; None with the pose.
        camera: intrinsics in use; None with the pose. area: in whose frame the pose is.
        inliers: landmarks that agree with it. pixels, points: (k, 2), (k, 3) of them; rows: (k,) of the
            area's points.
        detail: why there is no pose.
    """

    index: int
    time_s: float
    state: TrackState
    cam_from_local: Rigid3 | None = None
    covariance: FloatArray | None = None
    camera: Camera | None = None
    area: Area | None = None
    inliers: int = 0
    pixels: FloatArray | None = None
    points: FloatArray | None = None
    rows: NDArray[np.int64] | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sent:
    """A keyframe that is being matched: its number, and the frame at which the answer is waited for."""

    index: int
    due: int
    answer: "Future[Keyframe | Unmatched]"


class Tracker:
    """Follows one video. Frames come in order; a context manager, since keyframes have a thread.

    The same frames give the same poses: what the thread answers is taken at a frame that is known beforehand.
    With `TrackOptions.live` no frame waits for the thread instead.
    """

    def __init__(
        self,
        areas: Sequence[IndexedArea],
        camera: Camera | None = None,
        options: TrackOptions | None = None,
        request: LocaliseRequest | None = None,
    ) -> None:
        """
        Args:
            camera: intrinsics of the frames; None: those of the first frame that is localised.
            request: what else is known of the first frame.
        """
        self._areas, self._options = tuple(areas), options or TrackOptions()
        self._request = replace(request or LocaliseRequest(), camera=camera)
        self._camera = camera
        self._found = False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="keyframes")
        self._area: Area | None = None
        self._landmarks = Landmarks.none()
        self._poses: deque[tuple[float, Rigid3]] = deque(maxlen=2)
        self._frames = RecentFrames(1 + max(self._options.answer_after, self._options.lost_answer_after))
        self._late: list[TrackedFrame] = []
        self._sent: _Sent | None = None
        self._next_keyframe = 0
        self._unconfirmed = 0  # keyframes in a row of which the map knew nothing
        self._index = -1
        self._why = "nothing was localised yet"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def camera(self) -> Camera | None:
        """Intrinsics in use; None until something was localised."""
        return self._camera

    @property
    def area(self) -> Area | None:
        """The area in whose frame the poses are; None until something was localised."""
        return self._area

    def track(self, gray: NDArray[np.uint8], time_s: float) -> TrackedFrame:
        """The pose of the next frame (h, w) uint8, taken at `time_s`, later than the last one."""
        self._index += 1
        before = self._frames.last
        now = RecentFrame(index=self._index, time_s=time_s, gray=gray)
        self._frames.add(now, None if self._sent is None else self._sent.index)
        self._late = []
        fitted = self._followed(before, now) if before is not None and len(self._landmarks) else None
        if fitted is not None:
            self._poses.append((time_s, fitted.cam_from_local))
        answered = self._answer()
        state: TrackState = "tracking"
        if isinstance(answered, Keyframe):
            found = self._taken(answered, gray, fitted)
            if found is not None:
                state = "tracking" if fitted is not None else "relocalised"
                fitted = found
                self._poses[-1] = (time_s, fitted.cam_from_local)
                self._unconfirmed = 0
        elif isinstance(answered, Unmatched):
            self._unconfirmed += 1
            if fitted is None or self._unconfirmed >= self._options.max_unconfirmed:
                self._why, fitted = f"{answered.reason}: {answered.detail}", None
        if answered is not None:
            self._sent = None
        self._send(gray, fitted)
        if fitted is None:
            self._landmarks = Landmarks.none()
            self._poses.clear()
            return TrackedFrame(index=self._index, time_s=time_s, state="lost", detail=self._why)
        return self._known(now, state, fitted)

    def use_areas(self, areas: Sequence[IndexedArea]) -> None:
        """Track by these areas from the next frame on.

        A track in an area that is still among them goes on; another is lost, and looked for anew, since its
        map may have been moved or taken back.
        """
        self._areas = tuple(areas)
        if len(self._landmarks) and any(area.area is self._area for area in self._areas):
            return
        if len(self._landmarks):
            self._why = "LOST: the maps have changed"
        self._landmarks = Landmarks.none()
        self._poses.clear()
        self._area, self._sent = None, None

    @property
    def late(self) -> Sequence[TrackedFrame]:
        """Earlier frames, said to be lost then, whose poses the last call of `track` has found.

        A localised frame is answered some frames later; from it on, the frames between are tracked, too.
        """
        return tuple(self._late)

    def finish(self) -> Sequence[TrackedFrame]:
        """After the last frame: poses of those before it that a frame still being looked for has found."""
        if self._sent is None or len(self._landmarks):
            return ()
        answered = self._sent.answer.result()
        if not isinstance(answered, Keyframe):
            return ()
        self._late = []
        last = self._frames.last
        assert last is not None
        found = self._taken(answered, last.gray, None)
        self._sent = None
        if found is not None:
            self._late.append(self._known(last, "tracking" if self._late else "relocalised", found))
        return tuple(self._late)

    def _known(self, frame: RecentFrame, state: TrackState, fitted: FittedPose) -> TrackedFrame:
        return TrackedFrame(
            index=frame.index,
            time_s=frame.time_s,
            state=state,
            cam_from_local=fitted.cam_from_local,
            covariance=fitted.covariance,
            camera=self._camera,
            area=self._area,
            inliers=len(self._landmarks),
            pixels=self._landmarks.pixels,
            points=self._landmarks.points,
            rows=self._landmarks.rows,
        )

    def _followed(self, before: RecentFrame, now: RecentFrame) -> FittedPose | None:
        """The landmarks in this frame, and the pose that they give; those that disagree are dropped."""
        assert self._camera is not None
        marks = self._landmarks
        last = self._poses[-1][1]
        predicted = self._predicted(now.time_s)
        step = self._camera.project(predicted.act(marks.points)) - self._camera.project(
            last.act(marks.points)
        )
        guess = marks.pixels + np.where(np.isfinite(step), step, 0.0)
        pixels, good = follow(before.gray, now.gray, marks.pixels, guess, self._options.flow)
        return self._agreed(replace(marks, pixels=pixels), good, predicted)

    def _agreed(
        self, marks: Landmarks, good: NDArray[np.bool_] | None, predicted: Rigid3
    ) -> FittedPose | None:
        """The pose of the landmarks that were followed (None: all); what agrees with it stays."""
        assert self._camera is not None
        options, followed = self._options, marks if good is None else marks.take(np.flatnonzero(good))
        if len(followed) < options.min_landmarks:
            self._why = f"LOST: {len(followed)} of {len(marks)} landmarks are found again"
            return None
        fitted = fit_pose(self._camera, followed.pixels, followed.points, predicted, options.fit)
        agree = 0 if fitted is None else int(fitted.inlier.sum())
        if fitted is None or agree < max(options.min_landmarks, options.least_share * len(followed)):
            self._why = f"LOST: {agree} of {len(followed)} landmarks agree with a pose"
            return None
        self._landmarks = followed.take(fitted.inlier)
        return fitted

    def _predicted(self, time_s: float) -> Rigid3:
        """The last pose, moved on as it moved before."""
        if len(self._poses) < 2:
            return self._poses[-1][1]
        (first_s, first), (second_s, second) = self._poses
        share = (time_s - second_s) / max(second_s - first_s, 1e-9)
        return Rigid3.exp(min(share, 3.0) * (second @ first.inverse()).log()) @ second

    def _answer(self) -> Keyframe | Unmatched | None:
        """What became of a keyframe: at the frame at which it is due; live: as soon as it is there."""
        if self._sent is None:
            return None
        ready = self._sent.answer.done() if self._options.live else self._index >= self._sent.due
        return self._sent.answer.result() if ready else None

    def _taken(
        self, keyframe: Keyframe, gray: NDArray[np.uint8], fitted: FittedPose | None
    ) -> FittedPose | None:
        """Landmarks of a keyframe carried into this frame, and the pose with them.

        While the track holds, the guess where they are now is the track's; else they are looked for where the
        keyframe had them.
        """
        assert self._sent is not None
        sent = self._sent
        since = self._frames.since(sent.index)
        if not since or (fitted is not None and keyframe.area is not self._area):
            return None
        before = since[0]
        self._area = keyframe.area
        self._camera = self._camera or keyframe.camera
        self._found = True
        points = keyframe.area.points[keyframe.rows]
        # A point may be seen by two keypoints; it is followed once.
        _, first = np.unique(keyframe.rows, return_index=True)
        fresh = Landmarks(
            rows=keyframe.rows[first],
            points=points[first],
            pixels=keyframe.pixels[first],
            born=np.full(len(first), sent.index, dtype=np.int64),
        )
        if fitted is None:
            return self._begun(fresh, keyframe.cam_from_local, since)
        pose, options = fitted.cam_from_local, self._options
        step = self._camera.project(pose.act(fresh.points)) - self._camera.project(
            keyframe.cam_from_local.act(fresh.points)
        )
        usable = np.flatnonzero(np.isfinite(step).all(axis=1))
        fresh = fresh.take(usable)
        pixels, good = follow(before.gray, gray, fresh.pixels, fresh.pixels + step[usable], options.flow)
        everything = self._landmarks.joined(replace(fresh, pixels=pixels).take(np.flatnonzero(good)))
        return self._agreed(self._spread(everything, gray), None, pose)

    def _begun(self, fresh: Landmarks, pose: Rigid3, since: Sequence[RecentFrame]) -> FittedPose | None:
        """The track from a localised frame, the first of `since`, to the one at hand, frame by frame.

        Where it breaks, the frames before have their poses all the same. Live, some frames are passed over.
        """
        first = since[0]
        self._landmarks = self._spread(fresh, first.gray)
        self._poses.clear()
        self._poses.append((first.time_s, pose))
        fitted = self._agreed(self._landmarks, None, pose)
        state: TrackState = "relocalised"
        for before, after in pairwise(self._catching_up(since)):
            if fitted is None:
                return None
            self._poses[-1] = (before.time_s, fitted.cam_from_local)
            self._late.append(self._known(before, state, fitted))
            state = "tracking"
            fitted = self._followed(before, after)
            if fitted is not None:
                self._poses.append((after.time_s, fitted.cam_from_local))
        return fitted

    def _catching_up(self, since: Sequence[RecentFrame]) -> Sequence[RecentFrame]:
        """The frames by which a track comes to the one at hand: all; live, so few that it is soon there."""
        steps = len(since) - 1
        if not self._options.live or steps <= self._options.live_steps:
            return since
        rows = np.linspace(0, steps, self._options.live_steps + 1).round().astype(np.int64)
        return [since[row] for row in rows]

    def _spread(self, marks: Landmarks, gray: NDArray[np.uint8]) -> Landmarks:
        options = self._options
        return marks.spread(options.landmarks, options.columns, options.rows, gray.shape[1], gray.shape[0])

    def _send(self, gray: NDArray[np.uint8], fitted: FittedPose | None) -> None:
        """Hand this frame to the thread if it is time for a keyframe and the thread is free."""
        options = self._options
        if self._sent is not None:
            return
        if fitted is None:
            answer = self._pool.submit(find_frame, gray.copy(), self._request_now(), self._areas, options)
            self._sent = _Sent(index=self._index, due=self._index + options.lost_answer_after, answer=answer)
            return
        few = len(self._landmarks) < options.few_landmarks * options.landmarks
        early = options.keyframe_every - min(options.keyframe_soonest, options.keyframe_every)
        if self._index < self._next_keyframe - (early if few else 0):
            return
        assert self._camera is not None
        assert self._area is not None
        answer = self._pool.submit(
            match_keyframe, gray.copy(), self._camera, fitted.cam_from_local, self._area, options
        )
        self._sent = _Sent(index=self._index, due=self._index + options.answer_after, answer=answer)
        self._next_keyframe = self._index + options.keyframe_every

    def _request_now(self) -> LocaliseRequest:
        if not self._found:
            return self._request
        # What was known of the first frame is not known of one after a loss.
        return replace(self._request, camera=self._camera, prior=None)
