"""Text files of telemetry: their bytes, within a limit, and the times, numbers and units in them."""

import math
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from featuredb.errors import TelemetryError
from featuredb.geo.heights import FOOT_M

# Two hours of subtitles at 60 frames a second are 130 MB.
MAX_TEXT_BYTES = 256 * 1024 * 1024

_CLOCK = re.compile(
    r"(?<!\d)(?P<year>\d{4})[-./:](?P<month>\d{1,2})[-./:](?P<day>\d{1,2})(?:[ T]|, ?)\s?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}))?"
    # Thousandths and then millionths, as DJI writes them (12:27:52,393,525), or one decimal fraction.
    r"(?:[.,](?P<fraction>\d{1,9})(?:,(?P<millionths>\d{3})(?!\d))?)?"
    r"(?:\s?(?P<zone>Z|UTC|[+-]\d{2}:?\d{2})\b)?"
)

_NUMBER = re.compile(r"[+-]?(?:\d{1,18}(?:[.,]\d{0,20})?|[.,]\d{1,20})(?:[eE][+-]?\d{1,2})?", re.ASCII)
_BRACKET = re.compile(r"^(.*?)\s*[\(\[]\s*([^()\[\]]*?)\s*[\)\]]\s*$")

# Unit: the quantity it measures and what turns it into metres, degrees, seconds.
UNITS: dict[str, tuple[str, float]] = {
    "m": ("length", 1.0), "meter": ("length", 1.0), "meters": ("length", 1.0), "metre": ("length", 1.0),
    "metres": ("length", 1.0), "ft": ("length", FOOT_M), "feet": ("length", FOOT_M),
    "foot": ("length", FOOT_M), "km": ("length", 1000.0), "mm": ("length", 0.001), "cm": ("length", 0.01),
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
    """A number with a decimal point or comma, or NaN for anything else: empty, "n/a", words, infinity."""
    stripped = text.strip().replace(",", ".")
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


class WallClock(NamedTuple):
    """A time of day as written: seconds since 1970 of its own clock, and whether that clock is UTC."""

    seconds: float
    is_utc: bool


def parse_wall_clock(text: str) -> WallClock | None:
    """The first date with a time in a text, year first; None where there is none or the calendar has no such.

    A zone that is written is applied, and the result is UTC. Without one the seconds are those of the same
    digits read as UTC, and `is_utc` is False.
    """
    match = _CLOCK.search(text)
    if match is None:
        return None
    parts = [int(match[name] or 0) for name in ("year", "month", "day", "hour", "minute", "second")]
    leap = parts[5] == 60
    try:
        whole = datetime(*parts[:5], parts[5] - leap, tzinfo=UTC).timestamp() + leap  # type: ignore[misc, arg-type]
    except (ValueError, OverflowError):
        return None
    fraction = (match["fraction"] or "") + (match["millionths"] or "")
    seconds = whole + float(f"0.{fraction or 0}") - _offset_s(match["zone"])
    return WallClock(seconds, match["zone"] is not None)


def _offset_s(zone: str | None) -> float:
    if zone in (None, "Z", "UTC"):
        return 0.0
    assert zone is not None
    minutes = int(zone[1:3]) * 60 + int(zone[-2:])
    return (-60.0 if zone[0] == "-" else 60.0) * minutes


def decode_text(data: bytes) -> str:
    """The text of UTF-8 bytes, or of UTF-16 that begins with its mark.

    What is neither becomes U+FFFD: the fields that count are ASCII.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    return data.decode("utf-8-sig", errors="replace")


def read_bytes(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        TelemetryError: no such file, not readable, or larger than the limit.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TEXT_BYTES + 1)
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read ({error.strerror or error})") from error
    if len(data) > MAX_TEXT_BYTES:
        raise TelemetryError(
            f"{path}: expected telemetry of at most {MAX_TEXT_BYTES // 2**20} MiB, found more; two hours of "
            "subtitles at 60 frames a second are 130 MB. Cut the file to the part that belongs to the video"
        )
    return data
