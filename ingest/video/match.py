"""How well the movements of picture and receiver agree, for every beginning of the film in a log at once.

Two things are compared: how fast it goes (the picture's middle, and over ground), and how quickly it turns
(the picture, and the course). Each is a curve over time; Fourier transforms give its correlation for all
shifts at once, hours of log in a second.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry
from ingest.video.motion import Motion

_EARTH_M_PER_DEG = 111_320.0
# Receivers tell a place once a second or oftener; what repeats for longer stands still.
_HELD_S = 2.0
_WILD_M_S = 150.0  # no drone and no car, as in `featuredb.video.telemetry.values`
# Slower than this a course is the receiver's noise; turning faster than this it is no flight's.
_COURSE_M_S, _COURSE_RAD_S = 1.5, 1.5
_FEWEST = 10  # samples of a curve
STEP_S = 0.05  # of the shifts
_SMOOTH_S = 0.5  # curves are means over so long; receivers smooth, too, and pictures shake
LEAST_S = 5.0  # of film that both must know


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """How well picture and receiver agree, by how late the telemetry is taken to be.

    Attributes:
        lags_s: (m,) rising; telemetry of t + lag is laid on the picture of t.
        speed: (m,) correlation of the speeds, NaN where too little is known of both or nothing changes.
        turn: (m,) correlation of the turns, NaN likewise.
        speed_samples, turn_samples: (m,) how many independent samples these have, less three.
    """

    lags_s: FloatArray
    speed: FloatArray
    turn: FloatArray
    speed_samples: FloatArray
    turn_samples: FloatArray

    @property
    def evidence(self) -> FloatArray:
        """(m,) how much likelier, as a natural logarithm, the curves are one with noise than strangers.

        0 where nothing speaks for it.
        """
        return _evidence(self.speed, self.speed_samples) + _evidence(self.turn, self.turn_samples)

    def luck(self, best: int) -> FloatArray:
        """(m,) standard deviation of the difference of the evidence to that of one row by chance alone.

        After Vuong (Econometrica 57, 1989): n (1 - c^2) is its variance for residuals of the correlation c.
        Residuals that share nothing but the picture have the c here; it is not less than 0, so that lags at
        which the log repeats itself are not told apart by its noise.
        """
        total = np.zeros(len(self.lags_s))
        for r, n in ((self.speed, self.speed_samples), (self.turn, self.turn_samples)):
            left, own = 1.0 - _positive(r) ** 2, 1.0 - float(_positive(r[best])) ** 2
            common = np.maximum(left + own - 1.0, 0.0) / np.sqrt(left * own)
            total += np.maximum(n, n[best]) * (1.0 - np.minimum(common, 1.0) ** 2)
        return np.sqrt(total)


class _Curve(NamedTuple):
    """Rising times (n,) in seconds, and values (n,)."""

    times_s: FloatArray
    values: FloatArray


def match_movement(
    motion: Motion, telemetry: Telemetry, range_s: tuple[float, float], least_s: float = LEAST_S
) -> Match | None:
    """Compare at all lags of a range; None where picture or receiver have too few samples for their speeds.

    Args:
        range_s: lowest and highest lag.
        least_s: of film that both must know.
    """
    speeds, receiver = _picture_speeds(motion), _receiver_speed(telemetry)
    if min(len(speeds[0].times_s), len(receiver.times_s)) < _FEWEST:
        return None
    first, last = (round(float(end) / STEP_S) for end in range_s)
    speed, samples = _slid(speeds[0], receiver, first, last, least_s)
    other, other_samples = _slid(speeds[1], receiver, first, last, least_s)
    better = _evidence(other, other_samples) > _evidence(speed, samples)
    turn, turn_samples = _slid(_picture_turn(motion), _course_turn(telemetry), first, last, least_s)
    return Match(
        lags_s=np.asarray(STEP_S * np.arange(first, last + 1), dtype=np.float64),
        speed=np.where(better, other, speed),
        turn=turn,
        speed_samples=np.where(better, other_samples, samples),
        turn_samples=turn_samples,
    )


def _positive(correlation: FloatArray) -> FloatArray:
    return np.clip(np.nan_to_num(correlation), 0.0, 1.0 - 1e-9)


def _evidence(correlation: FloatArray, samples: FloatArray) -> FloatArray:
    return np.asarray(-0.5 * samples * np.log1p(-(_positive(correlation) ** 2)))


def _picture_speeds(motion: Motion) -> tuple[_Curve, _Curve]:
    """Square root of how much of its side the picture moves a second, in two ways.

    A camera that turns moves what it sees, too. The second way leaves out what goes along with the rotation
    of the picture, which a turning drone's has as it looks down; the first is right where a drone circles a
    place, and rotation and movement are one. Roots make less of the moments in which the camera tilts.
    """
    times, step, between = _steps(motion)
    way = step[:, :, 2] / between[:, None]
    turn = np.arctan2(step[:, 1, 0], step[:, 0, 0]) / between
    turned = float(turn @ turn)
    straight = way - np.outer(turn, turn @ way / turned) if turned > 0.0 else way
    first, second = (np.sqrt(np.linalg.norm(w, axis=1)) for w in (way, straight))
    return _Curve(times, first), _Curve(times, second)


def _picture_turn(motion: Motion) -> _Curve:
    """How fast the camera turns clockwise, seen from above, as far as it looks down: radians a second."""
    times, step, between = _steps(motion)
    return _Curve(times, -np.arctan2(step[:, 1, 0], step[:, 0, 0]) / between)


def _steps(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times between frames, the similarities (n, 2, 3) from one to the next, and the seconds between."""
    between = np.diff(motion.time_s)
    good = ~motion.broken[1:] & (between > 0)
    middle = 0.5 * (motion.time_s[1:] + motion.time_s[:-1])
    return middle[good], motion.step[1:][good], between[good]


