"""Where the focal length changes within a shot.

What a focal length leaves over of the matches of two pictures (epipolar geometry, nothing reconstructed) is a
likelihood of it. A single pair tells little, one of a camera that does not turn nothing; all pairs before a
moment and all behind it together tell whether one focal length explains both, by the ratio of variances (its
limit stands between what films with and without a zoom have shown, not at a rate of error). A camera that
only turns while it zooms sees no parallax: there a rotation and a zoom explain all of the motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from ingest.video.same_scene import SceneOptions, matched


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoomOptions:
    """When a lens has zoomed, in pictures of about 640 pixels.

    Attributes:
        focals: that are tried, in longer sides of the picture.
        apart: pictures that are compared are so many apart.
        least: matches of a pair that says something. most: that are used. least_pairs: on either side.
        agree_px: matches farther from the best epipolar geometry are wrong. floor_px: what no match is better
            than.
        least_variance: ratio of what one focal length leaves over to what two do, over all pairs. On
            simulated flights with one lens it was 1.00 to 1.08, on one that zooms from 0.8 to 1.25 sides
            1.30, on a real one straight ahead 1.00.
        least_zoom: ratio of the two focal lengths.
        turn_px: by which a rotation and a zoom may miss. turn_share: of the matches that they must explain.
        turn_zoom: of such a pair. turn_total: of those that follow each other.
        directions: of movement that are tried.
    """

    focals: tuple[float, ...] = (0.45, 0.56, 0.7, 0.87, 1.09, 1.36, 1.7, 2.1)
    apart: int = 2
    least: int = 60
    most: int = 160
    least_pairs: int = 5
    agree_px: float = 3.0
    floor_px: float = 0.1
    least_variance: float = 1.2
    least_zoom: float = 1.1
    turn_px: float = 0.7
    turn_share: float = 0.95
    turn_zoom: float = 1.02
    turn_total: float = 1.1
    directions: int = 150
    scene: SceneOptions = field(default_factory=SceneOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pair:
    """Two pictures of a shot.

    Attributes:
        first, second: their places in it. matches: that were used.
        left: (focals,) half the logarithm of the mean square that each focal length leaves, times matches.
    """

    first: int
    second: int
    matches: int
    left: FloatArray


def lenses_of(
    pictures: Sequence[NDArray[np.uint8]], shots: Sequence[int], options: ZoomOptions | None = None
) -> tuple[int, ...]:
    """Number of the lens of each picture (h, w), from 0 in every shot; each has its own while it zooms.

    Args:
        shots: number of the shot of each picture; those of one follow each other.
    """
    options = options or ZoomOptions()
    numbers = [0] * len(pictures)
    for shot in sorted(set(shots)):
        rows = [k for k, s in enumerate(shots) if s == shot]
        changed = _changes([pictures[row] for row in rows], options)
        for row, number in zip(rows, np.cumsum(changed).tolist(), strict=True):
            numbers[row] = number
    return tuple(numbers)


def _changes(pictures: Sequence[NDArray[np.uint8]], options: ZoomOptions) -> NDArray[np.bool_]:
    """(k,) whether a picture's focal length is another than that of the one before."""
    changed = np.zeros(len(pictures), dtype=np.bool_)
    features = [extract(picture, options.scene.features) for picture in pictures]
    shape = pictures[0].shape
    growth = np.zeros(len(pictures))
    turned = np.zeros(len(pictures), dtype=np.bool_)
    for k in range(1, len(pictures)):
        a, b = _rays(*matched(features[k - 1], features[k], options.scene.max_ratio), shape, options)
        if len(a) >= options.least:
            growth[k], share = _turn_and_zoom(a, b, max(shape), options)
            turned[k] = share >= options.turn_share
    if np.ptp(np.cumsum(growth)) < np.log(options.least_zoom):
        return changed  # a zoom makes the picture grow, or shrink
    for run in _runs(turned & (np.abs(growth) >= np.log(options.turn_zoom))):
        if abs(growth[run].sum()) >= np.log(options.turn_total):
            changed[run] = True
    _split(_pairs(features, shape, options), growth, changed, options)
    return changed


