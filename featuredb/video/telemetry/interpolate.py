"""Interpolation over time of columns with holes. NaN means "not known" on both sides."""

import numpy as np

from featuredb.geometry.arrays import FloatArray


def interpolate(
    times_s: FloatArray,
    values: FloatArray,
    wanted_s: FloatArray,
    *,
    max_gap_s: float,
    reach_s: float,
    circle: bool = False,
) -> FloatArray:
    """Values at the wanted times: linear between known samples, held for a moment at their ends.

    Args:
        times_s: (n,) seconds, strictly increasing.
        values: (n,), NaN where not known.
        wanted_s: (m,) seconds, finite, any order.
        max_gap_s: no interpolation between known samples that lie farther apart than this.
        reach_s: before the first, after the last and at the edges of longer gaps a value holds this long.
        circle: values are degrees; between two the shorter way is taken, answers lie in [-180, 180).

    Returns:
        (m,) float64, NaN where nothing is known.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if not rows.size:
        return np.full(wanted_s.shape, np.nan)
    times, known = times_s[rows], values[rows]
    after = np.searchsorted(times, wanted_s, side="left")
    left, right = np.clip(after - 1, 0, len(times) - 1), np.clip(after, 0, len(times) - 1)
    gap = times[right] - times[left]
    inside = (wanted_s >= times[0]) & (wanted_s <= times[-1])
    joined = inside & (gap <= max_gap_s)
    weight = np.where(joined, (wanted_s - times[left]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    to_left, to_right = np.abs(wanted_s - times[left]), np.abs(times[right] - wanted_s)
    near = np.minimum(to_left, to_right) <= reach_s
    held = np.where(near, known[np.where(to_left <= to_right, left, right)], np.nan)
    step = known[right] - known[left]
    found = np.where(joined, known[left] + weight * (wrap_degrees(step) if circle else step), held)
    return wrap_degrees(found) if circle else found


def wrap_degrees(degrees: FloatArray) -> FloatArray:
    """The same angles in [-180, 180); NaN stays, and so do to the last digit those that lie there already."""
    wrapped: FloatArray = (degrees + 180.0) % 360.0 - 180.0
    # The remainder of a tiny negative number rounds to the divisor itself.
    wrapped = np.where(wrapped >= 180.0, -180.0, wrapped)
    return np.where((degrees >= -180.0) & (degrees < 180.0), degrees, wrapped)
