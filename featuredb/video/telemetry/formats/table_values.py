"""Cells of tables as numbers, and names of columns as quantities with units."""

import math
import re
from typing import NamedTuple

_NUMBER = re.compile(r"[+-]?(?:\d{1,18}(?:\.\d{0,20})?|\.\d{1,20})(?:[eE][+-]?\d{1,2})?", re.ASCII)
_BRACKET = re.compile(r"^(.*?)\s*[\(\[]\s*([^()\[\]]*?)\s*[\)\]]\s*$")

FEET_M = 0.3048
# Unit: the quantity it measures and what turns it into metres, degrees, seconds.
UNITS: dict[str, tuple[str, float]] = {
    "m": ("length", 1.0), "meter": ("length", 1.0), "meters": ("length", 1.0), "metre": ("length", 1.0),
    "metres": ("length", 1.0), "ft": ("length", FEET_M), "feet": ("length", FEET_M),
    "foot": ("length", FEET_M), "km": ("length", 1000.0), "mm": ("length", 0.001), "cm": ("length", 0.01),
    "deg": ("angle", 1.0), "degree": ("angle", 1.0), "degrees": ("angle", 1.0), "°": ("angle", 1.0),
    "360": ("angle", 1.0),  # Flight Reader writes so for a yaw that goes from 0 to 360 degrees
    "rad": ("angle", 180.0 / math.pi), "radians": ("angle", 180.0 / math.pi),
    "s": ("time", 1.0), "sec": ("time", 1.0), "secs": ("time", 1.0), "second": ("time", 1.0),
    "seconds": ("time", 1.0), "ms": ("time", 1e-3), "millisecond": ("time", 1e-3),
    "milliseconds": ("time", 1e-3), "us": ("time", 1e-6), "microseconds": ("time", 1e-6),
    "utc": ("zone", 1.0), "gmt": ("zone", 1.0), "local": ("zone", 0.0), "wgs84": ("frame", 1.0),
}  # fmt: skip


class ColumnName(NamedTuple):
    """A column's name as read: lower case with underscores, and its unit, "" where it has none."""

    base: str
    unit: str


def number(text: str) -> float:
    """A decimal number, or NaN for anything else: empty, "n/a", words, infinity."""
    stripped = text.strip()
    return float(stripped) if _NUMBER.fullmatch(stripped) else math.nan


def column_name(text: str) -> ColumnName:
    """The name and the unit of "Height_above_takeoff(feet)", "OSD.yaw [360]" or "rel_alt_m"."""
    match = _BRACKET.match(text.strip())
    base, unit = (match[1], match[2].lower()) if match else (text.strip(), "")
    # heightAboveTakeoff and height_above_takeoff are one name.
    base = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", base)
    base = re.sub(r"[^a-z0-9]+", "_", base.lower()).strip("_")
    if not unit and "_" in base:
        stem, _, tail = base.rpartition("_")
        if tail in UNITS and stem:
            return ColumnName(stem, tail)
    return ColumnName(base, unit)