def _pairs(features: Sequence[Features], shape: tuple[int, ...], options: ZoomOptions) -> list[_Pair]:
    """Pairs of pictures that say something of their focal length."""
    pairs = []
    for k in range(options.apart, len(features)):
        first = k - options.apart
        a, b = _rays(*matched(features[first], features[k], options.scene.max_ratio), shape, options)
        left = _left_over(a, b, max(shape), options) if len(a) >= options.least else None
        if left is not None:
            pairs.append(_Pair(first=first, second=k, matches=len(a), left=left))
    return pairs


def _split(
    pairs: Sequence[_Pair], growth: FloatArray, changed: NDArray[np.bool_], options: ZoomOptions
) -> None:
    """Mark the pictures of the clearest zoom among the pairs, then look before and behind it."""
    best, moment, ratio = 0.0, -1, 0.0
    for k in range(len(growth)):
        before = [p for p in pairs if p.second <= k]
        behind = [p for p in pairs if p.first >= k]
        if min(len(before), len(behind)) < options.least_pairs:
            continue
        one, two = (np.sum([p.left for p in part], axis=0) for part in (before, behind))
        matches = sum(p.matches for p in (*before, *behind))
        gain = ((one + two).min() - one.min() - two.min()) / matches
        if gain > best:
            best, moment = gain, k
            ratio = options.focals[int(two.argmin())] / options.focals[int(one.argmin())]
    if best < 0.5 * np.log(options.least_variance) or abs(np.log(ratio)) < np.log(options.least_zoom):
        return
    first, last = _while_it_zooms(growth, moment, float(np.log(ratio)))
    changed[first : last + 1] = True
    _split([p for p in pairs if p.second < first], growth[:first], changed[:first], options)
    behind = [
        _Pair(first=p.first - last, second=p.second - last, matches=p.matches, left=p.left)
        for p in pairs
        if p.first >= last
    ]
    _split(behind, growth[last:], changed[last:], options)


def _while_it_zooms(growth: FloatArray, moment: int, zoom: float) -> tuple[int, int]:
    """The fewest pictures around a moment by whose growth the zoom can be explained; first and last."""
    signed = np.cumsum(np.r_[0.0, np.sign(zoom) * growth])
    found = [
        (last - first, first, last)
        for first in range(1, moment + 1)
        for last in range(max(moment, first), len(growth))
        if signed[last + 1] - signed[first] >= abs(zoom)
    ]
    return min(found)[1:] if found else (moment, min(moment + 1, len(growth) - 1))


