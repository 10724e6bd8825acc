"""The telemetry of one video as a value: samples over time, and what is known about them."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError
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
