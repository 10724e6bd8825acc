"""Interpolation over time of columns with holes. NaN means "not known" on both sides."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


class _Neighbours(NamedTuple):
    """For each wanted time the known samples around it, as indices into the known ones."""

    known: NDArray[np.intp]
    left: NDArray[np.intp]
    right: NDArray[np.intp]
    weight: FloatArray  # of the right one, 0 to 1
    joined: NDArray[np.bool_]  # both are near enough to each other to interpolate between
    nearest: NDArray[np.intp]
    near: NDArray[np.bool_]  # not joined, but the nearest one is within reach


def interpolate(
    times_s: FloatArray, values: FloatArray, wanted_s: FloatArray, *, max_gap_s: float, reach_s: float
) -> FloatArray:
    """Values at the wanted times: linear between known samples, held for a moment at their ends.

    Args:
        times_s: (n,) seconds, strictly increasing.
        values: (n,), NaN where not known.
        wanted_s: (m,) seconds, finite, any order.
        max_gap_s: no interpolation between known samples that lie farther apart than this.
        reach_s: before the first, after the last and at the edges of longer gaps a value holds this long.

    Returns:
        (m,) float64, NaN where nothing is known.
    """
    around = _neighbours(times_s, values, wanted_s, max_gap_s, reach_s)
    if around is None:
        return np.full(wanted_s.shape, np.nan)
    known = values[around.known]
    step = known[around.right] - known[around.left]
    return _choose(around, known, known[around.left] + around.weight * step)


def interpolate_angles(
    times_s: FloatArray, degrees: FloatArray, wanted_s: FloatArray, *, max_gap_s: float, reach_s: float
) -> FloatArray:
    """As `interpolate`, around the circle by the shorter way; the answer lies in [-180, 180)."""
    around = _neighbours(times_s, degrees, wanted_s, max_gap_s, reach_s)
    if around is None:
        return np.full(wanted_s.shape, np.nan)
    known = degrees[around.known]
    step = wrap_degrees(known[around.right] - known[around.left])
    return wrap_degrees(_choose(around, known, known[around.left] + around.weight * step))


def wrap_degrees(degrees: FloatArray) -> FloatArray:
    """The same angles in [-180, 180); NaN stays, and so do to the last digit those that lie there already."""
    wrapped: FloatArray = (degrees + 180.0) % 360.0 - 180.0
    # The remainder of a tiny negative number rounds to the divisor itself.
    wrapped = np.where(wrapped >= 180.0, -180.0, wrapped)
    return np.where((degrees >= -180.0) & (degrees < 180.0), degrees, wrapped)


def _neighbours(
    times_s: FloatArray, values: FloatArray, wanted_s: FloatArray, max_gap_s: float, reach_s: float
) -> _Neighbours | None:
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return None
    times = times_s[known]
    after = np.searchsorted(times, wanted_s, side="left")
    left, right = np.clip(after - 1, 0, len(times) - 1), np.clip(after, 0, len(times) - 1)
    gap = times[right] - times[left]
    inside = (wanted_s >= times[0]) & (wanted_s <= times[-1])
    joined = inside & (gap <= max_gap_s)
    weight = np.where(joined, (wanted_s - times[left]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    to_left, to_right = np.abs(wanted_s - times[left]), np.abs(times[right] - wanted_s)
    nearest = np.where(to_left <= to_right, left, right)
    near = ~joined & (np.minimum(to_left, to_right) <= reach_s)
    return _Neighbours(known, left, right, weight, joined, nearest, near)


def _choose(around: _Neighbours, known: FloatArray, between: FloatArray) -> FloatArray:
    held = np.where(around.near, known[around.nearest], np.nan)
    return np.where(around.joined, between, held)