def _runs(marked: NDArray[np.bool_]) -> list[slice]:
    """Stretches of marked rows."""
    edges = np.flatnonzero(np.diff(np.r_[False, marked, False].astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _rays(
    start: FloatArray, end: FloatArray, shape: tuple[int, ...], options: ZoomOptions
) -> tuple[FloatArray, FloatArray]:
    """Matches (m, 2) in longer sides from the middle, without those that stand still; at most `most`."""
    moving = np.flatnonzero(np.linalg.norm(end - start, axis=1) > 1.0)
    moving = moving[:: max(1, -(-len(moving) // options.most))]
    middle = np.array([shape[1], shape[0]]) / 2.0
    return (start[moving] - middle) / max(shape), (end[moving] - middle) / max(shape)


def _turn_and_zoom(a: FloatArray, b: FloatArray, side: float, options: ZoomOptions) -> tuple[float, float]:
    """Logarithm of the zoom beside the best rotation, and the share of the matches that both explain."""

    def off(x: FloatArray) -> FloatArray:
        rays = np.column_stack([a, np.ones(len(a))]) @ Rotation.from_rotvec(x[:3]).as_matrix().T
        return np.asarray(np.exp(x[3]) * rays[:, :2] / rays[:, 2:] - b).ravel()

    fit = least_squares(off, np.zeros(4), loss="soft_l1", f_scale=options.turn_px / side)
    agree = np.linalg.norm(off(fit.x).reshape(-1, 2), axis=1) <= 2.0 * options.turn_px / side
    return float(fit.x[3]), float(agree.mean())


def _left_over(a: FloatArray, b: FloatArray, side: float, options: ZoomOptions) -> FloatArray | None:
    """`_Pair.left` of matches; None where too few agree on an epipolar geometry."""
    ways = _directions(options.directions)
    starts = []
    for focal in options.focals:
        turns, misses = _linear(a, b, focal, ways, side)
        row = int(np.median(np.abs(misses), axis=1).argmin())
        starts.append((turns[row], ways[row], np.abs(misses[row]) * focal * side))
    best = min(starts, key=lambda start: float(np.median(start[2])))
    good = best[2] <= options.agree_px
    if good.sum() < options.least // 2:
        return None
    squares = [
        min(_epipolar(a[good], b[good], focal, *start[:2]) for start in (own, best))
        for focal, own in zip(options.focals, starts, strict=True)
    ]
    left = 0.5 * len(a) * np.log(np.array(squares) + (options.floor_px / side) ** 2)
    return np.asarray(left - left.min())


def _directions(count: int) -> FloatArray:
    """Unit vectors (count, 3) spread over a half sphere."""
    k = np.arange(count) + 0.5
    down, round_ = np.arccos(1.0 - k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)], axis=1)


def _linear(
    a: FloatArray, b: FloatArray, focal: float, ways: FloatArray, side: float
) -> tuple[FloatArray, FloatArray]:
    """For each direction of movement the best small rotation (d, 3), and what is left across it (d, m)."""
    p, u = 0.5 * (a + b) / focal, (b - a) / focal
    x, y = p.T
    turn = np.stack(
        [
            np.stack([-x * y, -1.0 - y * y], axis=1),
            np.stack([1.0 + x * x, x * y], axis=1),
            np.stack([-y, x], axis=1),
        ],
        axis=2,
    )
    along = ways[:, None, :2] - p[None] * ways[:, None, 2:]
    across = np.stack([-along[..., 1], along[..., 0]], axis=2)
    across /= np.linalg.norm(across, axis=2, keepdims=True) + 1e-3
    rows, sides = np.einsum("dmk,mkc->dmc", across, turn), np.einsum("dmk,mk->dm", across, u)
    weight, misses = np.ones_like(sides), sides
    turns = np.zeros((len(ways), 3))
    for _ in range(4):
        heavy = rows * weight[..., None]
        normal = np.einsum("dmc,dme->dce", heavy, rows) + 1e-9 * np.eye(3)
        turns = np.linalg.solve(normal, np.einsum("dmc,dm->dc", heavy, sides)[..., None])[..., 0]
        misses = sides - np.einsum("dmc,dc->dm", rows, turns)
        weight = 1.0 / (1.0 + (misses * focal * side) ** 2)
    return turns, misses


def _epipolar(a: FloatArray, b: FloatArray, focal: float, turn: FloatArray, way: FloatArray) -> float:
    """Mean square of Sampson's distances after the adjustment of rotation and direction."""
    p, q = (np.column_stack([m / focal, np.ones(len(m))]) for m in (a, b))

    def off(x: FloatArray) -> FloatArray:
        t = np.array([np.sin(x[3]) * np.cos(x[4]), np.sin(x[3]) * np.sin(x[4]), np.cos(x[3])])
        cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
        matrix = cross @ Rotation.from_rotvec(x[:3]).as_matrix()
        ahead, back = p @ matrix.T, q @ matrix
        size = np.sqrt((ahead[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
        return np.asarray(focal * (q * ahead).sum(axis=1) / np.maximum(size, 1e-12))

    start = np.r_[turn, np.arccos(np.clip(way[2], -1.0, 1.0)), np.arctan2(way[1], way[0])]
    fit = least_squares(off, start, method="lm", max_nfev=60)
    return float((fit.fun**2).mean())
