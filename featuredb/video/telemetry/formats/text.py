"""Text files of telemetry: their bytes, within a limit, and the wall clock times written in them."""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from featuredb.errors import TelemetryError

# Two hours of subtitles at 60 frames a second are 130 MB.
MAX_TEXT_BYTES = 256 * 1024 * 1024

_CLOCK = re.compile(
    r"(?<!\d)(?P<year>\d{4})[-./:](?P<month>\d{1,2})[-./:](?P<day>\d{1,2})(?:[ T]|, ?)\s?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}))?"
    # Thousandths and then millionths, as DJI writes them (12:27:52,393,525), or one decimal fraction.
    r"(?:[.,](?P<fraction>\d{1,9})(?:,(?P<millionths>\d{3})(?!\d))?)?"
    r"(?:\s?(?P<zone>Z|UTC|[+-]\d{2}:?\d{2})\b)?"
)


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
