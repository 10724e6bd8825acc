"""Ground control points as OpenDroneMap writes them: gcp_list.txt (docs/measurements/control-points.md).

See https://docs.opendronemap.org/gcp/.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from featuredb.errors import ControlFileError, GeodesyError
from featuredb.geo.crs.survey import SurveyCrs, geodetic_from_survey, survey_crs
from featuredb.geometry.arrays import FloatArray

_COLUMNS = "geo_x geo_y geo_z im_x im_y image_name [gcp_name]"
_MOST_ERRORS = 8  # a file with a wrong separator has one on every line
_MAX_BYTES = 20_000_000  # about 200,000 marks; more is some other file
_UNKNOWN_HEIGHTS = ("nan", "na", "none", "-")

_Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """Where one photo shows one control point.

    Attributes:
        point: name of the point.
        photo: name of the photo as the file has it.
        x, y: full-size pixels, top-left pixel centre at (0.5, 0.5).
        line: of the file, from 1.
    """

    point: str
    photo: str
    x: float
    y: float
    line: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlFile:
    """A control point file, checked.

    Attributes:
        crs: of the survey.
        names: of the points, in the order of the file.
        lat_lon_h: (n, 3) WGS84 degrees and metres; height NaN where it is unknown.
        marks: all of them, in the order of the file.
        notes: what was taken for granted, for people.
    """

    crs: SurveyCrs
    names: tuple[str, ...]
    lat_lon_h: FloatArray
    marks: tuple[Mark, ...]
    notes: tuple[str, ...]


def read_control_file(path: Path, crs: str | None = None) -> ControlFile:
    """Read and check a control point file.

    Args:
        crs: the reference system, instead of what the first line says.

    Raises:
        ControlFileError: the file cannot be read, or what it says cannot be used; every fault by its line.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ControlFileError(f"{path}: expected a list of control points, found a file of over 20 MB")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ControlFileError(f"{path}: cannot read the control points ({error})") from error
    except UnicodeDecodeError as error:
        raise ControlFileError(
            f"{path}: expected a text file in UTF-8, found byte {error.object[error.start]:#x} at "
            f"{error.start}; save it as plain text"
        ) from error
    return parse_control_file(text, str(path), crs)


def parse_control_file(text: str, where: str, crs: str | None = None) -> ControlFile:
    """The control points of a file's text; `where` names it in messages.

    Raises:
        ControlFileError: as `read_control_file`.
    """
    numbered = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1)]
    filled = [(n, line) for n, line in numbered if line and not line.startswith("#")]
    if not filled:
        raise ControlFileError(f"{where}: expected a reference system and marks, found an empty file")
    system, body = _header(filled, where, crs)
    if not body:
        raise ControlFileError(f"{where}: expected a mark per line ({_COLUMNS}), found only a header")
    lines, faults = [], []
    for number, line in body:
        try:
            lines.append(_parse_line(number, line, system))
        except ControlFileError as error:
            faults.append(str(error))
    _raise(faults, where)
    places, marks, notes = _points(lines, where)
    xyz, height_notes = _heights(places, system)
    try:
        lat_lon_h = geodetic_from_survey(system, xyz)
    except GeodesyError as error:
        raise ControlFileError(f"{where}: {error}") from error
    return ControlFile(
        crs=system, names=tuple(places), lat_lon_h=lat_lon_h, marks=marks, notes=(*notes, *height_notes)
    )


def _header(
    filled: list[tuple[int, str]], where: str, given: str | None
) -> tuple[SurveyCrs, list[tuple[int, str]]]:
    """The reference system and the lines after it."""
    number, first = filled[0]
    fields = first.split()
    first_is_mark = len(fields) >= 6 and None not in map(_number, (*fields[:2], *fields[3:5]))
    if first_is_mark and given is None:
        raise ControlFileError(
            f"{where}, line {number}: expected the reference system of the coordinates, found a mark; put "
            "e.g. EPSG:32611 in the first line, or say --gcp-crs EPSG:32611"
        )
    try:
        system = survey_crs(given if given is not None else first)
    except GeodesyError as error:
        place = "--gcp-crs" if given is not None else f"{where}, line {number}"
        raise ControlFileError(f"{place}: {error}") from error
    return system, filled if first_is_mark else filled[1:]