def _receiver_speed(telemetry: Telemetry) -> _Curve:
    """Square root of the speed over ground, m/s."""
    times, east, north = _places(telemetry)
    between = np.diff(times)
    speed = np.hypot(np.diff(east), np.diff(north)) / between
    # One wrong fix is a speed that nothing else in the log stands beside.
    good = speed < _WILD_M_S
    return _Curve((0.5 * (times[1:] + times[:-1]))[good], np.sqrt(speed[good]))


def _course_turn(telemetry: Telemetry) -> _Curve:
    """How fast the course over ground turns clockwise, radians a second, where there is one."""
    times, east, north = _places(telemetry)
    if len(times) < 3:
        return _Curve(np.zeros(0), np.zeros(0))
    # A course of places that are half a second apart: nearer ones differ by the receiver's noise.
    apart = max(1, round(0.5 / float(np.median(np.diff(times)))))
    de, dn = east[apart:] - east[:-apart], north[apart:] - north[:-apart]
    dt, middle = times[apart:] - times[:-apart], 0.5 * (times[apart:] + times[:-apart])
    course, speed = np.unwrap(np.arctan2(de, dn)), np.hypot(de, dn) / dt
    turn = (course[apart:] - course[:-apart]) / (middle[apart:] - middle[:-apart])
    good = np.minimum(speed[apart:], speed[:-apart]) > _COURSE_M_S
    good &= (np.abs(turn) < _COURSE_RAD_S) & (np.maximum(speed[apart:], speed[:-apart]) < _WILD_M_S)
    return _Curve((0.5 * (middle[apart:] + middle[:-apart]))[good], turn[good])


