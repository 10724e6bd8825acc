"""A track: known points carried by sparse optical flow through the frames that are kept, and their poses."""

from collections import deque
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray, joined
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.tracking.ground import Keyframe
from reloc.tracking.options import FlowOptions, TrackOptions
from reloc.tracking.pose_fit import FittedPose, LensWalk, fit_pose

_HALF_PX = 0.5  # OpenCV's pixel (0, 0) is a centre, ours a corner


def follow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    pixels: FloatArray,
    guess: FloatArray,
    options: FlowOptions,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where patches around pixels (n, 2) of one frame (h, w) lie in another, about at the guess (n, 2).

    Returns:
        Pixels (n, 2) float64, and which (n,) of them are to be trusted.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
    height, width = before.shape
    enlarged = max(width, height) / options.reference_side_px
    window = max(2 * round(0.5 * (options.window_px * enlarged - 1.0)) + 1, 5)  # odd
    settings: dict[str, Any] = {
        "winSize": (window, window),
        "maxLevel": options.levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, options.iterations, 0.01),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-4,
    }
    start = (pixels - _HALF_PX).astype(np.float32)
    aimed = (guess - _HALF_PX).astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, aimed.copy(), **settings)
    # The way back starts from as far off as the way there did.
    back_guess = there + (start - aimed)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, back_guess, **settings)
    good = (found.reshape(-1) == 1) & (found_back.reshape(-1) == 1)
    good &= np.linalg.norm(back - start, axis=1) < options.max_back_px * enlarged
    result = there.astype(np.float64) + _HALF_PX
    inside = (result >= 0).all(axis=1) & (result[:, 0] < width) & (result[:, 1] < height)
    return result, np.asarray(good & inside)


_INSTANT_S = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecentFrame:
    """A frame: its number, its time on the film's clock, and its grey values (h, w) uint8.

    `camera_key`: where it has another camera than the film.
    """

    index: int
    time_s: float
    gray: NDArray[np.uint8]
    camera_key: str = ""


