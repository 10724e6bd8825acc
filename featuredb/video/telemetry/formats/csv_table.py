"""Tables of flight logs: CSV with a line of names, as Airdata, readers of DJI's logs and own loggers write.

Columns are known by common names (`_NAMES`), in any case, with units in brackets or as an ending:
`height_above_takeoff(feet)`, `OSD.yaw [360]`, `rel_alt_m`. Separators are commas, semicolons or tabs. What
has no known name is left alone; an unknown unit of a known name is refused, as a wrong unit is a wrong place.
"""

import csv
import io
import re
from collections.abc import Iterator

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geo.datum import HeightDatum
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.assemble import SampleTable, assemble, check_count
from featuredb.video.telemetry.formats.csv_time import TimeColumns, time_columns
from featuredb.video.telemetry.formats.table_values import UNITS, column_name, number
from featuredb.video.telemetry.formats.text import decode_text
from featuredb.video.telemetry.values import Telemetry

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
    timing = time_columns(header, origin)
    missing = [name for name in ("latitude_deg", "longitude_deg") if name not in columns]
    if missing or timing is None:
        times = "time, timestamp, time_s, film_time_s or datetime(utc)"
        wanted = f"latitude or lat, longitude, lon or lng, and {times}"
        raise TelemetryError(
            f"{origin}: expected a first line with columns for {wanted}; found {', '.join(header)[:500]!r}"
        )
    cells = _cells(rows, [*(index for index, _ in columns.values()), *timing.indices], len(header), origin)
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
    """The texts of the columns that count, column by column; short rows are filled with "".

    Raises:
        TelemetryError: most rows have more cells than there are names, so that none can be trusted.
    """
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
    cells: dict[int, list[str]], columns: dict[str, tuple[int, float]], timing: TimeColumns, origin: str
) -> Telemetry:
    warnings: list[str] = []
    values = {
        quantity: factor * _numbers(cells[index], quantity, origin, warnings)
        for quantity, (index, factor) in columns.items()
    }
    times = timing.read(cells, origin, warnings)
    values["times_s"], values["clock_s"] = times.times_s, times.clock_s
    datum: HeightDatum = "unknown"
    if "ellipsoidal_height" in values:
        datum, values["height_m"] = "ellipsoidal", values["ellipsoidal_height"]
    table = SampleTable()
    table.extend(values, len(times.times_s))
    return assemble(
        table,
        source="CSV",
        origin=origin,
        clock=times.clock,
        height_datum=datum,
        in_video_time=times.in_film,
        from_first=times.from_clock,
        sort=True,
        warnings=warnings,
    )


def _numbers(texts: list[str], quantity: str, origin: str, warnings: list[str]) -> FloatArray:
    values = np.array([number(_with_point(text)) for text in texts])
    words = sum(bool(text.strip()) for text in texts) - int(np.isfinite(values).sum())
    missing = sum(text.strip().lower() in ("n/a", "na", "nan", "null", "none", "-") for text in texts)
    if words - missing > _MOST * len(texts):
        raise TelemetryError(
            f"{origin}: expected numbers in the column of {quantity}, found for example "
            f"{next(text for text in texts if np.isnan(number(_with_point(text))) and text.strip())[:40]!r}"
        )
    if words > missing:
        warnings.append(f"{words - missing} values of {quantity} are no numbers and not used")
    return values


def _with_point(text: str) -> str:
    """A number with a decimal comma, as tables with semicolons have, with a point instead."""
    return text.replace(",", ".") if re.fullmatch(r"\s*[+-]?\d+,\d+\s*", text) else text
