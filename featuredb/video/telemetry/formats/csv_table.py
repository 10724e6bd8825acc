"""Tables of flight logs: CSV with a line of names, as Airdata, readers of DJI's logs and own loggers write.

Columns are known by common names (`_NAMES`), in any case, with units in brackets or as an ending:
`height_above_takeoff(feet)`, `OSD.yaw [360]`, `rel_alt_m`. Separators are commas, semicolons or tabs. What
has no known name is left alone; an unknown unit of a known name is refused, as a wrong unit is a wrong place.
"""

import csv
import io
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geo.datum import HeightDatum
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.text import UNITS, column_name, decode_text, number, parse_wall_clock
from featuredb.video.telemetry.values import Clock, Telemetry, assemble, check_count

# Quantity: its unit's kind, and the names under which it is found, best first. Of heights the one that says
# above what is better; "altitude" beside "altitude_above_sea_level" is Airdata's height above take-off.
_NAMES: dict[str, tuple[str, tuple[str, ...]]] = {
    "latitude_deg": ("angle", ("latitude", "lat", "osd_latitude", "gps_latitude", "gps_lat")),
    "longitude_deg": (
        "angle",
        ("longitude", "longtitude", "lon", "lng", "long", "osd_longitude", "gps_longitude", "gps_lon",
         "gps_lng"),
    ),
    "ellipsoidal_height": ("length", ("ellipsoidal_height", "height_ellipsoidal", "ellipsoid_height", "hae")),
    "height_m": (
        "length",
        ("altitude_above_sea_level", "altitude_above_sealevel", "altitude_msl", "alt_msl", "abs_alt",
         "absolute_altitude", "osd_altitude", "gps_altitude", "altitude", "alt", "ele", "elevation",
         "height"),
    ),
    "relative_height_m": (
        "length",
        ("height_above_takeoff", "height_above_take_off", "height_above_home", "relative_altitude",
         "relative_height", "rel_alt", "rel_height", "osd_height"),
    ),
    "gimbal_yaw": ("angle", ("gimbal_yaw", "gimbal_heading", "gb_yaw", "camera_yaw")),
    "gimbal_pitch": ("angle", ("gimbal_pitch", "gb_pitch", "camera_pitch")),
    "gimbal_roll": ("angle", ("gimbal_roll", "gb_roll", "camera_roll")),
}  # fmt: skip
_MAX_COLUMNS = 2000
# A table in which so many coordinates are no numbers has other columns than their names say.
_MOST = 0.5
_NO_VALUE = ("n/a", "na", "nan", "null", "none", "-")

