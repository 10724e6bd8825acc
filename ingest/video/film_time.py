"""When a film was made, as its file or a person tells, on the clock of a log; moments of logs in words."""

import re
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.text import parse_wall_clock
from featuredb.video.telemetry.values import CLOCK_RANGE_S, Telemetry

# Hours that zones are ahead of UTC (IANA's tz database): whole and half ones from -12 to 14, and those of
# Nepal, Eucla and the Chatham Islands.
_ZONES_H = (*(0.5 * k for k in range(-24, 29)), 5.75, 8.75, 12.75, 13.75)
# Before this year a clock was not set: containers count from 1904 or 1970, chips from 1980 or 2000.
_FIRST_YEAR = 2005


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmTime:
    """What is known of a film's beginning.

    Attributes:
        duration_s: of the film; created: what its file says, or None.
        told_s: what a person says: seconds of `Telemetry.times_s` at the film's time 0; or None.
    """

    name: str
    duration_s: float
    created: datetime | None = None
    told_s: float | None = None


def film_start(text: str, telemetry: Telemetry) -> float:
    """What a person writes for a film's beginning as seconds of the telemetry's `times_s`.

    Logs with a clock take a date and time, with its zone if the clock is UTC; others take their own seconds.

    Raises:
        InvalidValueError: the text is none of that, or telemetry in the film's time needs no beginning.
    """
    name = telemetry.origin or telemetry.source
    if telemetry.in_video_time:
        raise InvalidValueError(f"--film-start: {name} is in the film's time already; see --telemetry-late")
    offset = clock_offset_s(telemetry)
    if offset is None:
        if not re.fullmatch(r"-?\d{1,9}(\.\d{1,9})?", text.strip()):
            raise InvalidValueError(
                f"--film-start: {name} has no clock; expected its seconds at which the film begins, like "
                f"132.5, found {text!r}"
            )
        return float(text)
    clock = parse_wall_clock(text)
    if (
        clock is None
        or not CLOCK_RANGE_S[0] < clock.seconds < CLOCK_RANGE_S[1]
        or not re.fullmatch(r"\s*\d{4}-\d\d-\d\d[ T][\d:.,]+\s?(Z|UTC|[+-]\d\d:?\d\d)?\s*", text)
    ):
        raise InvalidValueError(
            f"--film-start: expected a date and time like 2024-05-31T12:00:00Z, found {text!r}"
        )
    if clock.is_utc != (telemetry.clock == "utc"):
        clocks = {
            "utc": "UTC; name the zone, like 2024-05-31T12:00:00Z or 2024-05-31T14:00:00+02:00",
            "local": "a local one whose zone is not known; write the time that it shows, without a zone",
        }
        raise InvalidValueError(
            f"--film-start: the clock of {name} is {clocks[telemetry.clock]}; found {text!r}"
        )
    return clock.seconds - offset


def clock_offset_s(telemetry: Telemetry) -> float | None:
    """Seconds since 1970 of the telemetry's clock at its time 0; None without a clock."""
    ahead = telemetry.clock_s - telemetry.times_s
    return float(np.nanmedian(ahead)) if np.isfinite(ahead).any() else None


def possible_beginnings(film: FilmTime, telemetry: Telemetry) -> FloatArray | None:
    """Beginnings, seconds of the telemetry, that the film's own clock can mean; None where it tells nothing.

    Its time is UTC or that of any zone, of the recording's beginning or its end. A log in local time lies in
    any zone itself.
    """
    offset = clock_offset_s(telemetry)
    if film.created is None or film.created.year < _FIRST_YEAR or offset is None:
        return None
    zones = 3600.0 * np.array(_ZONES_H)
    shifts = zones if telemetry.clock == "utc" else np.unique(np.concatenate([zones, -zones]))
    begin = film.created.timestamp() - shifts - offset
    return np.asarray(np.concatenate([begin, begin - film.duration_s]))


def log_span(telemetry: Telemetry) -> tuple[float, float]:
    """First and last sample with a position, seconds."""
    known = telemetry.times_s[telemetry.has_position]
    return (float(known[0]), float(known[-1])) if len(known) else (0.0, -1.0)


def log_text(telemetry: Telemetry) -> str:
    low, high = log_span(telemetry)
    name = telemetry.origin or telemetry.source
    return f"{name} has positions from {moment_text(low, telemetry)} to {moment_text(high, telemetry)}"


def moment_text(log_s: float, telemetry: Telemetry) -> str:
    """A moment of the log as --film-start takes it."""
    offset = clock_offset_s(telemetry)
    if offset is None:
        return f"{log_s:.1f}"
    text = utc_text(log_s + offset)
    return text if telemetry.clock == "utc" else text.removesuffix("Z")


def utc_text(seconds: float) -> str:
    when = datetime.fromtimestamp(round(seconds, 1), UTC)
    return when.strftime("%Y-%m-%dT%H:%M:%S") + f".{when.microsecond // 100_000}Z"
