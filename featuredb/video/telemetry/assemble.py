"""From the raw columns of any format to a `Telemetry`: what cannot be true becomes "not known", with a line.

Nothing is invented and nothing is repaired: a position out of range, at 0, 0 or without a fix is NaN. Samples
whose time does not advance are left out. A file without any position is refused.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import TelemetryError
from featuredb.geo.datum import HeightDatum
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Clock, Telemetry, wrap_degrees

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
            gimbal_ypr_deg=_gimbal_angles(columns, warnings),
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


def _gimbal_angles(columns: Mapping[str, FloatArray], warnings: list[str]) -> FloatArray:
    """(n, 3) yaw, pitch, roll in [-180, 180)."""
    parts = [
        wrap_degrees(_within(columns[f"gimbal_{axis}"], (-720.0, 720.0), "gimbal angles", warnings))
        for axis in ("yaw", "pitch", "roll")
    ]
    return np.stack(parts, axis=1)


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