def _parse_line(number: int, line: str, crs: SurveyCrs) -> tuple[Mark, _Place]:
    """A mark, whose point is "" where the line names none, and where the point lies."""
    fields = [field.strip() for field in line.split("\t") if field.strip()]
    if len(fields) < 6:  # by tabs where they make enough columns, since names of photos may hold spaces
        fields = line.split()
    if len(fields) < 6:
        signs = [name for sign, name in ((",", "commas"), (";", "semicolons")) if line.count(sign) >= 5]
        hint = f"; separate columns by spaces or tabs, not {signs[-1]}" if signs else ""
        raise ControlFileError(
            f"line {number}: expected at least 6 columns ({_COLUMNS}), found {len(fields)}{hint}"
        )
    values = []
    for column, field in zip(_COLUMNS.split(), fields[:5], strict=False):
        value = _number(field)
        if column == "geo_z" and field.lower() in _UNKNOWN_HEIGHTS:
            value = math.nan
        if value is None:
            raise ControlFileError(f"line {number}: expected a number as {column}, found {field!r}")
        values.append(value)
    x, y, z, px, py = values
    if px < 0 or py < 0:
        raise ControlFileError(
            f"line {number}: expected pixels >= 0, found {px:g} {py:g}; the columns are {_COLUMNS}"
        )
    if crs.geographic and (abs(x) > 180 or abs(y) > 90):
        raise ControlFileError(
            f"line {number}: expected longitude and latitude in degrees ({crs.name}), found {x:g} {y:g}; "
            "name the projected system in the first line"
        )
    name = fields[6] if len(fields) > 6 else ""
    return Mark(point=name, photo=fields[5].replace("\\", "/"), x=px, y=py, line=number), (x, y, z)


def _number(field: str) -> float | None:
    try:
        value = float(field)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _raise(faults: list[str], where: str) -> None:
    """One error that names every line at fault."""
    if faults:
        more = f"\n  and {len(faults) - _MOST_ERRORS} more" if len(faults) > _MOST_ERRORS else ""
        raise ControlFileError(f"{where}:\n  " + "\n  ".join(faults[:_MOST_ERRORS]) + more)


def _points(
    lines: list[tuple[Mark, _Place]], where: str
) -> tuple[dict[str, _Place], tuple[Mark, ...], list[str]]:
    """Places by point, marks and notes.

    Lines belong to one point by its name, and by equal coordinates where there is none. A repeated mark
    counts once; contradicting ones are a fault, as contradicting places are.
    """
    name_at: dict[tuple[float, float], str] = {}
    places: dict[str, tuple[int, _Place]] = {}
    marks: dict[tuple[str, str], Mark] = {}
    faults, notes = [], []
    for mark, place in lines:
        if mark.point:
            name_at.setdefault(place[:2], mark.point)
    for mark, place in lines:
        name = mark.point or name_at.setdefault(place[:2], f"point {len(name_at) + 1}")
        if name not in places and name_at[place[:2]] != name:
            notes.append(f"line {mark.line}: {name} has the coordinates of {name_at[place[:2]]}")
        line, other = places.setdefault(name, (mark.line, place))
        if not np.array_equal(other, place, equal_nan=True):
            here, there = (" ".join(f"{v:.10g}" for v in found) for found in (place, other))
            faults.append(
                f"line {mark.line}: {name} is at {here}, line {line} says {there}; give it one position, or "
                "different names to different points"
            )
            continue
        first = marks.setdefault((name, mark.photo), replace(mark, point=name))
        if first.line == mark.line:
            continue
        if (first.x, first.y) == (mark.x, mark.y):
            notes.append(f"line {mark.line} repeats line {first.line}")
        else:
            faults.append(
                f"line {mark.line}: {name} is marked in {mark.photo} a second time, at {mark.x:g} "
                f"{mark.y:g}; line {first.line} has it at {first.x:g} {first.y:g}; remove one of them"
            )
    _raise(faults, where)
    return {name: place for name, (_, place) in places.items()}, tuple(marks.values()), notes


def _heights(places: dict[str, _Place], crs: SurveyCrs) -> tuple[FloatArray, list[str]]:
    """Coordinates (n, 3) with heights NaN where unknown, and what was made of them."""
    xyz = np.array(list(places.values()))
    known = np.isfinite(xyz[:, 2])
    notes = []
    if known.any() and (xyz[known, 2] == 0.0).all():
        xyz[:, 2] = np.nan
        return xyz, ["every height is exactly zero, so heights are taken as unknown"]
    if not known.any():
        notes.append("no point has a height")
    elif not known.all():
        lacking = ", ".join(name for name, there in zip(places, known, strict=True) if not there)
        notes.append(f"without a height: {lacking}")
    if known.any() and crs.height_unit_m != 1.0:
        notes.append(f"heights are taken in the system's unit of {crs.height_unit_m:.10g} m")
    return xyz, notes
