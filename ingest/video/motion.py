"""How the picture of a film moves from frame to frame, and how sharp it is: what keyframes are chosen by.

Where flow does not connect two frames there is a break: a cut, a dissolve, a blink, a blur. It is a cut where
the pictures on both sides of it do not show the same, either. PySceneDetect asks how much the colours change,
and wants a second OpenCV beside ours.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoFrame
from ingest.video.same_scene import SameSceneOptions, same_scene
from reloc.tracking.flow import follow
from reloc.tracking.options import FlowOptions


class FrameKind(IntEnum):
    """What a frame holds."""

    PICTURE = 0
    FROZEN = 1  # the picture of the frame before
    BLACK = 2
    PLAIN = 3
    TITLE = 4  # plain, with writing or a drawing on it

    @property
    def is_blank(self) -> bool:
        """Whether nothing of a place is in it."""
        return self >= FrameKind.BLACK


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """How the motion is measured.

    Attributes:
        corners: that are followed from each frame to the next. quality, min_distance_rel: of OpenCV's
            goodFeaturesToTrack; the distance is a share of the longer side.
        tolerance_rel: points that a similarity of the picture misses by more, a share of the longer side,
            move by themselves, or stand still as text that is burnt in does.
        min_share: of the corners must be found again and agree; fewer are a break: a cut, a blink, a blur.
        frozen_levels: mean change of grey values below which a frame repeats the last one. Frames of a real
            flight differ by 0.96 and more, repeated ones by what compression leaves, 0.1.
        flat_levels: deviation of grey values in a patch of `flat_rel` of the longer side that holds nothing.
        blank_share: of the picture without anything from which on it shows no place. Of 188 photos of six
            real sets, with sky, sand and bare fields, the emptiest has 0.65, plain grounds with titles 0.89.
        black_levels: a blank picture that is no brighter is black. title_levels: one whose brightest and
            darkest parts differ by more has something written on it.
        flow: of the frames as they come.
        scene: whether both sides of a break show the same.
    """

    corners: int = 150
    quality: float = 0.01
    min_distance_rel: float = 0.02
    tolerance_rel: float = 0.004
    min_share: float = 0.3
    frozen_levels: float = 0.3
    flat_levels: float = 3.0
    flat_rel: float = 0.014
    blank_share: float = 0.8
    black_levels: float = 32.0
    title_levels: float = 60.0
    flow: FlowOptions = field(default_factory=lambda: FlowOptions(levels=3, max_back_px=1.0))
    scene: SameSceneOptions = field(default_factory=SameSceneOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """All frames of a film, in order.

    Attributes:
        index: (n,) of the frames. time_s: (n,).
        step: (n, 2, 3) similarity that takes the last frame's pixels to this one's; lengths are shares of the
            longer side, from the middle of the picture. The identity at breaks.
        broken: (n,) bool: nothing connects the frame with the one before; the first always.
        cut: (n,) bool: broken frames at which a shot begins, which shows something else than the last one.
        kind: (n,) int8, `FrameKind`.
        sharpness: (n,) standard deviation of the Laplacian over that of the grey values.
    """

    index: NDArray[np.int64]
    time_s: FloatArray
    step: FloatArray
    broken: NDArray[np.bool_]
    cut: NDArray[np.bool_]
    kind: NDArray[np.int8]
    sharpness: FloatArray

    def __len__(self) -> int:
        return len(self.index)


def measure_motion(frames: Iterable[VideoFrame], options: MotionOptions | None = None) -> Motion:
    """Motion of a film's frames; small ones (some 640 pixels) are enough.

    Raises:
        VideoError: as the frames do.
    """
    options = options or MotionOptions()
    index: list[int] = []
    times, steps, sharpness = [], [], []
    broken: list[bool] = []
    cut: list[bool] = []
    kinds: list[int] = []
    before: NDArray[np.uint8] | None = None
    shown: NDArray[np.uint8] | None = None  # the last one that flow connected with its neighbour
    for frame in frames:
        kind = _kind(frame.gray, before, options)
        blank = kind.is_blank or not kinds or FrameKind(kinds[-1]).is_blank
        step = None if before is None or blank else _step(before, frame.gray, options)
        if step is not None and broken[-1]:
            assert before is not None
            cut[-1] = shown is None or not same_scene(shown, before, options.scene)
        index.append(frame.index)
        times.append(frame.time_s)
        steps.append(np.eye(2, 3) if step is None else step)
        broken.append(step is None)
        cut.append(False)
        kinds.append(int(kind))
        sharpness.append(_sharpness(frame.gray))
        before = frame.gray
        shown = shown if step is None else before
    return Motion(
        index=np.array(index, dtype=np.int64),
        time_s=np.array(times, dtype=np.float64),
        step=np.array(steps, dtype=np.float64).reshape(-1, 2, 3),
        broken=np.array(broken, dtype=np.bool_),
        cut=np.array(cut, dtype=np.bool_),
        kind=np.array(kinds, dtype=np.int8),
        sharpness=np.array(sharpness, dtype=np.float64),
    )


def _kind(gray: NDArray[np.uint8], before: NDArray[np.uint8] | None, options: MotionOptions) -> FrameKind:
    side = max(3, round(options.flat_rel * max(gray.shape)))
    values = gray.astype(np.float32)
    mean = cv2.blur(values, (side, side))
    spread = cv2.blur(values * values, (side, side)) - mean * mean
    if (spread < options.flat_levels**2).mean() >= options.blank_share:
        if np.ptp(mean) > options.title_levels:
            return FrameKind.TITLE
        return FrameKind.BLACK if mean.mean() <= options.black_levels else FrameKind.PLAIN
    if before is not None and float(cv2.absdiff(gray, before).mean()) < options.frozen_levels:
        return FrameKind.FROZEN
    return FrameKind.PICTURE


def _step(before: NDArray[np.uint8], now: NDArray[np.uint8], options: MotionOptions) -> FloatArray | None:
    """The similarity (2, 3) between two frames; None where the corners do not agree on one."""
    side = max(before.shape)
    corners = cv2.goodFeaturesToTrack(
        before, options.corners, options.quality, options.min_distance_rel * side
    )
    if corners is None or len(corners) < 8:
        return None
    pixels = corners.reshape(-1, 2).astype(np.float64) + 0.5
    there, good = follow(before, now, pixels, pixels, options.flow)
    if good.sum() < max(8, options.min_share * len(pixels)):
        return None
    middle = np.array([before.shape[1], before.shape[0]]) / 2.0
    start, end = ((p[good] - middle) / side for p in (pixels, there))
    # OpenCV draws its samples from a generator of its own: the same frames give the same answer only so.
    cv2.setRNGSeed(0)
    found, inliers = cv2.estimateAffinePartial2D(
        start, end, method=cv2.RANSAC, ransacReprojThreshold=options.tolerance_rel
    )
    if found is None or inliers is None or inliers.sum() < max(8, options.min_share * len(pixels)):
        return None
    return np.asarray(found, dtype=np.float64)


def _sharpness(gray: NDArray[np.uint8]) -> float:
    spread = float(gray.std())
    return float(cv2.Laplacian(gray, cv2.CV_32F).std()) / max(spread, 1.0)
