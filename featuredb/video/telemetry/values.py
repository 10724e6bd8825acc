"""The telemetry of one video as a value: samples over time, and what is known about them.

From the raw columns of any format to a `Telemetry`: what cannot be true becomes "not known", with a line.

Nothing is invented and nothing is repaired: a position out of range, at 0, 0 or without a fix is NaN. Samples
whose time does not advance are left out. A file without any position is refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError, TelemetryError
from featuredb.geo.datum import HeightDatum, check_datum
from featuredb.geometry.arrays import FloatArray, freeze, frozen_array

Clock = Literal["utc", "local", "none"]
CLOCKS: tuple[Clock, ...] = get_args(Clock)

# Between samples so far apart a straight line errs by a T^2 / 8: a drone that turns with 3 m/s2 strays 3.4 m
# in 3 s, as much as its receiver does.
_MAX_GAP_S = 3.0

# All but the first two may be left out.
_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "relative_height_m", "gimbal_ypr_deg", "clock_s")
_STRAIGHT = ("latitude_deg", "height_m", "relative_height_m", "clock_s")  # others go around the circle


def _not_known() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TelemetrySamples:
    """Samples of telemetry at some times. NaN is "not known"; a column left out is NaN throughout.

    Attributes:
        times_s: (n,) float64, seconds of the video (or since the first sample, see `Telemetry`), finite.
        latitude_deg, longitude_deg: (n,) float64, WGS84 degrees; in one sample both are known or neither.
        height_m: (n,) metres above the datum that `Telemetry.height_datum` names.
        relative_height_m: (n,) metres above the place of take-off.
        gimbal_ypr_deg: (n, 3) yaw clockwise from true north, pitch (-90 looks down), roll of the camera.
        clock_s: (n,) wall clock, seconds since 1970-01-01T00:00:00 of the clock that `Telemetry.clock` names.
    """

    times_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    height_m: FloatArray = field(default_factory=_not_known)
    relative_height_m: FloatArray = field(default_factory=_not_known)
    gimbal_ypr_deg: FloatArray = field(default_factory=_not_known)
    clock_s: FloatArray = field(default_factory=_not_known)

    def __post_init__(self) -> None:
        freeze(self, times_s=(None,))
        for name in _COLUMNS:
            given, shape = getattr(self, name), (len(self), 3) if name == "gimbal_ypr_deg" else (len(self),)
            if name in _COLUMNS[2:] and not np.size(given):
                given = np.full(shape, np.nan)
            column = frozen_array(f"TelemetrySamples.{name}", given, shape, nan=True)
            object.__setattr__(self, name, column)
        _check_positions(self.latitude_deg, self.longitude_deg)

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def has_position(self) -> NDArray[np.bool_]:
        """(n,) bool: the samples whose latitude and longitude are known."""
        return np.isfinite(self.latitude_deg)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telemetry(TelemetrySamples):
    """The telemetry that belongs to one video, at least one sample, in the order of time.

    `times_s` is strictly increasing. For telemetry that lives in the video or in its subtitles it is time of
    the video (the container's clock). Where `in_video_time` is False (GPX, tables) it counts from the first
    sample or is a table's own elapsed time, and when the video began is for others to find out.

    Attributes:
        height_datum: what `height_m` is counted from; drones that do not say are "unknown".
        clock: what `clock_s` shows: "utc", "local" (the time of day on somebody's wall, zone not known), or
            "none". Local time is never taken for UTC.
        source: format and dialect.
        origin: the file and, where it holds several things, what in it.
        warnings: what was wrong or had to be decided, for people.
    """

    height_datum: HeightDatum = "unknown"
    clock: Clock = "none"
    in_video_time: bool = True
    source: str
    origin: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        TelemetrySamples.__post_init__(self)
        if not len(self):
            raise InvalidValueError("Telemetry: expected at least one sample, found none")
        if (np.diff(self.times_s) <= 0.0).any():
            raise InvalidValueError("Telemetry.times_s: expected strictly increasing times")
        check_datum(self.height_datum)
        if self.clock not in CLOCKS:
            raise InvalidValueError(f"Telemetry.clock: expected one of {CLOCKS}, found {self.clock!r}")
        if (self.clock == "none") != bool(np.isnan(self.clock_s).all()):
            raise InvalidValueError(
                f"Telemetry: clock {self.clock!r} with {np.isfinite(self.clock_s).sum()} readings of it; "
                'expected "none" exactly where there are none'
            )

    def at(self, times_s: ArrayLike) -> TelemetrySamples:
        """Samples at other times, each column by itself.

        Linear between neighbouring samples that know the value and are at most 3 s apart; angles and
        longitude go around the circle by the shorter way. Beyond the ends, and at the edges of longer gaps, a
        value holds for half the usual distance of two samples; farther away it is NaN. Yaw, pitch and roll
        are interpolated one by one, which is right where the camera turns little between samples and does
        not look straight down or up while it turns (there yaw and roll mean the same).

        Args:
            times_s: (m,) seconds on the clock of `self.times_s`, finite, any order.

        Raises:
            InvalidValueError: times not finite.
        """
        wanted = frozen_array("Telemetry.at", np.atleast_1d(np.asarray(times_s)), (None,))
        reach = 0.5 * float(np.median(np.diff(self.times_s))) if len(self) > 1 else 0.0

        def line(values: FloatArray, circle: bool = False) -> FloatArray:
            return _interpolated(self.times_s, values, wanted, reach, circle)

        columns = {name: line(getattr(self, name)) for name in _STRAIGHT}
        ypr = np.stack([line(angle, circle=True) for angle in self.gimbal_ypr_deg.T], axis=1)
        longitude = line(self.longitude_deg, circle=True)
        return TelemetrySamples(times_s=wanted, longitude_deg=longitude, gimbal_ypr_deg=ypr, **columns)


def _check_positions(latitude_deg: FloatArray, longitude_deg: FloatArray) -> None:
    if (np.isnan(latitude_deg) != np.isnan(longitude_deg)).any():
        raise InvalidValueError(
            "TelemetrySamples: latitude and longitude must be known together or not at all"
        )
    bad = (np.abs(latitude_deg) > 90.0) | (np.abs(longitude_deg) > 180.0)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise InvalidValueError(
            "TelemetrySamples: expected latitudes in [-90, 90] and longitudes in [-180, 180] degrees, found "
            f"({latitude_deg[first]}, {longitude_deg[first]}) in sample {first}; check their order"
        )


def _interpolated(
    times_s: FloatArray, values: FloatArray, wanted_s: FloatArray, reach_s: float, circle: bool
) -> FloatArray:
    """One column of `Telemetry.at`: (m,) float64, NaN where nothing is known.

    Args:
        values: (n,), NaN where not known.
        reach_s: before the first, after the last and at the edges of longer gaps a value holds this long.
        circle: values are degrees; between two the shorter way is taken, answers lie in [-180, 180).
    """
    rows = np.flatnonzero(np.isfinite(values))
    if not rows.size:
        return np.full(wanted_s.shape, np.nan)
    times, known = times_s[rows], values[rows]
    after = np.searchsorted(times, wanted_s, side="left")
    left, right = np.clip(after - 1, 0, len(times) - 1), np.clip(after, 0, len(times) - 1)
    to_left, to_right = np.abs(wanted_s - times[left]), np.abs(times[right] - wanted_s)
    held = np.where(
        np.minimum(to_left, to_right) <= reach_s, known[np.where(to_left <= to_right, left, right)], np.nan
    )
    joined = (wanted_s >= times[0]) & (wanted_s <= times[-1]) & (times[right] - times[left] <= _MAX_GAP_S)
    line = np.interp(wanted_s, times, np.unwrap(known, period=360.0) if circle else known)
    found = np.where(joined, line, held)
    return wrap_degrees(found) if circle else found


def wrap_degrees(degrees: FloatArray) -> FloatArray:
    """The same angles in [-180, 180); NaN stays, and so do to the last digit those that lie there already."""
    wrapped: FloatArray = (degrees + 180.0) % 360.0 - 180.0
    # The remainder of a tiny negative number rounds to the divisor itself.
    wrapped = np.where(wrapped >= 180.0, -180.0, wrapped)
    return np.where((degrees >= -180.0) & (degrees < 180.0), degrees, wrapped)


# Nine hours at 60 samples a second: longer than any battery or memory card lasts.
MAX_SAMPLES = 2_000_000
MAX_WARNINGS = 20

METRES_PER_DEGREE = 111_195.0  # of a great circle of the mean Earth

_FIELDS = (
    "times_s", "latitude_deg", "longitude_deg", "height_m", "relative_height_m", "clock_s",
    "gimbal_yaw", "gimbal_pitch", "gimbal_roll",
)  # fmt: skip
_NULL_ISLAND_DEG = 1e-6
# As for photos: from below the Dead Sea's shore to above airliners; above take-off the same span downwards.
_HEIGHT_RANGE_M = (-500.0, 20_000.0)
_RELATIVE_HEIGHT_RANGE_M = (-9_000.0, 20_000.0)
CLOCK_RANGE_S = (315_532_800.0, 4_102_444_800.0)  # 1980, when GPS time begins, to 2100
# A clock that advances by so much more or less than the video between two samples: a cut, or it was set anew.
_CLOCK_JUMP_S = 2.0
# No drone and no car: 50 m and 150 m/s between one reading of the receiver and the next.
_LEAP_M, _LEAP_M_S = 50.0, 150.0


def assemble(
    raw: Mapping[str, FloatArray],
    *,
    source: str,
    origin: str,
    warnings: list[str],
    height_datum: HeightDatum = "unknown",
    clock: Clock = "none",
    in_video_time: bool = True,
    sort: bool = False,
) -> Telemetry:
    """The telemetry of raw samples; for what is not said here see `Telemetry`.

    Args:
        raw: columns (n,) float64 by the names of `_FIELDS`; NaN is "not known", and a column left out
            is NaN throughout. Without `times_s` they are those of `clock_s` since the first sample.
        warnings: what the reader has found; receives what is found here.
        clock: of the samples that have a reading of it.
        sort: by time, for formats that do not promise an order.

    Raises:
        TelemetryError: no samples, or none with a position.
    """
    given = raw["times_s"] if "times_s" in raw else raw["clock_s"]
    if not len(given):
        raise TelemetryError(f"{origin}: no samples of telemetry in it")
    unknown = np.full(len(given), np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        times = given if "times_s" in raw else _since_first(given, sort)
        rows = _rows_in_time(times, sort, warnings)
        columns = {name: raw.get(name, unknown)[rows] for name in _FIELDS} | {"times_s": times[rows]}
        latitude, longitude = _positions(columns["latitude_deg"], columns["longitude_deg"], warnings)
        if not np.isfinite(latitude).any():
            reasons = "; ".join(warnings[:3])
            raise TelemetryError(
                f"{origin} ({source}): {len(rows)} samples, none with a position"
                + (f" ({reasons})" if reasons else "")
                + "; give another log of the flight (GPX or CSV)"
            )
        gimbal = [
            wrap_degrees(_within(columns[f"gimbal_{axis}"], (-720.0, 720.0), "gimbal angles", warnings))
            for axis in ("yaw", "pitch", "roll")
        ]
        clock_s = _within(columns["clock_s"], CLOCK_RANGE_S, "clock readings", warnings)
        _tell_jumps(columns["times_s"], latitude, longitude, clock_s, warnings)
        return Telemetry(
            times_s=columns["times_s"],
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=_within(columns["height_m"], _HEIGHT_RANGE_M, "heights", warnings),
            relative_height_m=_within(
                columns["relative_height_m"], _RELATIVE_HEIGHT_RANGE_M, "relative heights", warnings
            ),
            gimbal_ypr_deg=np.stack(gimbal, axis=1),
            clock_s=clock_s,
            height_datum=height_datum,
            clock=clock if np.isfinite(clock_s).any() else "none",
            in_video_time=in_video_time,
            source=source,
            origin=origin,
            warnings=tuple(warnings[:MAX_WARNINGS]),
        )


def check_count(samples: int, origin: str) -> None:
    """Raises TelemetryError where there are more samples than MAX_SAMPLES."""
    if samples > MAX_SAMPLES:
        raise TelemetryError(
            f"{origin}: more than {MAX_SAMPLES} samples, that is more than nine hours at 60 a second; "
            "cut the file to the part that belongs to the video"
        )


def _since_first(times_s: FloatArray, earliest: bool) -> FloatArray:
    """Times since the first, or the earliest, that is known; before they are compared, as it rounds."""
    known = times_s[np.isfinite(times_s)]
    if not known.size:
        return times_s
    return times_s - float(known.min() if earliest else known[0])


def _rows_in_time(times_s: FloatArray, sort: bool, warnings: list[str]) -> NDArray[np.intp]:
    """Rows whose time is known and later than every time before."""
    rows = np.flatnonzero(np.isfinite(times_s))
    if sort:
        ordered = rows[np.argsort(times_s[rows], kind="stable")]
        if not np.array_equal(ordered, rows):
            warnings.append("the samples were not in the order of time and have been sorted")
        rows = ordered
    timed = times_s[rows]
    before = np.concatenate([[-np.inf], np.maximum.accumulate(timed)[:-1]]) if len(rows) else timed
    kept = rows[timed > before]
    if len(kept) < len(times_s):
        warnings.append(
            f"{len(times_s) - len(kept)} of {len(times_s)} samples left out: no time, or one that is not "
            "later than that of the sample before"
        )
    return kept


def _positions(
    latitude: FloatArray, longitude: FloatArray, warnings: list[str]
) -> tuple[FloatArray, FloatArray]:
    whole = np.isfinite(latitude) & np.isfinite(longitude)
    inside = whole & (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0)
    zero = inside & (np.abs(latitude) < _NULL_ISLAND_DEG) & (np.abs(longitude) < _NULL_ISLAND_DEG)
    if (whole & ~inside).any():
        warnings.append(f"{(whole & ~inside).sum()} positions out of range are not used")
    if zero.any():
        warnings.append(f"{zero.sum()} positions at 0, 0 are a receiver without a fix; not used")
    good = inside & ~zero
    return np.where(good, latitude, np.nan), np.where(good, longitude, np.nan)


def _within(values: FloatArray, limits: tuple[float, float], what: str, warnings: list[str]) -> FloatArray:
    good = (values >= limits[0]) & (values <= limits[1])
    absurd = int((~good & ~np.isnan(values)).sum())
    if absurd:
        warnings.append(f"{absurd} {what} outside [{limits[0]:g}, {limits[1]:g}] are not used")
    return np.where(good, values, np.nan)


def _tell_jumps(
    times_s: FloatArray, latitude: FloatArray, longitude: FloatArray, clock_s: FloatArray, warnings: list[str]
) -> None:
    """Warns of joined or cut recordings, which show as a clock or a place that leaps."""
    told = np.flatnonzero(np.isfinite(clock_s))
    drift = np.diff(clock_s[told]) - np.diff(times_s[told])
    if drift.size and np.abs(drift).max() > _CLOCK_JUMP_S:
        worst = int(np.abs(drift).argmax())
        warnings.append(
            f"the clock goes {drift[worst]:+.1f} s ahead of the video at {times_s[told[worst + 1]]:.2f} s "
            f"({(np.abs(drift) > _CLOCK_JUMP_S).sum()} such jumps): recordings joined, or the clock was set"
        )
    told = np.flatnonzero(np.isfinite(latitude))
    moved = np.diff(latitude[told]) != 0.0
    moved |= np.diff(longitude[told]) != 0.0
    # A receiver is slower than frames: only the readings at which the place changes have a time of their own.
    readings = told[1:][moved]
    if len(readings) < 2:
        return
    north = np.diff(latitude[readings]) * METRES_PER_DEGREE
    east = wrap_degrees(np.diff(longitude[readings])) * METRES_PER_DEGREE
    leap = np.hypot(north, east * np.cos(np.radians(latitude[readings[1:]])))
    speed = leap / np.diff(times_s[readings])
    wild = (leap > _LEAP_M) & (speed > _LEAP_M_S)
    if wild.any():
        first = int(np.flatnonzero(wild)[0])
        warnings.append(
            f"the place leaps by {leap[first]:.0f} m in {np.diff(times_s[readings])[first]:.2f} s at "
            f"{times_s[readings[first + 1]]:.2f} s ({wild.sum()} such leaps): recordings joined, wrong fixes"
        )
