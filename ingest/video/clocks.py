"""When a film begins on the clock of a log that is not its own: GPX, tables of flights.

What the film says of its beginning is a first guess: cameras write their local time for UTC, and some write
the end of the recording. The movements of picture and receiver (`match.py`) then decide, over all of the
log: the film is laid where they agree if they agree nowhere else, and if its own clock can be read so. All
else is refused, as positions that belong to other moments bend a map or put it beside its place.
"""

import re
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from featuredb.errors import InvalidValueError, TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.text import parse_wall_clock
from featuredb.video.telemetry.values import Telemetry
from ingest.video.lag import Lag
from ingest.video.match import Match, MatchOptions, match_movement
from ingest.video.motion import Motion

# Hours that zones are ahead of UTC (IANA's tz database): whole and half ones from -12 to 14, and those of
# Nepal, Eucla and the Chatham Islands.
_ZONES_H = (*(0.5 * k for k in range(-24, 29)), 5.75, 8.75, 12.75, 13.75)
# Before this year a clock was not set: containers count from 1904 or 1970, chips from 1980 or 2000.
_FIRST_YEAR = 2005
_CLOCKS_S = (315_532_800.0, 4_102_444_800.0)  # 1980 to 2100, as in telemetry
_HALF_DAY_S = 43_200.0
_OVERRIDE = "give --film-start with when it begins, --gcp, or --no-telemetry"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockOptions:
    """When a film's place on a log's clock is believed; `python -m tools.clock_study` prints the shares.

    Attributes:
        drift_s: how wrong a camera's clock may be beside its zone: one that is set by hand once a month.
        told_s: how far from what a person says the speeds may move it, as for telemetry in the film's time.
        margin: every other beginning must be so much less likely, as a natural logarithm (`Match.evidence`),
            and farther away than `repeat_s`, where a flight may repeat itself, beyond so many deviations of
            what chance does to that (`Match.luck`).
        deviations, repeat_s: see margin.
        spread_s: beginnings that are not, beside the best, are within so many seconds of it: at 10 m/s an
            error of a second is that of a poor receiver.
        min_correlation: of the speeds, or of the turns: cameras that tilt and turn all the time have no more.
        max_search_s: of log to be searched; longer ones are no flight.
        match: how movements are compared. Films shorter than its `least_s` have one bend or one stop, and
            those of other flights are like it.
    """

    drift_s: float = 120.0
    told_s: float = 3.0
    margin: float = 7.0
    deviations: float = 2.0
    repeat_s: float = 10.0
    spread_s: float = 1.0
    min_correlation: float = 0.5
    match: MatchOptions = field(default_factory=lambda: MatchOptions(least_s=40.0))
    max_search_s: float = 172_800.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmTime:
    """What is known of a film's beginning.

    Attributes:
        name: of the film, for messages.
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
        or not _CLOCKS_S[0] < clock.seconds < _CLOCKS_S[1]
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


def check_overlap(film: FilmTime, telemetry: Telemetry, options: ClockOptions | None = None) -> None:
    """Refuse, before the film is looked at, a log that cannot be of it by any reading of the clocks.

    Raises:
        TelemetryError: names both spans.
    """
    options = options or ClockOptions()
    low, high = _log_span(telemetry)
    if film.told_s is not None:
        if film.told_s > high or film.told_s + film.duration_s < low:
            raise TelemetryError(
                f"{_log(telemetry)}; a film of {film.duration_s:.0f} s that begins "
                f"{_at(film.told_s, telemetry)} (--film-start) has no moment in common with it"
            )
        return
    expected = _expected(film, telemetry)
    if expected is not None and not any(
        start - options.drift_s <= high and start + film.duration_s + options.drift_s >= low
        for start in expected
    ):
        assert film.created is not None
        raise TelemetryError(
            f"{_log(telemetry)}; {film.name} lasts {film.duration_s:.0f} s and was made at "
            f"{_utc(film.created.timestamp())} by its own clock: they do not overlap in any time zone, "
            "whether recording began or ended then. Give the log of this flight, or --film-start if the "
            "film's clock is wrong"
        )


def lay_on_film(
    motion: Motion, telemetry: Telemetry, film: FilmTime, options: ClockOptions | None = None
) -> Lag:
    """Where on the telemetry's `times_s` the film's time 0 is, as a lag; None with the reason where unclear.

    The telemetry is not in the film's time. A beginning that a person tells is moved by `told_s` at most, and
    stays as it is where the movements do not tell.
    """
    options = options or ClockOptions()
    low, high = _log_span(telemetry)
    first, last = (float(motion.time_s[k]) for k in (0, -1)) if len(motion) else (0.0, 0.0)
    search = (low - last, high - first)
    if film.told_s is not None:
        # A person who is wrong by an hour can be told so, and need not be by a week.
        search = (max(search[0], film.told_s - _HALF_DAY_S), min(search[1], film.told_s + _HALF_DAY_S))
    elif high - low > options.max_search_s:
        return _refused(
            f"{_log(telemetry)}: too long to look for a film in; cut it to the day of the flight, or "
            f"{_OVERRIDE}"
        )
    match = match_movement(motion, telemetry, search, options.match) if search[0] < search[1] else None
    if match is not None and not (match.evidence > 0).any():
        match = None
    if film.told_s is not None:
        near = (film.told_s - options.told_s, film.told_s + options.told_s)
        close = match_movement(motion, telemetry, near, MatchOptions())
        return _near_told(match, close, telemetry, film, film.told_s, options)
    if match is None:
        return _refused(
            f"{_log(telemetry)}; {film.name} has less than {options.match.least_s:.0f} s of movement in "
            f"common with it, too little to tell where in it the film begins: {_OVERRIDE}"
        )
    return _found(match, telemetry, film, options)


def _found(match: Match, telemetry: Telemetry, film: FilmTime, options: ClockOptions) -> Lag:
    """The beginning by the movements alone, if it is clear and the film's own clock can mean it."""
    found = best_beginning(match, options)
    start, correlation = found.lag_s, found.correlation
    if found.lead < options.margin or correlation < options.min_correlation:
        return _refused(
            f"the movements of picture and receiver do not tell where {film.name} begins in all of the log: "
            f"they correlate by {correlation:.2f} if it does {_at(start, telemetry)}, and by "
            f"{found.rival_correlation:.2f} {_at(found.rival_s, telemetry)}; {_log(telemetry)}. Steady "
            f"flights, repeated patterns and short films do not tell: {_OVERRIDE}",
            correlation,
        )
    said = f"the film begins {_at(start, telemetry)} of the log by the movements of picture and receiver "
    said += f"(correlation {correlation:.2f})"
    expected = _expected(film, telemetry)
    if expected is None:
        return Lag(late_s=round(start, 3), correlation=correlation, message=said)
    assert film.created is not None
    ahead = film.created.timestamp() - (clock_offset_s(telemetry) or 0.0) - start
    if np.abs(start - expected).min() > options.drift_s:
        return _refused(
            f"{said}, but {film.name} was made at {_utc(film.created.timestamp())} by its own clock, "
            f"{ahead:+.0f} s from there, and that is no time zone; if that clock is wrong, give --film-start "
            f"{_text(start, telemetry)}",
            correlation,
        )
    if abs(ahead) > 0.5:
        said += f"; the time of making in its file is {ahead:+.1f} s from there{_reading(ahead, film)}"
    return Lag(late_s=round(start, 3), correlation=correlation, message=said)


