"""The times of a table: elapsed seconds, a wall clock, or both together."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.table_values import UNITS, column_name, number
from featuredb.video.telemetry.formats.text import parse_wall_clock
from featuredb.video.telemetry.values import Clock

_NAMES = (
    "datetime", "date_time", "utc", "utc_time", "time_utc", "timestamp_utc", "timestamp", "time", "time_s",
    "elapsed", "elapsed_time", "osd_fly_time", "fly_time", "flight_time", "unix_time", "custom_update_time",
)  # fmt: skip
# Elapsed time that is the film's own by its name.
_FILM_NAMES = ("film_time", "video_time", "film_elapsed", "video_elapsed")
# Elapsed time whose rows are so far apart is in thousandths: no log has a row in twenty seconds, and none has
# more than fifty a second.
_NO_SECONDS = 20.0
# Numbers that are seconds, thousandths or millionths since 1970, of this century's years.
_SINCE_1970 = ((1e9, 4.2e9, 1.0), (1e12, 4.2e12, 1e-3), (1e15, 4.2e15, 1e-6))
# Whole seconds of a clock, cut off, lie half a second early on average.
_CUT_OFF_S = 0.5


class Times(NamedTuple):
    """Times of the rows: seconds of elapsed time, and the clock's; NaN where they are not known."""

    times_s: FloatArray
    clock_s: FloatArray
    clock: Clock
    from_clock: bool = False  # there is no elapsed time: times_s is clock_s
    in_film: bool = False  # times_s counts from the film's beginning


class _TimeColumn(NamedTuple):
    at: int
    name: str
    unit: str
    in_film: bool = False


@dataclass(frozen=True, slots=True)
class TimeColumns:
    """The columns of a table that are times by their names."""

    columns: tuple[_TimeColumn, ...]

    @property
    def indices(self) -> list[int]:
        return [column.at for column in self.columns]

    def read(self, cells: dict[int, list[str]], origin: str, warnings: list[str]) -> Times:
        """The times of all rows.

        Args:
            cells: texts of the columns by their index.
            origin: the file's name, for messages.
            warnings: receives what had to be decided.

        Raises:
            TelemetryError: no column can be read as times.
        """
        elapsed: FloatArray | None = None
        in_film = False
        clock: tuple[FloatArray, Clock] | None = None
        for column in self.columns:
            read = _read_column(cells[column.at], column)
            if read is None:
                continue
            seconds, kind = read
            if kind == "none":
                if elapsed is None or (column.in_film and not in_film):
                    _check_unit(seconds, column, origin)
                    elapsed, in_film = seconds, column.in_film
            elif clock is None:
                clock = seconds, kind
        if elapsed is None and clock is None:
            names = ", ".join(repr(column.name) for column in self.columns)
            example = next((text for text in cells[self.columns[0].at] if text.strip()), "")
            raise TelemetryError(
                f"{origin}: expected seconds in the column {names}, or dates with the year first like "
                f"2024-05-31T12:00:00Z, found {example[:40]!r}"
            )
        return _joined(elapsed, clock, warnings)._replace(in_film=in_film)


def time_columns(header: list[str], origin: str) -> TimeColumns | None:
    """The time columns of a line of names, None where there is none.

    Raises:
        TelemetryError: a time in a unit that is none.
    """
    found = []
    for index, cell in enumerate(header):
        name = column_name(cell)
        in_film = name.base in _FILM_NAMES
        if not in_film and name.base not in _NAMES and f"{name.base}_{name.unit}" not in _NAMES:
            continue
        if name.unit and UNITS.get(name.unit, ("", 0.0))[0] not in ("time", "zone"):
            raise TelemetryError(
                f"{origin}: the column {cell!r} has the unit {name.unit!r}, which is no time"
            )
        found.append(_TimeColumn(index, cell.strip(), name.unit, in_film))
    return TimeColumns(tuple(found)) if found else None


def _read_column(texts: list[str], column: _TimeColumn) -> tuple[FloatArray, Clock] | None:
    """Seconds of one column, and of which clock; "none" for elapsed time. None where it is not readable."""
    kind, factor = UNITS.get(column.unit, ("", 1.0))
    numbers = np.array([number(text) for text in texts])
    if np.isfinite(numbers).any():
        middle = float(np.nanmedian(numbers))
        for low, high, unit_s in _SINCE_1970:
            # Where a unit is written it counts: a thousand seconds are 1e9 microseconds too.
            if low <= middle <= high and unit_s == (factor if kind == "time" else unit_s):
                return numbers * unit_s, "utc"
        return (numbers * factor, "none") if kind in ("time", "") else None
    found = [parse_wall_clock(text) for text in texts]
    seconds = np.array([clock.seconds if clock else np.nan for clock in found])
    if not np.isfinite(seconds).any():
        return None
    zoned = [clock.is_utc for clock in found if clock]
    is_utc = all(zoned) or (kind == "zone" and factor == 1.0) or "utc" in column.name.lower()
    if any(zoned) and not is_utc:  # some rows are UTC, and others nobody knows what
        seconds = np.array([clock.seconds if clock and clock.is_utc else np.nan for clock in found])
        is_utc = True
    return seconds, "utc" if is_utc else "local"


def _check_unit(seconds: FloatArray, column: _TimeColumn, origin: str) -> None:
    steps = np.diff(seconds[np.isfinite(seconds)])
    step = float(np.median(steps)) if steps.size else 0.0
    if not column.unit and step >= _NO_SECONDS:
        raise TelemetryError(
            f"{origin}: the column {column.name!r} names no unit and its rows are {step:g} apart: seconds or "
            f"thousandths? Write {column.name}_s or {column.name}_ms"
        )


def _joined(elapsed: FloatArray | None, clock: tuple[FloatArray, Clock] | None, warnings: list[str]) -> Times:
    if elapsed is None:
        assert clock is not None
        seconds, kind = clock
        return Times(seconds, seconds, kind, from_clock=True)
    if clock is None:
        return Times(elapsed, np.full(len(elapsed), np.nan), "none")
    seconds, kind = clock
    return Times(elapsed, _refined(elapsed, seconds, warnings), kind)


def _refined(times_s: FloatArray, clock_s: FloatArray, warnings: list[str]) -> FloatArray:
    """The clock of every row; finer than written where it is cut to whole seconds and rows are closer."""
    both = np.isfinite(times_s) & np.isfinite(clock_s)
    if both.sum() < 2:
        return clock_s
    shown = clock_s[both]
    whole_seconds = bool((shown == np.floor(shown)).all())
    step = float(np.median(np.diff(times_s[both])))
    if not whole_seconds or not 0.0 < step < 0.9:
        return clock_s
    offset = float(np.median(shown - times_s[both])) + _CUT_OFF_S
    warnings.append("the clock is written in whole seconds; its fractions come from the elapsed time")
    return times_s + offset
