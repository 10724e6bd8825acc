"""Tables of photos as photo sites give them: CSV, Parquet or JSON lines, one row a photo.

Columns (all optional but the first two, of which one must be there):

| column  | meaning |
|---|---|
| path    | of the file, from the table's folder |
| id      | instead of a path: a file of that name, with or without .jpg, .jpeg, .png, .heic, in its folder |
| lat, lon | WGS84 degrees |
| height  | metres, counted as the maps' heights are |
| accuracy, accuracy_height | standard deviations per horizontal axis and of the height, metres |
| yaw, pitch, roll | of the camera, degrees: yaw clockwise from true north, pitch -90 looks down |
| time    | ISO 8601, or as EXIF writes it |
| owner, licence, title | attribution |

Commas are decimal in tables whose columns are separated by semicolons. Unknown columns are ignored and
named. A row that cannot be read costs that row only. `geo.txt` of OpenDroneMap is such a table, too
(`ingest.photos.geo_txt`).
"""

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, cast

from featuredb.errors import IngestError
from featuredb.features.exif.angles import DEFAULT_SIGMA_TILT_DEG, DEFAULT_SIGMA_YAW_DEG, MOST_PITCH_DEG
from featuredb.geometry.camera_angles import CameraAngles
from ingest.photos.geo_txt import COLUMNS as GEO_TXT_COLUMNS
from ingest.photos.geo_txt import read_geo_txt

COLUMNS = ("id", *GEO_TXT_COLUMNS, "time", "owner", "licence", "title")
GEO_TXT = "geo.txt"
TABLE_SUFFIXES = (".csv", ".tsv", ".parquet", ".jsonl", ".ndjson")
_ALIASES = {
    **{"latitude": "lat", "longitude": "lon", "lng": "lon", "license": "licence"},
    **{"alt": "height", "altitude": "height", "elevation": "height"},
}
_NUMBERS = ("lat", "lon", "height", "accuracy", "accuracy_height", "yaw", "pitch", "roll")
_PHOTO_SUFFIXES = ("", ".jpg", ".jpeg", ".png", ".heic", ".JPG", ".JPEG", ".PNG", ".HEIC")


@dataclass(frozen=True, slots=True, kw_only=True)
class TableRow:
    """One photo of a table.

    Attributes:
        number: of the row, 1 for the first below the header; of a JSON lines file, the line.
        name: what the table calls it, its path or id.
        path: where the file should lie.
        latitude_deg, longitude_deg: WGS84, both or none.
        height_m: or None. accuracy_m, accuracy_height_m: standard deviations per axis, or None.
        angles: of the camera, or None.
        warnings: values that were left out.
    """

    number: int
    name: str
    path: Path
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None
    accuracy_m: float | None = None
    accuracy_height_m: float | None = None
    angles: CameraAngles | None = None
    time: datetime | None = None
    owner: str = ""
    licence: str = ""
    title: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoTable:
    """A table as it was read.

    Attributes:
        rows: in the table's order; names are unique.
        bad: numbers of rows that cannot be used, as they name no photo or name one again, with the reason.
        unknown_columns: names that mean nothing here.
    """

    rows: tuple[TableRow, ...]
    bad: tuple[tuple[int, str], ...] = ()
    unknown_columns: tuple[str, ...] = ()


def is_table(path: Path) -> bool:
    """Whether the path is a file that `read_table` knows by its name."""
    return (path.suffix.lower() in TABLE_SUFFIXES or path.name.lower() == GEO_TXT) and path.is_file()


