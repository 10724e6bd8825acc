"""The pose of every frame of a video: flow between frames, keyframes against the ground in the background."""

import sys
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from reloc.localise.result import LocaliseRequest
from reloc.tracking.flow_track import FlowTrack, RecentFrame, RecentFrames
from reloc.tracking.ground import Finder, Keyframe, TrackedFrame, Unmatched
from reloc.tracking.options import TrackOptions
from reloc.tracking.pose_fit import FittedPose, LensWalk
from reloc.wire.track import TrackState

Answer = Keyframe | Unmatched
_FAR = sys.maxsize


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sent:
    """What the thread has in hand: its frame, and the frame or the film's time at which it is waited for."""

    index: int
    answer: "Future[Answer]"
    due: int
    due_s: float


@dataclass(slots=True, kw_only=True, eq=False)
class _Catching:
    """A track from a localised frame on its way to the frame at hand: where it is, and its pose there."""

    track: FlowTrack
    at: RecentFrame
    fitted: FittedPose
    state: TrackState


class Tracker:
    """Follows one video. Frames come in order; a context manager, since keyframes have a thread.

    The same frames give the same poses: what the thread answers is taken at a frame that is known beforehand.
    With `TrackOptions.live` no frame waits for the thread instead.
    """

    def __init__(
        self,
        finder: Finder,  # of the first frame, and of the track again where it was lost
        camera: Camera | None = None,
        options: TrackOptions | None = None,
        request: LocaliseRequest | None = None,  # what else is known of the first frame
    ) -> None:
        """Without a camera it is estimated with the poses, and anew where the track was lost."""
        self._finder, self._options = finder, options or TrackOptions()
        self._request = replace(request or LocaliseRequest(), camera=camera)
        self._given = self._camera = camera
        self._found = False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="keyframes")
        self._track: FlowTrack | None = None
        self._frames = RecentFrames(_frames_kept(self._options))
        # Earlier frames, said to be lost then, whose poses the last call of `track` has found: from a
        # localised frame on, which is answered some frames later, and before it, back to a cut.
        self.late: list[TrackedFrame] = []
        self._sent: _Sent | None = None
        self._catching: _Catching | None = None
        self._next_keyframe, self._next_keyframe_s = 0, float("inf")
        self._unconfirmed = 0  # keyframes in a row of which the ground knew nothing
        self._index = self._posed = -1  # the last frame, and the last that has a pose
        self._why = "nothing was localised yet"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def camera(self) -> Camera | None:
        """Intrinsics in use, or of the last frame with a pose; None until something was localised."""
        return self._camera if self._track is None else self._track.camera

    def track(self, gray: NDArray[np.uint8], time_s: float, camera_key: str = "") -> TrackedFrame:
        """The pose of the next frame (h, w) uint8, taken at `time_s`, later than the last one.

        `camera_key`: where it has another camera than the film.
        """
        self._index += 1
        before = self._frames.last
        now = RecentFrame(index=self._index, time_s=time_s, gray=gray, camera_key=camera_key)
        self._frames.add(now, self._needed_from())
        self.late = []
        fitted = None
        state: TrackState = "tracking"
        if before is not None and self._track is not None:
            fitted = self._track.follow(before, now)
            if fitted is None:
                self._lost(f"LOST: {self._track.why}")
        elif self._catching is not None:
            fitted, state = self._caught_up_by(self._options.catch_up), "relocalised"
        sent = self._due(now)
        answered = None if sent is None else sent.answer.result()
        if isinstance(answered, Unmatched):
            self._unconfirmed += 1
            if fitted is None or self._unconfirmed >= self._options.max_unconfirmed:
                fitted = None
                self._lost(f"{answered.reason}: {answered.detail}")
        elif sent is not None and answered is not None:
            found = self._taken(answered, sent.index)
            if found is not None:
                state = "tracking" if fitted is not None else "relocalised"
                fitted = found
                self._unconfirmed = 0
        if fitted is None or self._track is None:
            if self._catching is None:
                self._search(now)
            return TrackedFrame(index=self._index, time_s=time_s, state="lost", detail=self._why)
        self._send_keyframe(now, fitted, self._track)
        return self._known(now, state, fitted, self._track)

    @property
    def busy(self) -> bool:
        """Whether the thread of the keyframes has one in hand."""
        return self._sent is not None and not self._sent.answer.done()

    def use(self, finder: Finder) -> None:
        """Track by this finder's ground from the next frame on.

        A track on ground that it still has goes on; another is lost, and looked for anew, since its map may
        have been moved or taken back.
        """
        self._finder = finder
        track = self._catching.track if self._catching is not None else self._track
        if track is not None and finder.has(track.ground):
            return
        if track is not None:
            self._lost("LOST: the maps have changed")
        self._sent = None

    def finish(self) -> Sequence[TrackedFrame]:
        """After the last frame: poses of those before it that a frame still being looked for has found.

        Or why that frame is lost, which was not known when it came.
        """
        sent, self._sent, followed = self._sent, None, self._track
        if self._options.live or followed is not None:
            return ()
        self.late = []
        last, fitted = self._frames.last, None
        if sent is not None and last is not None:
            answered = sent.answer.result()
            if isinstance(answered, Unmatched):
                self._lost(f"{answered.reason}: {answered.detail}")
                self.late = [
                    TrackedFrame(index=last.index, time_s=last.time_s, state="lost", detail=self._why)
                ]
            else:
                fitted = self._taken(answered, sent.index)
        if self._catching is not None:
            fitted = self._caught_up_by(_FAR)
        if fitted is not None and self._track is not None and last is not None:
            state: TrackState = "tracking" if self.late else "relocalised"
            self.late.append(self._known(last, state, fitted, self._track))
        return self.late

    def _known(
        self, frame: RecentFrame, state: TrackState, fitted: FittedPose, track: FlowTrack
    ) -> TrackedFrame:
        self._posed = max(self._posed, frame.index)
        return TrackedFrame(
            index=frame.index,
            time_s=frame.time_s,
            state=state,
            cam_from_local=fitted.cam_from_local,
            covariance=fitted.covariance,
            camera=track.camera,
            ground=track.ground,
            inliers=len(track.landmarks),
            pixels=track.landmarks.pixels,
            rows=track.landmarks.rows,
        )

    def _lost(self, why: str) -> None:
        self._camera = self.camera
        self._track, self._catching, self._why = None, None, why

    def _needed_from(self) -> int | None:
        """Number of the first frame that is still needed: before one that is looked for, the others, too."""
        if self._catching is not None:
            return self._catching.at.index
        if self._sent is None:
            return None
        searched = self._track is None and not self._options.live
        return self._sent.index - (self._options.earlier if searched else 0)

    def _due(self, now: RecentFrame) -> _Sent | None:
        """What the thread has answered: at the frame at which it is due; live: as soon as it is there."""
        sent = self._sent
        if sent is None:
            return None
        due = now.index >= sent.due or now.time_s >= sent.due_s
        if not (sent.answer.done() if self._options.live else due):
            return None
        self._sent = None
        return sent

    def _taken(self, found: Keyframe, index: int) -> FittedPose | None:
        """The pose of the frame at hand by what was found of frame `index`; None: it says nothing of it.

        A track that is lost begins again at what was found.
        """
        since, track = self._frames.since(index), self._track
        if not since:
            return None
        if track is not None:
            return track.refresh(found, since[0], since[-1]) if found.ground is track.ground else None
        self._found, self._unconfirmed = True, 0
        begun = self._begun(found, since[0])
        fitted = begun.settle()
        if fitted is None:
            self._why = f"LOST: {begun.why}"
            return None
        earlier = [] if self._options.live else self._earlier(found, since[0])
        self.late.extend(earlier)
        state: TrackState = "tracking" if earlier else "relocalised"
        self._catching = _Catching(track=begun, at=since[0], fitted=fitted, state=state)
        return self._caught_up_by(self._options.catch_up)

    def _earlier(self, found: Keyframe, frame: RecentFrame) -> list[TrackedFrame]:
        """Frames just before one that was localised, followed backwards to a cut or to the last pose."""
        track, last = self._begun(found, frame), frame
        unknown = [f for f in self._frames.before(frame.index) if f.index > self._posed]
        earlier: list[TrackedFrame] = []
        for before in unknown if track.settle() is not None else []:
            fitted = track.follow(last, before)
            if fitted is None:
                break
            earlier.append(self._known(before, "tracking", fitted, track))
            last = before
        if earlier:
            earlier[-1] = replace(earlier[-1], state="relocalised")
        return earlier[::-1]

    def _begun(self, found: Keyframe, frame: RecentFrame) -> FlowTrack:
        """A track from a localised frame on, with a lens that is followed where nobody gave it."""
        options = self._options
        if self._given is not None:
            return FlowTrack(found, frame, self._given, options)
        self._camera = found.camera
        lens = LensWalk.begun(found.camera, lent=found.camera_source == "map")
        return FlowTrack(found, frame, found.camera, options, lens)

    def _caught_up_by(self, most: int) -> FittedPose | None:
        """Carry the track that was found through `most` more frames; the pose if that is all there are.

        Where it breaks, the frames before have their poses all the same.
        """
        catching = self._catching
        assert catching is not None
        for before, after in pairwise(self._frames.since(catching.at.index)[: most + 1]):
            self.late.append(self._known(before, catching.state, catching.fitted, catching.track))
            followed = catching.track.follow(before, after)
            if followed is None:
                self._lost(f"LOST: {catching.track.why}")
                return None
            catching.at, catching.fitted, catching.state = after, followed, "tracking"
        if catching.at is not self._frames.last:
            return None
        self._track, self._catching = catching.track, None
        return catching.fitted

    def _search(self, now: RecentFrame) -> None:
        """Have this frame localised, if the thread is free."""
        if self._sent is not None:
            return
        options = self._options
        answer = self._pool.submit(self._finder.find, now.gray.copy(), self._request_of(now), options)
        due, due_s = now.index + options.lost_answer_after, now.time_s + options.lost_answer_after_s
        self._sent = _Sent(index=now.index, answer=answer, due=due, due_s=due_s)

    def _send_keyframe(self, now: RecentFrame, fitted: FittedPose, track: FlowTrack) -> None:
        """Have this frame matched against the ground, if it is time for a keyframe and the thread is free."""
        options = self._options
        if self._sent is not None:
            return
        few = len(track.landmarks) < options.few_landmarks * options.landmarks
        early = options.keyframe_every - min(options.keyframe_soonest, options.keyframe_every)
        in_frames = now.index >= self._next_keyframe - (early if few else 0)
        if not in_frames and now.time_s < self._next_keyframe_s:
            return
        if few:
            options = replace(options, keyframes=options.fine_keyframes)
        answer = self._pool.submit(
            track.ground.match, now.gray.copy(), track.camera, fitted.cam_from_local, options
        )
        due, due_s = now.index + options.answer_after, now.time_s + options.answer_after_s
        self._sent = _Sent(index=now.index, answer=answer, due=due, due_s=due_s)
        self._next_keyframe = now.index + options.keyframe_every
        self._next_keyframe_s = now.time_s + options.keyframe_every_s

    def _request_of(self, frame: RecentFrame) -> LocaliseRequest:
        asked = self._request
        if frame.camera_key:
            asked = replace(asked, camera_key=frame.camera_key)
        if not self._found:
            return asked
        # What was known of the first frame is not known of one after a loss.
        asked = replace(asked, camera=self._given, prior=None)
        if self._camera is None or asked.exif_focal_px is not None:
            return asked
        return replace(asked, exif_focal_px=self._camera.focal_px)


def _frames_kept(options: TrackOptions) -> int:
    """Frames before and since the one that the thread has, and those that come while a track catches up."""
    if options.live:
        return options.live_frames
    meanwhile = -(-options.lost_answer_after // (options.catch_up - 1))
    return 2 + max(options.answer_after, options.earlier + options.lost_answer_after + meanwhile)
