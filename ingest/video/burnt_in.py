"""What does not belong to the scene that a film shows: bars at its edges, logos, captions, a clock.

A pixel of the scene moves with what is around it; one that is burnt in has the same edge again and again,
although the surroundings have gone on by many pixels. An edge along which the picture moves stays, too (a
road straight ahead), so that only the slope along the motion counts; and where the surroundings hardly move
(a horizon far away), nothing can be said, and nothing is.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from ingest.video.motion import SCENE_FEATURES, matched

Mask = NDArray[np.bool_]
Gray = NDArray[np.uint8]


# The surroundings of what is burnt in have moved by at least so much from one picture to the next; slopes of
# a scene are no longer alike then. _STILL_PX: what moves less may be burnt in itself, and says nothing about
# its surroundings.
_MOVED_PX = 6.0
_STILL_PX = 0.5
_NEAREST = 8  # matches around a pixel that tell how its surroundings move
_LEAST = 4  # pairs of pictures between which they moved
# Correlation of the slopes of two pictures at the same pixels, over all pairs. That of the scene is about 0,
# of what is burnt in 1.
_LEAST_LIKENESS = 0.5
_WINDOW = 7  # side of the squares of pixels that are looked at together
_LEAST_SLOPE = 6.0  # grey values a pixel, root mean square, of an edge
_LEAST_AREA = 40  # pixels; smaller specks are chance
_AROUND_PX = 6  # so much is masked around it: keypoints look at their surroundings
_STEADY_LEVELS = 3.0  # deviation of grey values that compression leaves in a bar
# Bars are no brighter. _BAR_SHARE: of a bar's row that is of one grey value; writing may be on it.
_BAR_LEVELS = 32.0
_BAR_SHARE = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BurntIn:
    """Of one shot.

    Attributes:
        mask: (h, w) bool, of the pictures that were looked at.
        bars: left, top, right, bottom, pixels of them.
    """

    mask: Mask
    bars: tuple[int, int, int, int]

    @property
    def bar_shares(self) -> tuple[float, float, float, float]:
        """Of the picture's width and height, in the order of `bars`."""
        height, width = self.mask.shape
        left, top, right, bottom = self.bars
        shares = (left / width, top / height, right / width, bottom / height)
        return (round(shares[0], 4), round(shares[1], 4), round(shares[2], 4), round(shares[3], 4))

    @property
    def overlay_share(self) -> float:
        """Of the picture within the bars."""
        left, top, right, bottom = self.bars
        inside = self.mask[top : self.mask.shape[0] - bottom, left : self.mask.shape[1] - right]
        return float(inside.mean()) if inside.size else 0.0


def find_burnt_in(pictures: Sequence[Gray], shots: Sequence[int]) -> dict[int, BurntIn]:
    """What is burnt into each shot of a film.

    Args:
        pictures: (h, w) of one size, in their order, those of a shot at some distance from each other.
        shots: number of the shot of each.

    Where a shot says nothing, since it is too short or hardly moves there, the whole film does: across a cut
    all of the scene is another.
    """
    film_bars = _bars(pictures)
    sums, film = _Sums.of_pairs(pictures, shots)
    found = {}
    for shot in sorted(set(shots)):
        mine = [picture for picture, number in zip(pictures, shots, strict=True) if number == shot]
        bars = film_bars if len(mine) < _LEAST else _bars(mine)
        own = sums.get(shot)
        edges = film.burnt_in()
        if own is not None:
            edges = np.where(own.count >= _LEAST, own.burnt_in(), edges)
        # A bar's own edge is none of the picture's.
        mask = _areas(edges & _within(bars, edges.shape, _WINDOW))
        found[shot] = BurntIn(mask=mask | ~_within(bars, mask.shape, 0), bars=bars)
    return found


@dataclass(slots=True, kw_only=True, eq=False)
class _Sums:
    """Over pairs of pictures between which the surroundings of a pixel moved, each (h, w).

    Attributes:
        both: product of the slopes along the motion. each: mean of their squares. count: pairs.
    """

    both: FloatArray
    each: FloatArray
    count: FloatArray

    @classmethod
    def of_pairs(cls, pictures: Sequence[Gray], shots: Sequence[int]) -> tuple[dict[int, "_Sums"], "_Sums"]:
        """Sums of each shot and of the film."""
        shape = pictures[0].shape

        def none_yet() -> "_Sums":
            return cls(both=np.zeros(shape), each=np.zeros(shape), count=np.zeros(shape))

        film, of_shot = none_yet(), defaultdict[int, _Sums](none_yet)
        features, slopes = extract(pictures[0], SCENE_FEATURES), _slopes(pictures[0])
        for k in range(1, len(pictures)):
            before, steep = features, slopes
            features, slopes = extract(pictures[k], SCENE_FEATURES), _slopes(pictures[k])
            if shots[k] != shots[k - 1]:
                film.add(steep, slopes, np.ones(shape, dtype=np.bool_))
                continue
            flow = _flow(before, features, shape)
            if flow is None:
                continue
            moves = np.linalg.norm(flow, axis=0)
            way = flow / np.maximum(moves, 1e-6)
            one, other = ((s * way).sum(axis=0, keepdims=True) for s in (steep, slopes))
            for sums in (of_shot[shots[k]], film):
                sums.add(one, other, moves >= _MOVED_PX)
        return of_shot, film

    def add(self, one: FloatArray, other: FloatArray, tested: Mask) -> None:
        """Slopes (1 or 2, h, w) of a pair."""
        self.both += (one * other).sum(axis=0) * tested
        self.each += 0.5 * (one**2 + other**2).sum(axis=0) * tested
        self.count += tested

    def burnt_in(self) -> Mask:
        """Edges that stay where they are."""
        side = (_WINDOW, _WINDOW)
        both, each = cv2.blur(self.both, side), cv2.blur(self.each, side)
        found = (self.count >= _LEAST) & (both >= _LEAST_LIKENESS * each)
        return np.asarray(found & (each >= _LEAST_SLOPE**2 * np.maximum(self.count, 1)))