class RecentFrames:
    """A bounded memory of frames.

    However long an answer takes, its keyframe stays, and the frames since then get sparser, evenly.
    """

    def __init__(self, capacity: int) -> None:
        """`capacity`: frames that are kept at most, at least 3."""
        self._capacity = max(capacity, 3)
        self._frames: list[RecentFrame] = []

    @property
    def last(self) -> RecentFrame | None:
        """The frame that was added last."""
        return self._frames[-1] if self._frames else None

    def add(self, frame: RecentFrame, keep_from: int | None) -> None:
        """Keep this frame, and of the others those from number `keep_from` on (None: none of them)."""
        kept = [] if keep_from is None else [f for f in self._frames if f.index >= keep_from]
        kept.append(frame)
        if len(kept) > self._capacity:
            # The frame goes whose neighbours are closest together; the first and the last stay.
            gaps = [after.index - before.index for before, after in zip(kept, kept[2:], strict=False)]
            del kept[1 + gaps.index(min(gaps))]
        self._frames = kept

    def since(self, index: int) -> list[RecentFrame]:
        """The frames from number `index` on, in order; none where that one is not kept."""
        found = [f for f in self._frames if f.index >= index]
        return found if found and found[0].index == index else []

    def before(self, index: int) -> list[RecentFrame]:
        """The frames before number `index`, the last first, as far as none is missing between them."""
        found: list[RecentFrame] = []
        for frame in reversed([f for f in self._frames if f.index < index]):
            if frame.index != index - 1 - len(found):
                break
            found.append(frame)
        return found

    def __len__(self) -> int:
        return len(self._frames)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Known points with the pixels in which the last frame shows them."""

    rows: NDArray[np.int64]  # (n,) of the area's points, none twice
    points: FloatArray  # (n, 3) metres in the area's frame
    pixels: FloatArray  # (n, 2) in the last frame
    born: NDArray[np.int64]  # (n,) number of the keyframe that matched them

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Landmarks":
        """Some of them."""
        return Landmarks(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def joined(self, newer: "Landmarks") -> "Landmarks":
        """Both; of a point that is in both the newer one, whose pixel is a fresh match."""
        return joined([newer, self.take(~np.isin(self.rows, newer.rows))])

    def spread(self, count: int, columns: int, rows: int, width: int, height: int) -> "Landmarks":
        """At most `count`, in turns from the cells of a grid, the newest of a cell first."""
        if len(self) <= count:
            return self
        column = np.clip((self.pixels[:, 0] * columns / width).astype(np.int64), 0, columns - 1)
        row = np.clip((self.pixels[:, 1] * rows / height).astype(np.int64), 0, rows - 1)
        cell = row * columns + column
        order = np.lexsort((np.arange(len(self)), -self.born, cell))
        starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
        turn = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
        chosen = order[np.argsort(turn, kind="stable")[:count]]
        return self.take(np.sort(chosen))


class FlowTrack:
    """Landmarks on a ground, as the last frame shows them, with the last poses; of one thread at a time."""

    def __init__(
        self,
        keyframe: Keyframe,
        frame: RecentFrame,  # the keyframe's own, at which the track begins
        camera: Camera,
        options: TrackOptions,
        lens: LensWalk | None = None,  # the camera as it is known so far, to be estimated; None: it is given
    ) -> None:
        self.ground = keyframe.ground
        self.why = ""  # the last thing that went wrong, in words
        self._given, self._options, self._lens = camera, options, lens
        self.landmarks = self._spread(_landmarks_of(keyframe, frame.index), frame.gray)
        self._poses: deque[tuple[float, Rigid3]] = deque([(frame.time_s, keyframe.cam_from_local)], maxlen=2)

    @property
    def camera(self) -> Camera:
        """Intrinsics of the last frame."""
        return self._given if self._lens is None else self._lens.camera

    def settle(self) -> FittedPose | None:
        """The pose of the landmarks as they are; those that disagree are dropped. None: too few agree."""
        return self._replaced(self._agreed(self.landmarks, None, self._poses[-1][1], self._poses[-1][0]))

    def follow(self, before: RecentFrame, now: RecentFrame) -> FittedPose | None:
        """Carry the landmarks from the last frame to the next; None where too few are found, or agree."""
        marks, last = self.landmarks, self._poses[-1][1]
        predicted = self._predicted(now.time_s)
        step = self.camera.project(predicted.act(marks.points)) - self.camera.project(last.act(marks.points))
        guess = marks.pixels + np.where(np.isfinite(step), step, 0.0)
        pixels, good = follow(before.gray, now.gray, marks.pixels, guess, self._options.flow)
        height, width = now.gray.shape
        in_view = int(((guess >= 0) & (guess < (width, height))).all(axis=1).sum())
        fitted = self._agreed(replace(marks, pixels=pixels), good, predicted, now.time_s, in_view)
        if fitted is not None:
            self._poses.append((now.time_s, fitted.cam_from_local))
        return fitted

    def refresh(self, keyframe: Keyframe, then: RecentFrame, now: RecentFrame) -> FittedPose | None:
        """Take over what an earlier frame's matches say of the frame at hand; None: they do not agree.

        The guess where they are now is the track's.
        """
        fresh, pose = _landmarks_of(keyframe, then.index), self._poses[-1][1]
        step = self.camera.project(pose.act(fresh.points)) - keyframe.camera.project(
            keyframe.cam_from_local.act(fresh.points)
        )
        usable = np.flatnonzero(np.isfinite(step).all(axis=1))
        fresh = fresh.take(usable)
        pixels, good = follow(
            then.gray, now.gray, fresh.pixels, fresh.pixels + step[usable], self._options.flow
        )
        everything = self.landmarks.joined(replace(fresh, pixels=pixels).take(np.flatnonzero(good)))
        return self._replaced(self._agreed(self._spread(everything, now.gray), None, pose, now.time_s))

    def _replaced(self, fitted: FittedPose | None) -> FittedPose | None:
        """The last frame has this pose."""
        if fitted is not None:
            self._poses[-1] = (self._poses[-1][0], fitted.cam_from_local)
        return fitted

    def _agreed(
        self,
        marks: Landmarks,
        good: NDArray[np.bool_] | None,
        predicted: Rigid3,
        time_s: float,
        in_view: int = 0,  # that should be in the picture, of which some may not have been followed
    ) -> FittedPose | None:
        """The pose of the landmarks that were followed (None: all); what agrees with it stays."""
        options, followed = self._options, marks if good is None else marks.take(np.flatnonzero(good))
        if len(followed) < options.min_landmarks:
            found = f"{len(followed)} of {len(marks)} landmarks are found again"
            self.why = f"{found}, {options.min_landmarks} are needed"
            return None
        fitted = self._fitted(followed, predicted)
        agree = 0 if fitted is None else int(fitted.inlier.sum())
        if fitted is None or agree < max(options.min_landmarks, options.least_share * len(followed)):
            self.why = f"{agree} of {len(followed)} landmarks agree with a pose"
            return None
        if agree < options.least_kept * in_view:
            self.why = f"{agree} of {in_view} landmarks that should be in view agree with a pose: a cut?"
            return None
        self.landmarks = followed.take(fitted.inlier)
        if self._lens is not None:
            self._lens.take(fitted.focal_px, fitted.focal_rel, time_s)
        return fitted

    def _fitted(self, marks: Landmarks, predicted: Rigid3) -> FittedPose | None:
        """The pose of landmarks, with the focal length where it was not given."""
        lens = self._lens
        if lens is None:
            return fit_pose(self._given, marks.pixels, marks.points, predicted)
        fitted = fit_pose(lens.camera, marks.pixels, marks.points, predicted, lens.doubt)
        if lens.zooming or (fitted is not None and not lens.surprised(fitted.focal_px, fitted.focal_rel)):
            return fitted
        lens.zooms()
        return fit_pose(lens.camera, marks.pixels, marks.points, predicted, lens.doubt)

    def _predicted(self, time_s: float) -> Rigid3:
        """The last pose, moved on as it moved before."""
        if len(self._poses) < 2:
            return self._poses[-1][1]
        (first_s, first), (second_s, second) = self._poses
        span_s = second_s - first_s  # negative where frames are followed backwards
        share = (time_s - second_s) / span_s if abs(span_s) > _INSTANT_S else 0.0
        return Rigid3.exp(min(share, 3.0) * (second @ first.inverse()).log()) @ second

    def _spread(self, marks: Landmarks, gray: NDArray[np.uint8]) -> Landmarks:
        options = self._options
        return marks.spread(options.landmarks, options.columns, options.rows, gray.shape[1], gray.shape[0])


def _landmarks_of(keyframe: Keyframe, index: int) -> Landmarks:
    """A keyframe's matches. A point may be seen by two keypoints; it is followed once."""
    _, first = np.unique(keyframe.rows, return_index=True)
    rows = keyframe.rows[first]
    return Landmarks(
        rows=rows,
        points=keyframe.points[first],
        pixels=keyframe.pixels[first],
        born=np.full(len(first), index, dtype=np.int64),
    )
