"""How the picture of a film moves from frame to frame, and how sharp it is: what keyframes are chosen by."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoFrame
from reloc.tracking.flow import follow
from reloc.tracking.options import FlowOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """How the motion is measured.

    Attributes:
        corners: that are followed from each frame to the next. quality, min_distance_rel: of OpenCV's
            goodFeaturesToTrack; the distance is a share of the longer side.
        tolerance_rel: points that a similarity of the picture misses by more, a share of the longer side,
            move by themselves, or stand still as text that is burnt in does.
        min_share: of the corners must be found again and agree; fewer are a break: a cut, a blink, a blur.
        flow: of the frames as they come.
    """

    corners: int = 150
    quality: float = 0.01
    min_distance_rel: float = 0.02
    tolerance_rel: float = 0.004
    min_share: float = 0.3
    flow: FlowOptions = field(default_factory=lambda: FlowOptions(levels=3, max_back_px=1.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """All frames of a film, in order.

    Attributes:
        index: (n,) of the frames. time_s: (n,).
        step: (n, 2, 3) similarity that takes the last frame's pixels to this one's; lengths are shares of the
            longer side, from the middle of the picture. The identity at breaks.
        broken: (n,) bool: nothing connects the frame with the one before; the first always.
        sharpness: (n,) standard deviation of the Laplacian over that of the grey values.
    """

    index: NDArray[np.int64]
    time_s: FloatArray
    step: FloatArray
    broken: NDArray[np.bool_]
    sharpness: FloatArray

    def __len__(self) -> int:
        return len(self.index)


def measure_motion(frames: Iterable[VideoFrame], options: MotionOptions | None = None) -> Motion:
    """Motion of a film's frames; small ones (some 640 pixels) are enough.

    Raises:
        VideoError: as the frames do.
    """
    options = options or MotionOptions()
    index, times, steps, broken, sharpness = [], [], [], [], []
    before: NDArray[np.uint8] | None = None
    for frame in frames:
        step = None if before is None else _step(before, frame.gray, options)
        index.append(frame.index)
        times.append(frame.time_s)
        steps.append(np.eye(2, 3) if step is None else step)
        broken.append(step is None)
        sharpness.append(_sharpness(frame.gray))
        before = frame.gray
    return Motion(
        index=np.array(index, dtype=np.int64),
        time_s=np.array(times, dtype=np.float64),
        step=np.array(steps, dtype=np.float64).reshape(-1, 2, 3),
        broken=np.array(broken, dtype=np.bool_),
        sharpness=np.array(sharpness, dtype=np.float64),
    )


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