def _within(bars: tuple[int, int, int, int], shape: tuple[int, ...], more: int) -> Mask:
    """Pixels (h, w) that lie within the bars, where there are some by so many more."""
    left, top, right, bottom = (width + more if width else 0 for width in bars)
    inside = np.zeros(shape, dtype=np.bool_)
    inside[top : shape[0] - bottom, left : shape[1] - right] = True
    return inside


def _areas(edges: Mask) -> Mask:
    """What edges enclose and what is around them, without specks."""
    labels, names, stats, _ = cv2.connectedComponentsWithStats(edges.astype(np.uint8))
    large = [n for n in range(1, labels) if stats[n, cv2.CC_STAT_AREA] >= _LEAST_AREA]
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _AROUND_PX + 1,) * 2)
    closed = cv2.morphologyEx(np.isin(names, large).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    return np.asarray(cv2.dilate(closed, kernel), dtype=np.bool_)


def _slopes(picture: Gray) -> FloatArray:
    """(2, h, w) along x and y, grey values a pixel."""
    return np.stack([cv2.Sobel(picture, cv2.CV_64F, *way) for way in ((1, 0), (0, 1))]) / 8.0


def _flow(one: Features, other: Features, shape: tuple[int, ...]) -> FloatArray | None:
    """(2, h, w) pixels by which the surroundings of each pixel move, the shorter ones of those around.

    None where too little is matched.
    """
    start, end = matched(one, other)
    moves = end - start
    moving = np.linalg.norm(moves, axis=1) >= _STILL_PX
    start, moves = start[moving], moves[moving]
    if len(start) < 3 * _NEAREST:
        return None
    cell = 16
    rows, columns = -(-shape[0] // cell), -(-shape[1] // cell)
    y, x = np.mgrid[:rows, :columns] * cell + 0.5 * cell
    found = cKDTree(start).query(np.stack([x.ravel(), y.ravel()], axis=1), k=_NEAREST)
    near: NDArray[np.int64] = np.asarray(found[1], dtype=np.int64)
    lengths = np.linalg.norm(moves[near], axis=2)
    shorter = np.argsort(lengths, axis=1)[:, _NEAREST // 4]
    grid = moves[near[np.arange(len(near)), shorter]].reshape(rows, columns, 2)
    full = np.repeat(np.repeat(grid, cell, axis=0), cell, axis=1)[: shape[0], : shape[1]]
    return np.moveaxis(full, 2, 0)


def _bars(pictures: Sequence[Gray]) -> tuple[int, int, int, int]:
    """Widths of the rows and columns of one grey value at the edges: left, top, right, bottom."""
    stack = np.stack(pictures).astype(np.float32)
    widths = []
    for axis, flip in ((2, False), (1, False), (2, True), (1, True)):
        lines = np.moveaxis(stack, axis, 0)  # (lines, pictures, pixels)
        lines = lines[::-1] if flip else lines
        level = float(np.median(lines[0]))
        steady = (np.abs(lines - level) <= _STEADY_LEVELS).mean(axis=(1, 2)) >= _BAR_SHARE
        ends = np.flatnonzero(~steady | (level > _BAR_LEVELS))
        widths.append(int(ends[0]) if len(ends) else 0)
    # Resampling mixes a bar's last row with the picture.
    left, top, right, bottom = (width + 2 if width else 0 for width in widths)
    height, width = pictures[0].shape
    if left + right > width // 2 or top + bottom > height // 2:
        return 0, 0, 0, 0
    return left, top, right, bottom


def painted_over(picture: Gray, mask: Mask) -> Gray:
    """A picture (h, w, 3) whose masked parts go over smoothly into what is around them.

    Nothing that a keypoint could hold on to is left there: each hole is filled from ever coarser pictures.
    """
    known = np.where(mask, 0.0, 1.0).astype(np.float32)
    filled = _filled(picture.astype(np.float32) * known[..., None], known)
    return np.where(mask[..., None], np.clip(np.rint(filled), 0, 255), picture).astype(np.uint8)


def _filled(values: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of what is known, from a picture of half the size where nothing is (pull and push)."""
    share = known[..., None]
    if min(known.shape) <= 2 or (known > 0).all():
        mean = values.sum(axis=(0, 1)) / max(float(known.sum()), 1e-6)
        return np.where(share > 0, values / np.maximum(share, 1e-6), mean).astype(np.float32)
    coarse = _filled(np.asarray(cv2.pyrDown(values), np.float32), np.asarray(cv2.pyrDown(known), np.float32))
    size = (known.shape[1], known.shape[0])
    behind = np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR), np.float32)
    return np.where(share > 0, values / np.maximum(share, 1e-6), behind).astype(np.float32)
