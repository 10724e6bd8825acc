"""Where a plan of fronts and open ground agrees with a scan's: all places, headings and sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter, maximum_filter

from featuredb.geometry.arrays import FloatArray
from ingest.register.anchor.ground.scan_shape import CELL_M, HIGH_M, Circle, ScanShape
from ingest.register.anchor.ground.street_plan import StreetPlan
from ingest.register.anchor.start.from_ortho import PlanTry, first_apart

_CELL_M = 1.0
_BLUR_CELLS = 1.0
_REACH_CELLS = 60  # of a plan from the middle of its cameras
_FREE_WEIGHT = 0.1  # of a square metre of view through a building, over a metre of front
TURN_STEP, SIZE_STEP = np.radians(6.0), 0.1  # of the heading, of the size's logarithm
_PEAKS = 3  # of each heading and size
_OF_SIZE = 10  # kept of each size: the smaller a plan, the more places agree with it
_LOOSE = 1.5  # of the mean of geotags: those of one visit err together
_WRONG = 9.0  # squared sigmas from which on a geotag says nothing; a third of them may be so
_SIGMAS = 4.0  # of the geotags within which a place is looked for
_NEAR_M, _NEAR_TURN, _NEAR_SIZE = 4.0, np.radians(10.0), 0.15  # tries that are one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Geotags:
    """Attributes:
    rows: (n,) of the map's images. xy: (n, 2) where they say they are, metres. sigma_m: (n,) per axis.
    """

    rows: NDArray[np.int64]
    xy: FloatArray
    sigma_m: FloatArray

    def cost(self, plan: StreetPlan, size: float, turn: float) -> float:
        """Squared sigmas that a size and heading leave, each tag's bounded: some are wrong."""
        off = self._offsets(plan, size, turn)
        squared = np.square((off - np.median(off, axis=0)) / self.sigma_m[:, None]).sum(axis=1)
        return float(np.minimum(squared, _WRONG).sum())

    def log_likelihood(self, centers: FloatArray) -> float:
        """Of all photos' places (c, 2), less that of the tags' own; each tag's is bounded: some are wrong."""
        off = (self.xy - centers[self.rows]) / (_LOOSE * self.sigma_m[:, None])
        return -0.5 * float(np.minimum(np.square(off).sum(axis=1), _WRONG).sum())

    def circle(self, plan: StreetPlan, size: float, turn: float) -> Circle:
        """x, y and radius of where the middle of the plan's cameras may be."""
        return self._about(self._offsets(plan, size, turn), _NEAR_M)

    def around(self, reach_m: float) -> Circle:
        """x, y and radius of what lies within a reach of where the photos may have been taken."""
        return self._about(self.xy, reach_m)

    def _about(self, xy: FloatArray, reach_m: float) -> Circle:
        x, y = np.median(xy, axis=0).tolist()
        sigma = _LOOSE * float(np.sum(self.sigma_m**-2.0)) ** -0.5
        return x, y, _SIGMAS * sigma + reach_m

    def _offsets(self, plan: StreetPlan, size: float, turn: float) -> FloatArray:
        cos, sin = np.cos(turn), np.sin(turn)
        at = size * plan.centers[self.rows, :2] @ np.array([[cos, sin], [-sin, cos]])
        return np.asarray(self.xy - at)


