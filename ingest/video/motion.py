"""How the picture of a film moves from frame to frame, and how sharp it is: what keyframes are chosen by.

Where flow does not connect two frames there is a break: a cut, a dissolve, a blink, a blur. It is a cut where
the pictures on both sides of it do not show the same, either. PySceneDetect asks how much the colours change,
and wants a second OpenCV beside ours.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoFrame
from reloc.tracking.flow_track import follow
from reloc.tracking.options import FlowOptions

_FLOW = FlowOptions(levels=3, max_back_px=1.0)  # of the frames as they come


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


# That are followed from each frame to the next. _QUALITY, _MIN_DISTANCE_REL: of OpenCV's goodFeaturesToTrack;
# the distance is a share of the longer side.
_CORNERS = 150
_QUALITY = 0.01
# Points that a similarity of the picture misses by more, a share of the longer side, move by themselves, or
# stand still as text that is burnt in does.
_TOLERANCE_REL = 0.004
_MIN_SHARE = 0.3  # of the corners must be found again and agree; fewer are a break: a cut, a blink, a blur
# Mean change of grey values below which a frame repeats the last one. Frames of a real flight differ by 0.96
# and more, repeated ones by what compression leaves, 0.1.
_FROZEN_LEVELS = 0.3
_FLAT_LEVELS = 3.0  # deviation of grey values in a patch of _FLAT_REL of the longer side that holds nothing
# Of the picture without anything from which on it shows no place. Of 188 photos of six real sets, with sky,
# sand and bare fields, the emptiest has 0.65, plain grounds with titles 0.89.
_BLANK_SHARE = 0.8
# A blank picture that is no brighter is black. _TITLE_LEVELS: one whose brightest and darkest parts differ by
# more has something written on it.
_BLACK_LEVELS = 32.0
_TITLE_LEVELS = 60.0
_MIN_DISTANCE_REL = 0.02
_FLAT_REL = 0.014


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


def measure_motion(frames: Iterable[VideoFrame]) -> Motion:
    """Motion of a film's frames; small ones (some 640 pixels) are enough.

    Raises:
        VideoError: as the frames do.
    """
    index: list[int] = []
    times, steps, sharpness = [], [], []
    broken: list[bool] = []
    cut: list[bool] = []
    kinds: list[int] = []
    before: NDArray[np.uint8] | None = None
    shown: NDArray[np.uint8] | None = None  # the last one that flow connected with its neighbour
    for frame in frames:
        kind = _kind(frame.gray, before)
        blank = kind.is_blank or not kinds or FrameKind(kinds[-1]).is_blank
        step = None if before is None or blank else _step(before, frame.gray)
        if step is not None and broken[-1]:
            assert before is not None
            cut[-1] = shown is None or not same_scene(shown, before)
        index.append(frame.index)
        times.append(frame.time_s)
        steps.append(np.eye(2, 3) if step is None else step)
        broken.append(step is None)
        cut.append(False)
        kinds.append(int(kind))
        edges = float(cv2.Laplacian(frame.gray, cv2.CV_32F).std())
        sharpness.append(edges / max(float(frame.gray.std()), 1.0))
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


def _kind(gray: NDArray[np.uint8], before: NDArray[np.uint8] | None) -> FrameKind:
    side = max(3, round(_FLAT_REL * max(gray.shape)))
    values = gray.astype(np.float32)
    mean = cv2.blur(values, (side, side))
    spread = cv2.blur(values * values, (side, side)) - mean * mean
    if (spread < _FLAT_LEVELS**2).mean() >= _BLANK_SHARE:
        if np.ptp(mean) > _TITLE_LEVELS:
            return FrameKind.TITLE
        return FrameKind.BLACK if mean.mean() <= _BLACK_LEVELS else FrameKind.PLAIN
    if before is not None and float(cv2.absdiff(gray, before).mean()) < _FROZEN_LEVELS:
        return FrameKind.FROZEN
    return FrameKind.PICTURE


def _step(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> FloatArray | None:
    """The similarity (2, 3) between two frames; None where the corners do not agree on one."""
    side = max(before.shape)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _MIN_DISTANCE_REL * side)
    if corners is None or len(corners) < 8:
        return None
    pixels = corners.reshape(-1, 2).astype(np.float64) + 0.5
    there, good = follow(before, now, pixels, pixels, _FLOW)
    if good.sum() < max(8, _MIN_SHARE * len(pixels)):
        return None
    middle = np.array([before.shape[1], before.shape[0]]) / 2.0
    start, end = ((p[good] - middle) / side for p in (pixels, there))
    # OpenCV draws its samples from a generator of its own: the same frames give the same answer only so.
    cv2.setRNGSeed(0)
    found, inliers = cv2.estimateAffinePartial2D(
        start, end, method=cv2.RANSAC, ransacReprojThreshold=_TOLERANCE_REL
    )
    if found is None or inliers is None or inliers.sum() < max(8, _MIN_SHARE * len(pixels)):
        return None
    return np.asarray(found, dtype=np.float64)


SCENE_FEATURES = ExtractorOptions(first_octave_px=1280, max_features=600)  # of each frame
MAX_RATIO = 0.8  # of a match's distance to that of the next best one

# By which matches may miss a similarity of the picture, a share of the longer side; depth moves them.
_SCENE_TOLERANCE_REL = 0.02
# Of a grid over the picture. _LEAST_CELLS: share of its cells with features that must have some that agree.
# Logos and captions match, but in few cells.
_COLUMNS = 8
_ROWS = 6
_LEAST_CELLS = 0.25
_MAX_ZOOM = 1.1  # between frames a moment apart; more is another lens


def same_scene(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Whether two grey frames (h, w) of one size show the same, moved and turned as may be."""
    a, b = (extract(gray, SCENE_FEATURES) for gray in (one, other))
    start, end = matched(a, b)
    if len(start) < 8:
        return False
    cv2.setRNGSeed(0)  # as in motion.py
    found, agree = cv2.estimateAffinePartial2D(
        start, end, method=cv2.RANSAC, ransacReprojThreshold=_SCENE_TOLERANCE_REL * max(one.shape)
    )
    if found is None:
        return False
    zoom = float(np.hypot(found[0, 0], found[1, 0]))
    if not 1.0 / _MAX_ZOOM <= zoom <= _MAX_ZOOM:
        return False
    held = _cells(start[agree.reshape(-1) == 1], one.shape)
    return len(held) >= _LEAST_CELLS * len(_cells(a.xy, one.shape))


def matched(one: Features, other: Features) -> tuple[FloatArray, FloatArray]:
    """Pixels (m, 2) of both frames of features that are each other's nearest, and clearly so."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    a, b = (f.descriptors.astype(np.float32) for f in (one, other))
    a, b = (d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6) for d in (a, b))
    distance = np.sqrt(np.maximum(2.0 - 2.0 * a @ b.T, 0.0))
    best = distance.argmin(axis=1)
    two = np.partition(distance, 1, axis=1)[:, :2]
    mutual = distance.argmin(axis=0)[best] == np.arange(len(best))
    rows = np.flatnonzero(mutual & (two[:, 0] < MAX_RATIO * two[:, 1]))
    return one.xy[rows].astype(np.float64), other.xy[best[rows]].astype(np.float64)


def _cells(xy: FloatArray | NDArray[np.float32], shape: tuple[int, ...]) -> set[int]:
    """Numbers of the cells that pixels (n, 2) lie in."""
    column = (xy[:, 0] * _COLUMNS / shape[1]).astype(int)
    row = (xy[:, 1] * _ROWS / shape[0]).astype(int)
    return set((row * _COLUMNS + column).tolist())