def read_table(path: Path) -> PhotoTable:
    """Read a table; files that it names are not opened.

    Raises:
        IngestError: the file cannot be read as what its name says, or has neither `path` nor `id`.
    """
    try:
        columns, records = _records(path)
    except (OSError, ValueError, csv.Error) as error:  # pyarrow's errors are ValueErrors or OSErrors
        raise IngestError(f"{path}: expected a table of photos, found: {error}") from error
    names = {name: _meant(name) for name in columns}
    if not {"path", "id"} & set(names.values()):
        raise IngestError(
            f"{path}: expected a column `path` or `id`, found {', '.join(columns) or 'no columns'}"
        )
    rows: dict[str, TableRow] = {}
    bad: list[tuple[int, str]] = []
    for number, record in records:
        row: TableRow | str
        if isinstance(record, str):
            row = record
        else:
            row = _row(number, {names.get(k, k): v for k, v in record.items()}, path.parent)
        if isinstance(row, TableRow) and row.name in rows:
            row = f"{row.name} is in row {rows[row.name].number} already"
        if isinstance(row, str):
            bad.append((number, row))
        else:
            rows[row.name] = row
    unknown = tuple(sorted(column for column, name in names.items() if name not in COLUMNS))
    return PhotoTable(rows=tuple(rows.values()), bad=tuple(bad), unknown_columns=unknown)


def _meant(column: str) -> str:
    """The column that a header's name means."""
    name = column.strip().lower()
    return _ALIASES.get(name, name)


_Records = Iterator[tuple[int, "Mapping[str, Any] | str"]]
"""Number of the row, and its values by column or why it cannot be read."""


def _records(path: Path) -> tuple[list[str], _Records]:
    """Column names and rows."""
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        import pyarrow.parquet as pq

        table = pq.read_table(path)
        return list(table.column_names), enumerate(table.to_pylist(), start=1)
    text = path.read_text(encoding="utf-8-sig")
    if path.name.lower() == GEO_TXT:
        return list(GEO_TXT_COLUMNS), iter(read_geo_txt(text))
    return _json_lines(text) if suffix in (".jsonl", ".ndjson") else _separated(text)


def _json_lines(text: str) -> tuple[list[str], _Records]:
    parsed: list[tuple[int, Mapping[str, Any] | str]] = []
    columns: dict[str, None] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            value = json.loads(line)
        except ValueError as error:
            parsed.append((number, f"no JSON: {error}"))
            continue
        if not isinstance(value, dict):
            parsed.append((number, f"expected a JSON object, found {type(value).__name__}"))
            continue
        columns |= dict.fromkeys(value)
        parsed.append((number, value))
    return list(columns), iter(parsed)


def _separated(text: str) -> tuple[list[str], _Records]:
    """Comma, semicolon or tab, whichever the header has most of."""
    header = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=header.count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter, strict=False)
    columns = next(reader, [])

    def rows() -> _Records:
        for number, values in enumerate((v for v in reader if v), start=1):
            if len(values) != len(columns):
                yield number, f"expected {len(columns)} values, found {len(values)}"
            else:
                yield number, {name: plain(name, value) for name, value in zip(columns, values, strict=True)}

    def plain(name: str, value: str) -> str:
        decimal = delimiter == ";" and _meant(name) in _NUMBERS
        return value.replace(",", ".") if decimal else value

    return columns, rows()


def _row(number: int, record: Mapping[str, Any], folder: Path) -> TableRow | str:
    """One row, or why it is none; values that cannot be read are left out with a warning."""
    named = _text(record, "path")
    name = named or _text(record, "id")
    if not name or "\0" in name:
        return "neither a path nor an id"
    warnings: list[str] = []
    latitude, longitude = _position(record, warnings)
    return TableRow(
        number=number,
        name=name.replace("\\", "/"),
        path=folder / name if named else _file_of(folder, name),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=_metres(record, "height", -12_000.0, 100_000.0, warnings),
        accuracy_m=_metres(record, "accuracy", 0.0, 1e7, warnings),
        accuracy_height_m=_metres(record, "accuracy_height", 0.0, 1e7, warnings),
        angles=_angles(record, warnings),
        time=_time(record, warnings),
        owner=_text(record, "owner"),
        licence=_text(record, "licence"),
        title=_text(record, "title"),
        warnings=tuple(warnings),
    )


def _file_of(folder: Path, name: str) -> Path:
    """The file of an id, or where it should lie."""
    for suffix in _PHOTO_SUFFIXES:
        if (folder / (name + suffix)).is_file():
            return folder / (name + suffix)
    return folder / name