_TIME_NAMES = (
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


class _TimeColumn(NamedTuple):
    at: int
    name: str
    unit: str
    in_film: bool = False


def _times_of(
    columns: list[_TimeColumn], cells: dict[int, list[str]], origin: str, warnings: list[str]
) -> tuple[dict[str, FloatArray], Clock, bool]:
    """Columns of the times of all rows, as `assemble` takes them; which clock; whether times are the film's.

    Args:
        cells: texts of the columns by their index.
    """
    elapsed: FloatArray | None = None
    in_film = False
    clock: tuple[FloatArray, Clock] | None = None
    for column in columns:
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
    if elapsed is not None:
        if clock is None:
            return {"times_s": elapsed}, "none", in_film
        finer = _refined(elapsed, clock[0], warnings)
        return {"times_s": elapsed, "clock_s": finer}, clock[1], in_film
    if clock is not None:
        return {"clock_s": clock[0]}, clock[1], False
    names = ", ".join(repr(column.name) for column in columns)
    example = next((text for text in cells[columns[0].at] if text.strip()), "")
    raise TelemetryError(
        f"{origin}: expected seconds in the column {names}, or dates with the year first like "
        f"2024-05-31T12:00:00Z, found {example[:40]!r}"
    )


def _time_columns(header: list[str], origin: str) -> list[_TimeColumn]:
    """The columns of a line of names that are times by them."""
    found = []
    for index, cell in enumerate(header):
        name = column_name(cell)
        in_film = name.base in _FILM_NAMES
        if not in_film and name.base not in _TIME_NAMES and f"{name.base}_{name.unit}" not in _TIME_NAMES:
            continue
        if name.unit and UNITS.get(name.unit, ("", 0.0))[0] not in ("time", "zone"):
            raise TelemetryError(
                f"{origin}: the column {cell!r} has the unit {name.unit!r}, which is no time"
            )
        found.append(_TimeColumn(index, cell.strip(), name.unit, in_film))
    return found


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


def read_csv(data: bytes, origin: str = "CSV") -> Telemetry:
    """The telemetry of a table.

    Where there is a column of elapsed time, times come from it, and the clock's whole seconds from the other;
    otherwise from the clock alone, and count from the first row. Elapsed times stay as they are written: they
    may be those of the video, or of the flight; only names like film_time_s say that they are the video's.

    Raises:
        TelemetryError: no table, columns missing, an unknown unit, or no positions.
    """
    rows = _rows(decode_text(data), origin)
    header = next(rows, [])
    columns = _known_columns(header, origin)
    timing = _time_columns(header, origin)
    missing = [name for name in ("latitude_deg", "longitude_deg") if name not in columns]
    if missing or not timing:
        times = "time, timestamp, time_s, film_time_s or datetime(utc)"
        wanted = f"latitude or lat, longitude, lon or lng, and {times}"
        raise TelemetryError(
            f"{origin}: expected a first line with columns for {wanted}; found {', '.join(header)[:500]!r}"
        )
    indices = [*(index for index, _ in columns.values()), *(column.at for column in timing)]
    cells = _cells(rows, indices, len(header), origin)
    if not cells:
        raise TelemetryError(f"{origin}: a table with names of columns and no rows")
    return _telemetry(cells, columns, timing, origin)


def _rows(text: str, origin: str) -> Iterator[list[str]]:
    """Rows of the table that are not empty."""
    first, _, rest = text.partition("\n")
    if re.fullmatch(r'"?sep=.\s*"?\s*', first):  # Excel's hint, which Flight Reader writes
        text, first = rest, rest.partition("\n")[0]
    separator = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
    try:
        for row in reader:
            if len(row) > _MAX_COLUMNS:
                raise TelemetryError(f"{origin}: a line of {len(row)} columns; this is no table of telemetry")
            if any(cell.strip() for cell in row):
                yield row
    except csv.Error as error:
        raise TelemetryError(
            f"{origin}: line {reader.line_num} cannot be read as a table ({error})"
        ) from error


def _known_columns(header: list[str], origin: str) -> dict[str, tuple[int, float]]:
    """Quantity to the index of its column and the factor that turns it into metres or degrees."""
    names = [column_name(cell) for cell in header]
    found: dict[str, tuple[int, float]] = {}
    for quantity, (kind, aliases) in _NAMES.items():
        whole = [name.base for name in names]
        index = next((whole.index(alias) for alias in aliases if alias in whole), None)
        if index is None:
            continue
        same = [cell for cell, name in zip(header, names, strict=True) if name == names[index]]
        if len(same) > 1 and quantity in ("latitude_deg", "longitude_deg", "height_m"):
            raise TelemetryError(
                f"{origin}: {len(same)} columns are the {quantity} by their names, "
                f"{', '.join(repr(cell) for cell in same)}; expected one: take the others out"
            )
        unit = names[index].unit
        of, factor = UNITS.get(unit, ("", 0.0)) if unit else (kind, 1.0)
        if of == "frame" and kind == "angle":
            of = kind
        if of != kind:
            raise TelemetryError(
                f"{origin}: the column {header[index]!r} has the unit {unit!r}; expected one of "
                f"{', '.join(sorted(key for key, (of, _) in UNITS.items() if of == kind))}"
            )
        found[quantity] = index, factor
    return found


def _cells(rows: Iterator[list[str]], indices: list[int], width: int, origin: str) -> dict[int, list[str]]:
    """The texts of the columns that count, column by column; short rows are filled with ""."""
    cells: dict[int, list[str]] = {index: [] for index in indices}
    count = wide = 0
    for count, row in enumerate(rows, start=1):
        check_count(count, origin)
        wide += any(cell.strip() for cell in row[width:])
        for index, column in cells.items():
            column.append(row[index] if index < len(row) else "")
    if wide > _MOST * count:
        raise TelemetryError(
            f"{origin}: {wide} of {count} rows have more than the {width} cells that the first line names; "
            "with decimal commas a table needs semicolons between its cells"
        )
    return cells if count else {}


def _telemetry(
    cells: dict[int, list[str]], columns: dict[str, tuple[int, float]], timing: list[_TimeColumn], origin: str
) -> Telemetry:
    warnings: list[str] = []
    values = {
        quantity: factor * _numbers(cells[index], quantity, origin, warnings)
        for quantity, (index, factor) in columns.items()
    }
    times, clock, in_film = _times_of(timing, cells, origin, warnings)
    datum: HeightDatum = "unknown"
    if "ellipsoidal_height" in values:
        datum, values["height_m"] = "ellipsoidal", values["ellipsoidal_height"]
    return assemble(
        values | times,
        source="CSV",
        origin=origin,
        clock=clock,
        height_datum=datum,
        in_video_time=in_film,
        sort=True,
        warnings=warnings,
    )


def _numbers(texts: list[str], quantity: str, origin: str, warnings: list[str]) -> FloatArray:
    values = np.array([number(text) for text in texts])
    written = [text.strip() for text, value in zip(texts, values, strict=True) if np.isnan(value)]
    words = [text for text in written if text and text.lower() not in _NO_VALUE]
    if len(words) > _MOST * len(texts):
        raise TelemetryError(
            f"{origin}: expected numbers in the column of {quantity}, found for example {words[0][:40]!r}"
        )
    if words:
        warnings.append(f"{len(words)} values of {quantity} are no numbers and not used")
    return values
