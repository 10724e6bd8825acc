"""How late the telemetry of a film is: when the picture moves fast, and when the receiver says that it does.

Recorders write a position that is some tenths of a second old. While a drone starts, turns and stops, the
picture's speed and the receiver's are the same curve, shifted. At a constant speed there is no curve, and
nothing is said.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry
from ingest.video.motion import Motion

_EARTH_M_PER_DEG = 111_320.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LagOptions:
    """When a lag is believed.

    Attributes:
        most_s: that is looked for. step_s: of the search.
        smooth_s: speeds are means over so long; receivers smooth, too, and pictures shake.
        least_s: of film that both know.
        min_correlation: of the two curves at the best lag.
        min_drop: how much less it is, half a second off to either side.
    """

    most_s: float = 3.0
    step_s: float = 0.05
    smooth_s: float = 0.5
    least_s: float = 5.0
    min_correlation: float = 0.8
    min_drop: float = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Lag:
    """What was found.

    Attributes:
        late_s: telemetry shown at t + late_s is that of the picture at t; None: not known.
        correlation: at the best lag, NaN where none could be tried.
        message: for people.
    """

    late_s: float | None
    correlation: float
    message: str


def estimate_lag(motion: Motion, telemetry: Telemetry, options: LagOptions | None = None) -> Lag:
    """The lag of the telemetry behind the picture."""
    options = options or LagOptions()
    picture_s, picture = _picture_speed(motion)
    receiver_s, receiver = _receiver_speed(telemetry)
    if len(picture_s) < 10 or len(receiver_s) < 10:
        return Lag(late_s=None, correlation=float("nan"), message="too few samples to tell the lag")
    grid = np.arange(picture_s[0], picture_s[-1], options.step_s)
    known = ~_far(grid, picture_s)
    ours = _smoothed(np.interp(grid, picture_s, picture), options)
    lags = np.arange(-options.most_s, options.most_s + 0.5 * options.step_s, options.step_s)
    found = np.full(len(lags), np.nan)
    for k, lag in enumerate(lags):
        both = known & ~_far(grid + lag, receiver_s)
        if both.sum() * options.step_s < options.least_s:
            continue
        theirs = _smoothed(np.interp(grid + lag, receiver_s, receiver), options)
        found[k] = _correlation(ours[both], theirs[both])
    if not np.isfinite(found).any():
        return Lag(
            late_s=None,
            correlation=float("nan"),
            message=f"picture and telemetry have no {options.least_s:g} s in common to tell the lag by",
        )
    best = int(np.nanargmax(found))
    aside = round(0.5 / options.step_s)
    drops = [found[best] - found[k] for k in (best - aside, best + aside) if 0 <= k < len(lags)]
    drop = float(np.nanmin(drops)) if np.isfinite(drops).any() else 0.0
    correlation = float(found[best])
    if len(drops) < 2 or correlation < options.min_correlation or drop < options.min_drop:
        return Lag(
            late_s=None,
            correlation=correlation,
            message=f"speeds of picture and telemetry do not tell the lag (correlation {correlation:.2f}, "
            f"{drop:.3f} less half a second off)",
        )
    late = round(float(lags[best]), 3)
    return Lag(
        late_s=late,
        correlation=correlation,
        message=f"telemetry is {late:+.2f} s late by the speeds of picture and receiver (correlation "
        f"{correlation:.2f})",
    )


def _picture_speed(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Times between frames, and by how much of its side the picture moves a second."""
    if len(motion) < 2:
        return np.zeros(0), np.zeros(0)
    between = np.diff(motion.time_s)
    way = np.linalg.norm(motion.step[1:, :, 2], axis=1)
    good = ~motion.broken[1:] & (between > 0)
    middle = 0.5 * (motion.time_s[1:] + motion.time_s[:-1])
    return middle[good], way[good] / between[good]


def _receiver_speed(telemetry: Telemetry) -> tuple[FloatArray, FloatArray]:
    """Times between samples, and the horizontal speed over the height, as far as that is known: 1/s.

    Samples that repeat the position before are no movement but a slower receiver.
    """
    known = np.flatnonzero(telemetry.has_position)
    if len(known) < 2:
        return np.zeros(0), np.zeros(0)
    latitude, longitude = telemetry.latitude_deg[known], telemetry.longitude_deg[known]
    moved = np.concatenate([[True], (np.diff(latitude) != 0) | (np.diff(longitude) != 0)])
    rows = known[moved]
    if len(rows) < 2:
        return np.zeros(0), np.zeros(0)
    times = telemetry.times_s[rows]
    north = telemetry.latitude_deg[rows] * _EARTH_M_PER_DEG
    east = telemetry.longitude_deg[rows] * _EARTH_M_PER_DEG * np.cos(np.radians(np.median(latitude)))
    between = np.diff(times)
    speed = np.hypot(np.diff(east), np.diff(north)) / between
    return 0.5 * (times[1:] + times[:-1]), speed


def _far(times_s: FloatArray, known_s: FloatArray) -> NDArray[np.bool_]:
    """Which of the times are more than a second from all that are known."""
    place = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
    near = np.minimum(np.abs(times_s - known_s[place - 1]), np.abs(times_s - known_s[place]))
    return np.asarray(near > 1.0)


def _smoothed(values: FloatArray, options: LagOptions) -> FloatArray:
    width = max(1, round(options.smooth_s / options.step_s))
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / size if size > 1e-12 else float("nan")