class PlanSearch:
    """A scan's fronts and buildings in the frequency domain."""

    def __init__(self, shape: ScanShape) -> None:
        step = round(_CELL_M / CELL_M)
        rows, columns = (n // step for n in shape.top.shape)
        self._corner, self._shape = shape.corner, (rows, columns)
        self._padded = [fft.next_fast_len(n + 2 * _REACH_CELLS, real=True) for n in self._shape]
        part = np.s_[: rows * step, : columns * step]
        high = (shape.top - shape.ground > HIGH_M)[part].reshape(rows, step, columns, step).mean(axis=(1, 3))
        self._known = shape.known[part].reshape(rows, step, columns, step).mean(axis=(1, 3)) > 0.5
        at = np.floor((shape.walls[:, :2] - shape.corner) / _CELL_M).astype(np.int64)
        inside = ((at >= 0) & (at < np.array([columns, rows]))).all(axis=1)
        at, out = at[inside], shape.walls[inside, 2:4]
        channels = np.zeros((len(_harmonics(out)), *self._shape))
        for picture, values in zip(channels, _harmonics(out), strict=True):
            np.add.at(picture, (at[:, 1], at[:, 0]), values)
        strength = gaussian_filter(channels[0], _BLUR_CELLS)
        scale = 1.0 / np.percentile(strength[strength > 1e-3], 75) if (strength > 1e-3).any() else 1.0
        self._channels = [
            self._forward(np.clip(scale * gaussian_filter(of, _BLUR_CELLS), -1, 1)) for of in channels
        ]
        self._high = self._forward(high)
        self._open = (high < 0.5) & self._known

    def tries(
        self, plan: StreetPlan, sizes: Sequence[float], turns: Sequence[float], tags: "Geotags | None"
    ) -> list[PlanTry]:
        """The best places at each size, with the heading, near the geotags where there are any."""
        found: list[PlanTry] = []
        ways = [(size, turn) for size in sizes for turn in turns]
        costs = [0.0 if tags is None else tags.cost(plan, size, turn) for size, turn in ways]
        allowed = min(costs) + (0.0 if tags is None else _WRONG * max(2.0, len(tags.rows) / 3.0))
        for size in sizes:
            at_size: list[PlanTry] = []
            near = [t for (of, t), cost in zip(ways, costs, strict=True) if of == size and cost <= allowed]
            if near:
                cells = _cells(plan, size)
            for turn in near:
                circle = None if tags is None else tags.circle(plan, size, turn)
                at_size += self._best(*cells, size, turn, circle)
            best = sorted(at_size, key=lambda one: one.agreeing, reverse=True)
            found += first_apart(best, _same, _OF_SIZE)
        return found

    def _best(
        self, fronts: FloatArray, free: FloatArray, size: float, turn: float, circle: Circle | None
    ) -> list[PlanTry]:
        cos, sin = np.cos(turn), np.sin(turn)
        rotation = np.array([[cos, -sin], [sin, cos]])
        at, out = fronts[:, :2] @ rotation.T, fronts[:, 2:4] @ rotation.T
        score = np.zeros([self._padded[0], self._padded[1] // 2 + 1], np.complex64)
        for channel, values in zip(self._channels, _harmonics(out), strict=True):
            score += channel * np.conj(self._forward(self._splat(at, fronts[:, 4] * values)))
        ways = self._splat(free[:, :2] @ rotation.T, free[:, 2])
        score -= _FREE_WEIGHT * self._high * np.conj(self._forward(ways))
        picture = fft.irfft2(score, self._padded)[: self._shape[0], : self._shape[1]]
        over = picture / max(float(fronts[:, 4].sum()), 1.0)
        usable, first = self._open, np.zeros(2, np.int64)
        if circle is not None:
            x, y, radius = circle
            middle = (np.array([y, x]) - self._corner[::-1]) / _CELL_M
            first = np.clip(np.floor(middle - radius / _CELL_M), 0, self._shape).astype(np.int64)
            last = np.clip(np.ceil(middle + radius / _CELL_M), 0, self._shape).astype(np.int64)
            part = np.s_[first[0] : last[0], first[1] : last[1]]
            rows, columns = np.indices(self._shape, sparse=True)
            away = np.hypot((rows[part[0]] + 0.5 - middle[0]), (columns[:, part[1]] + 0.5 - middle[1]))
            usable, over = usable[part] & (away < radius / _CELL_M), over[part]
        if usable.size <= _PEAKS:
            return []
        over = np.where(usable, over, -np.inf)
        values = np.where(over == maximum_filter(over, 7), over, -np.inf).ravel()
        best = np.argpartition(values, -_PEAKS)[-_PEAKS:]
        rows, columns = np.unravel_index(best, over.shape)
        places = self._corner + (np.column_stack([columns, rows]) + first[::-1] + 0.5) * _CELL_M
        return [
            PlanTry(size=size, turn=turn, middle=place, agreeing=float(values[k]))
            for k, place in zip(best, places, strict=True)
            if np.isfinite(values[k])
        ]

    def _splat(self, at: FloatArray, values: FloatArray) -> NDArray[np.float32]:
        """Values at places (n, 2) in metres around the middle, which is cell (0, 0)."""
        picture = np.zeros(self._padded, np.float32)
        cells = np.round(at / _CELL_M).astype(np.int64)
        np.add.at(picture, (cells[:, 1] % self._padded[0], cells[:, 0] % self._padded[1]), values)
        return picture

    def _forward(self, of: NDArray[np.generic]) -> NDArray[np.complex64]:
        return np.asarray(fft.rfft2(np.asarray(of, dtype=np.float32), self._padded))


def _same(one: PlanTry, other: PlanTry) -> bool:
    away, turn = one.apart(other)
    size = abs(np.log(one.size / other.size))
    return bool(away < _NEAR_M and turn < _NEAR_TURN and size < _NEAR_SIZE)


def _harmonics(out: FloatArray) -> list[FloatArray]:
    """Of directions (n, 2): the sum of products is 3 for the same, 1 for the opposite, -1 across."""
    x, y = out[:, 0], out[:, 1]
    return [np.full(len(x), 1.0), 1.0 * x, 1.0 * y, x * x - y * y, 2.0 * x * y]


def _cells(plan: StreetPlan, size: float) -> tuple[FloatArray, FloatArray]:
    """Fronts (k, 5): x, y, way out, weight, one for each metre; and open cells (j, 3): x, y, weight."""
    xy, out = size * plan.fronts[:, :2], plan.fronts[:, 3:5]
    turned = np.round(np.arctan2(out[:, 1], out[:, 0]) / (np.pi / 4)).astype(np.int64) % 8
    keys = 8 * _numbered(np.floor(xy / _CELL_M).astype(np.int64)) + turned
    _, group, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(group, of) for of in (xy[:, 0], xy[:, 1], out[:, 0], out[:, 1])]
    way = np.column_stack(sums[2:]).astype(np.float64)
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    fronts = np.column_stack([sums[0] / count, sums[1] / count, way, np.minimum(count / 3.0, 1.0)])
    near = np.hypot(fronts[:, 0], fronts[:, 1]) < _REACH_CELLS * _CELL_M
    start, end = size * plan.free[:, :2], size * plan.free[:, 2:]
    shares = np.linspace(0.0, 1.0, 40)[:, None, None]
    along = (start + shares * (end - start)).reshape(-1, 2)
    along = along[np.hypot(along[:, 0], along[:, 1]) < _REACH_CELLS * _CELL_M]
    cells = np.floor(along / _CELL_M).astype(np.int64)
    _, first, seen = np.unique(_numbered(cells), return_index=True, return_counts=True)
    often = cells[first[seen >= 3]]
    return fronts[near], np.column_stack([(often + 0.5) * _CELL_M, np.ones(len(often))])


def _numbered(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) a number for each of cells (n, 2), in the order of x, then y; beyond a million they are one."""
    near = np.clip(cells, -(1 << 20), (1 << 20) - 1)
    return np.asarray((near[:, 0] << 21) + near[:, 1])