def _position(record: Mapping[str, Any], warnings: list[str]) -> tuple[float | None, float | None]:
    latitude, longitude = _number(record, "lat", warnings), _number(record, "lon", warnings)
    if latitude is None or longitude is None:
        if latitude is not None or longitude is not None:
            warnings.append("table: one of lat and lon is missing; the position is left out")
        return None, None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or (latitude, longitude) == (0, 0):
        warnings.append(f"table: {latitude}, {longitude} is no position; it is left out")
        return None, None
    return latitude, longitude


def _metres(
    record: Mapping[str, Any], name: str, low: float, high: float, warnings: list[str]
) -> float | None:
    value = _number(record, name, warnings)
    if value is not None and not low < value < high:
        warnings.append(f"table: {name} {value} m is not usable; it is left out")
        return None
    return value


def _angles(record: Mapping[str, Any], warnings: list[str]) -> CameraAngles | None:
    """None where neither yaw nor pitch is told, and where all are zero, as tables write that nobody knows."""
    if isinstance(record.get("angles"), CameraAngles):  # of geo.txt
        return cast(CameraAngles, record["angles"])
    yaw, pitch, roll = (_number(record, name, warnings) for name in ("yaw", "pitch", "roll"))
    told = (yaw or 0.0, pitch or 0.0, roll or 0.0)
    if abs(told[0]) > 360.0 or abs(told[1]) > MOST_PITCH_DEG or abs(told[2]) > 360.0:
        warnings.append(f"table: {yaw}, {pitch}, {roll} are no angles in degrees; they are left out")
        return None
    if (yaw is None and pitch is None) or not any(told):
        return None
    return CameraAngles(
        yaw_deg=yaw,
        pitch_deg=pitch,
        roll_deg=told[2],
        sigma_yaw_deg=DEFAULT_SIGMA_YAW_DEG,
        sigma_tilt_deg=DEFAULT_SIGMA_TILT_DEG,
    )


def _number(record: Mapping[str, Any], name: str, warnings: list[str]) -> float | None:
    value = record.get(name)
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        if str(value).strip().lower() != "nan":  # how tables write "none"
            warnings.append(f"table: {name} {str(value)[:40]!r} is no number; it is left out")
        return None
    return number


def _time(record: Mapping[str, Any], warnings: list[str]) -> datetime | None:
    value = record.get("time")
    if isinstance(value, datetime):
        return value
    text = _text(record, "time")
    if not text:
        return None
    for form in (None, "%Y:%m:%d %H:%M:%S"):
        try:
            return datetime.fromisoformat(text) if form is None else datetime.strptime(text, form)
        except ValueError:
            continue
    warnings.append(f"table: time {text[:40]!r} is not as in 2026-03-01T12:00:00; it is left out")
    return None


def _text(record: Mapping[str, Any], name: str) -> str:
    value = record.get(name)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return str(value).strip()


def summary_of(table: PhotoTable) -> Sequence[str]:
    """What a person should know of the table besides its photos."""
    lines = []
    if table.unknown_columns:
        lines.append(f"table: columns without a meaning here are ignored: {', '.join(table.unknown_columns)}")
    left_out = [row for row in table.rows if row.warnings]
    if left_out:
        words = "; ".join(one.removeprefix("table: ") for one in left_out[0].warnings)
        lines.append(
            f"table: values of {len(left_out)} of {len(table.rows)} rows are left out, and what the photos "
            f"say is used; row {left_out[0].number}: {words}"
        )
    if table.unknown_columns and not any(row.latitude_deg is not None for row in table.rows):
        lines.append(
            "table: no row has a position: expected columns lat and lon in degrees; other coordinate systems "
            "go into a geo.txt, whose first line names them"
        )
    lines += [f"table: row {number} is left out: {reason}" for number, reason in table.bad[:20]]
    if len(table.bad) > 20:
        lines.append(f"table: {len(table.bad) - 20} more rows are left out")
    return lines