def _places(telemetry: Telemetry) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Seconds, metres east and north of the samples that tell a place anew.

    Samples that repeat the position before are no movement but a slower receiver, unless they do so for long.
    """
    known = np.flatnonzero(telemetry.has_position)
    if not len(known):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    latitude, longitude = telemetry.latitude_deg[known], telemetry.longitude_deg[known]
    times = telemetry.times_s[known]
    moved = np.concatenate([[True], (np.diff(latitude) != 0) | (np.diff(longitude) != 0)])
    begun = times[np.maximum.accumulate(np.where(moved, np.arange(len(known)), 0))]
    held = np.floor((times - begun) / _HELD_S)
    rows = moved | (np.diff(held, prepend=0.0) > 0)
    east = np.unwrap(longitude[rows], period=360.0) * _EARTH_M_PER_DEG
    return (times[rows], east * np.cos(np.radians(np.median(latitude))), latitude[rows] * _EARTH_M_PER_DEG)


def _slid(
    ours: _Curve, theirs: _Curve, first: int, last: int, least_s: float
) -> tuple[FloatArray, FloatArray]:
    """Correlation and independent samples at the lags first to last, in steps; NaN and 0 where none."""
    correlation, samples = np.full(last + 1 - first, np.nan), np.zeros(last + 1 - first)
    if min(len(ours.times_s), len(theirs.times_s)) < _FEWEST:
        return correlation, samples
    step = STEP_S
    ours_s = np.arange(ours.times_s[0], ours.times_s[-1], step)
    # Lags are multiples of the step, and the receiver's grid is the picture's, carried on.
    begin = max(first, int(np.floor((theirs.times_s[0] - ours_s[0]) / step)) - len(ours_s))
    end = min(last, int(np.ceil((theirs.times_s[-1] - ours_s[0]) / step)))
    if begin > end:
        return correlation, samples
    theirs_s = ours_s[0] + step * np.arange(begin, end + len(ours_s))
    a, a_known = _sampled(ours, ours_s)
    b, b_known = _sampled(theirs, theirs_s)
    if not (a_known.any() and b_known.any()):
        return correlation, samples
    count, found = _correlations(a, a_known, b, b_known)
    found[step * count < least_s] = np.nan
    correlation[begin - first : end - first + 1] = found
    # Three samples fit any two curves: as for Fisher's transform, they are no evidence.
    free = np.maximum(step * count / _memory_s(a[a_known], b[b_known], step) - 3.0, 0.0)
    samples[begin - first : end - first + 1] = np.where(np.isfinite(found), free, 0.0)
    return correlation, samples


def _sampled(curve: _Curve, times_s: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Smooth values at evenly spaced times, and which are no more than a second from a sample."""
    place = np.clip(np.searchsorted(curve.times_s, times_s), 1, len(curve.times_s) - 1)
    near = np.minimum(np.abs(times_s - curve.times_s[place - 1]), np.abs(times_s - curve.times_s[place]))
    width = max(1, round(_SMOOTH_S / STEP_S))
    values = np.interp(times_s, curve.times_s, curve.values)
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid"), near <= 1.0


def _correlations(
    ours: FloatArray, known: NDArray[np.bool_], theirs: FloatArray, theirs_known: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Samples that both know, and their correlation, with ours laid on each place of theirs.

    By Fourier transforms of values and masks (Padfield, Masked object registration in the Fourier domain,
    2012). NaN where a curve does not change.
    """
    a, b = _standard(ours, known), _standard(theirs, theirs_known)
    one, other = known.astype(np.float64), theirs_known.astype(np.float64)

    def slid(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(correlate(y, x, mode="valid", method="fft"))

    count = np.round(slid(one, other))
    n = np.maximum(count, 1.0)
    mean_a, mean_b = slid(a, other) / n, slid(one, b) / n
    spread_a = slid(a * a, other) / n - mean_a**2
    spread_b = slid(one, b * b) / n - mean_b**2
    both = slid(a, b) / n - mean_a * mean_b
    # Transforms leave errors of 1e-12 of the largest sums: less spread than this is none.
    good = (count > 2) & (spread_a > 1e-6) & (spread_b > 1e-6)
    found = np.full(len(count), np.nan)
    found[good] = np.clip(both[good] / np.sqrt(spread_a[good] * spread_b[good]), -1.0, 1.0)
    return count, found


def _standard(values: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """Values with mean 0 and deviation 1 over those that are known, and 0 for the others."""
    some = values[known]
    if some.std() < 1e-9 * max(1.0, float(np.abs(some).max())):
        return np.zeros(len(values))
    return np.where(known, (values - some.mean()) / some.std(), 0.0)


def _memory_s(ours: FloatArray, theirs: FloatArray, step_s: float) -> float:
    """After how many seconds a further sample is news, so that a correlation has one of them in so long.

    One and twice the sum of the products of both autocorrelations (Bartlett 1935), up to where either curve
    has forgotten.
    """
    size = min(len(ours), len(theirs))
    if size < 2:
        return step_s
    product = _autocorrelation(ours, size) * _autocorrelation(theirs, size)
    ends = np.flatnonzero(product <= 0.0)
    return step_s * (1.0 + 2.0 * float(product[1 : ends[0] if ends.size else size].sum()))


def _autocorrelation(values: FloatArray, size: int) -> FloatArray:
    """(size,) from lag 0, where it is 1, to the first that is not above 0; 0 from there on."""
    away = values - values.mean()
    total = float((away**2).sum())
    if total < 1e-12:
        return np.zeros(size)
    found = np.asarray(correlate(away, away, mode="full", method="fft")[len(away) - 1 :][:size] / total)
    forgotten = np.flatnonzero(found <= 0.0)
    if forgotten.size:
        found[forgotten[0] :] = 0.0
    return found