def _near_told(
    match: Match | None,
    close: Match | None,
    telemetry: Telemetry,
    film: FilmTime,
    told: float,
    options: ClockOptions,
) -> Lag:
    """What a person tells: moved a little where movements are clear, refused where they clearly deny it."""
    if match is not None:
        far = best_beginning(match, options)
        clear = far.lead >= options.margin and far.correlation >= options.min_correlation
        if clear and abs(far.lag_s - told) > options.told_s:
            return _refused(
                f"--film-start says that {film.name} begins {_at(told, telemetry)}; picture and receiver "
                f"move alike only if it begins {_at(far.lag_s, telemetry)} (correlation "
                f"{far.correlation:.2f}). Give --film-start {_text(far.lag_s, telemetry)}, or "
                "--telemetry-late 0 beside yours if you are sure of it",
                far.correlation,
            )
    found = None if close is None else best_beginning(close, options)
    if (
        found is None
        or found.lead < options.margin
        or found.correlation < options.min_correlation
        # At the edge of what was looked at the best is not yet found.
        or abs(found.lag_s - told) > options.told_s - 0.5
    ):
        return Lag(
            late_s=told,
            correlation=float("nan"),
            message=f"the film begins {_at(told, telemetry)} of the log, as was told; the movements of "
            "picture and receiver neither confirm nor deny it",
        )
    return Lag(
        late_s=round(found.lag_s, 3),
        correlation=found.correlation,
        message=f"the film begins {_at(found.lag_s, telemetry)} of the log, {found.lag_s - told:+.2f} s from "
        f"what was told, by the movements of picture and receiver (correlation {found.correlation:.2f})",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Beginning:
    """The likeliest beginning of a film in a log, and the likeliest one elsewhere.

    Attributes:
        lag_s, rival_s: where they are.
        correlation, rival_correlation: of speeds or turns, the better one.
        lead: how much more evidence there is for the first than chance gives it.
    """

    lag_s: float
    correlation: float
    rival_s: float
    rival_correlation: float
    lead: float


def best_beginning(match: Match, options: ClockOptions) -> Beginning:
    """The likeliest lag, and its lead over those that are farther than `spread_s` from it."""
    evidence = match.evidence
    best = int(np.argmax(evidence))
    away_s = np.abs(match.lags_s - match.lags_s[best])
    # Beside the best the curves are nearly the same, and so is what chance does to them.
    chance = np.where(away_s > options.repeat_s, options.deviations * match.luck(best), 0.0)
    elsewhere = away_s > options.spread_s
    behind = np.where(elsewhere, evidence[best] - evidence - chance, np.inf)
    rival = int(np.argmin(behind)) if elsewhere.any() else best
    better = np.nan_to_num(np.fmax(match.speed, match.turn))
    return Beginning(
        lag_s=float(match.lags_s[best]),
        correlation=float(better[best]),
        rival_s=float(match.lags_s[rival]),
        rival_correlation=float(better[rival]),
        lead=float(min(behind[rival], evidence[best])),
    )


def _expected(film: FilmTime, telemetry: Telemetry) -> FloatArray | None:
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


def _reading(ahead_s: float, film: FilmTime) -> str:
    """How a film's time is to be read that is so far ahead of its true beginning."""
    readings = [
        (abs(ahead_s - 3600.0 * zone - (film.duration_s if end else 0.0)), abs(zone), end, zone)
        for zone in _ZONES_H
        for end in (False, True)
    ]
    # Of readings that are as good as each other, the one with the least to explain.
    least = min(readings)[0]
    _, _, end, zone = min((r for r in readings if r[0] <= least + 2.0), key=lambda r: (r[1], r[2]))
    parts = [f"in a zone {zone:+g} h from the log's clock"] if zone else []
    parts += ["of the end of the recording"] if end else []
    return f" ({', '.join(parts)})" if parts else ""


def _refused(reason: str, correlation: float = float("nan")) -> Lag:
    return Lag(late_s=None, correlation=correlation, message=reason)


def _log_span(telemetry: Telemetry) -> tuple[float, float]:
    """First and last sample with a position, seconds."""
    known = telemetry.times_s[telemetry.has_position]
    return (float(known[0]), float(known[-1])) if len(known) else (0.0, -1.0)


def _log(telemetry: Telemetry) -> str:
    low, high = _log_span(telemetry)
    name = telemetry.origin or telemetry.source
    return f"{name} has positions from {_text(low, telemetry)} to {_text(high, telemetry)}"


def _at(log_s: float, telemetry: Telemetry) -> str:
    return f"at {_text(log_s, telemetry)}"


def _text(log_s: float, telemetry: Telemetry) -> str:
    """A moment of the log as --film-start takes it."""
    offset = clock_offset_s(telemetry)
    if offset is None:
        return f"{log_s:.1f}"
    return _utc(log_s + offset) if telemetry.clock == "utc" else _utc(log_s + offset).removesuffix("Z")


def _utc(seconds: float) -> str:
    when = datetime.fromtimestamp(round(seconds, 1), UTC)
    return when.strftime("%Y-%m-%dT%H:%M:%S") + f".{when.microsecond // 100_000}Z"
