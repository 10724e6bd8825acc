"""When a film begins on the clock of a log that is not its own: GPX, tables of flights.

What the film says of its beginning is a first guess: cameras write their local time for UTC, and some write
the end of the recording. The movements of picture and receiver (`match.py`) then decide, over all of the
log: the film is laid where they agree if they agree nowhere else, and if its own clock can be read so. All
else is refused, as positions that belong to other moments bend a map or put it beside its place.
"""

from dataclasses import dataclass

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.values import Telemetry
from ingest.video.film_time import (
    FilmTime,
    clock_offset_s,
    log_span,
    log_text,
    moment_text,
    possible_beginnings,
    utc_text,
)
from ingest.video.lag import Lag
from ingest.video.match import Match, match_movement
from ingest.video.motion import Motion

_HALF_DAY_S = 43_200.0
_OVERRIDE = "give --film-start with when it begins, --gcp, or --no-telemetry"


_DRIFT_S = 120.0  # how wrong a camera's clock may be beside its zone: one that is set by hand once a month
_TOLD_S = 3.0  # how far from what a person says the speeds may move it, as for telemetry in the film's time
# Every other beginning must be so much less likely, as a natural logarithm (`Match.evidence`), and farther
# away than _REPEAT_S, where a flight may repeat itself, beyond so many deviations of what chance does to that
# (`Match.luck`).
_MARGIN = 7.0
_DEVIATIONS = 2.0
_REPEAT_S = 10.0
# Beginnings that are not, beside the best, are within so many seconds of it: at 10 m/s an error of a second
# is that of a poor receiver.
_SPREAD_S = 1.0
_MIN_CORRELATION = 0.5  # of the speeds, or of the turns: cameras that tilt and turn all the time have no more
_MAX_SEARCH_S = 172_800.0  # of log to be searched; longer ones are no flight
_LEAST_S = 40.0  # films shorter than that have one bend or one stop, and those of other flights are like it


def check_overlap(film: FilmTime, telemetry: Telemetry) -> None:
    """Refuse, before the film is looked at, a log that cannot be of it by any reading of the clocks.

    Raises:
        TelemetryError: names both spans.
    """
    low, high = log_span(telemetry)
    if film.told_s is not None:
        if film.told_s > high or film.told_s + film.duration_s < low:
            raise TelemetryError(
                f"{log_text(telemetry)}; a film of {film.duration_s:.0f} s that begins "
                f"at {moment_text(film.told_s, telemetry)} (--film-start) has no moment in common with it"
            )
        return
    expected = possible_beginnings(film, telemetry)
    if expected is not None and not any(
        start - _DRIFT_S <= high and start + film.duration_s + _DRIFT_S >= low for start in expected
    ):
        assert film.created is not None
        raise TelemetryError(
            f"{log_text(telemetry)}; {film.name} lasts {film.duration_s:.0f} s and was made at "
            f"{utc_text(film.created.timestamp())} by its own clock: they do not overlap in any time zone, "
            "whether recording began or ended then. Give the log of this flight, or --film-start if the "
            "film's clock is wrong"
        )


def lay_on_film(motion: Motion, telemetry: Telemetry, film: FilmTime) -> Lag:
    """Where on the telemetry's `times_s` the film's time 0 is, as a lag; None with the reason where unclear.

    The telemetry is not in the film's time. A beginning that a person tells is moved by `told_s` at most, and
    stays as it is where the movements do not tell.
    """
    low, high = log_span(telemetry)
    first, last = (float(motion.time_s[k]) for k in (0, -1)) if len(motion) else (0.0, 0.0)
    search = (low - last, high - first)
    if film.told_s is not None:
        # A person who is wrong by an hour can be told so, and need not be by a week.
        search = (max(search[0], film.told_s - _HALF_DAY_S), min(search[1], film.told_s + _HALF_DAY_S))
    elif high - low > _MAX_SEARCH_S:
        return Lag(
            None,
            f"{log_text(telemetry)}: too long to look for a film in; cut it to the day of the flight, or "
            f"{_OVERRIDE}",
        )
    match = match_movement(motion, telemetry, search, _LEAST_S) if search[0] < search[1] else None
    if match is not None and not (match.evidence > 0).any():
        match = None
    if film.told_s is not None:
        near = (film.told_s - _TOLD_S, film.told_s + _TOLD_S)
        close = match_movement(motion, telemetry, near)
        return _near_told(match, close, telemetry, film, film.told_s)
    if match is None:
        return Lag(
            None,
            f"{log_text(telemetry)}; {film.name} has less than {_LEAST_S:.0f} s of movement in "
            f"common with it, too little to tell where in it the film begins: {_OVERRIDE}",
        )
    return _found(match, telemetry, film)


def _found(match: Match, telemetry: Telemetry, film: FilmTime) -> Lag:
    """The beginning by the movements alone, if it is clear and the film's own clock can mean it."""
    found = best_beginning(match)
    start, correlation = found.lag_s, found.correlation
    begins = moment_text(start, telemetry)
    if not found.is_clear:
        return Lag(
            None,
            f"the movements of picture and receiver do not tell where {film.name} begins in all of the log: "
            f"they correlate by {correlation:.2f} if it does at {begins}, and by "
            f"{found.rival_correlation:.2f} at {moment_text(found.rival_s, telemetry)}; "
            f"{log_text(telemetry)}. Steady flights, repeated patterns and short films do not tell: "
            f"{_OVERRIDE}",
        )
    said = f"the film begins at {begins} of the log by the movements of picture and receiver "
    said += f"(correlation {correlation:.2f})"
    expected = possible_beginnings(film, telemetry)
    if expected is None:
        return Lag(round(start, 3), said)
    assert film.created is not None
    ahead = film.created.timestamp() - (clock_offset_s(telemetry) or 0.0) - start
    if np.abs(start - expected).min() > _DRIFT_S:
        return Lag(
            None,
            f"{said}, but {film.name} was made at {utc_text(film.created.timestamp())} by its own clock, "
            f"{ahead:+.0f} s from there, and that is no time zone; if that clock is wrong, give "
            f"--film-start {begins}",
        )
    if abs(ahead) > 0.5:
        said += f"; the time of making in its file is {ahead:+.1f} s from there"
    return Lag(round(start, 3), said)


def _near_told(
    match: Match | None, close: Match | None, telemetry: Telemetry, film: FilmTime, told: float
) -> Lag:
    """What a person tells: moved a little where movements are clear, refused where they clearly deny it."""
    if match is not None:
        far = best_beginning(match)
        if far.is_clear and abs(far.lag_s - told) > _TOLD_S:
            begins = moment_text(far.lag_s, telemetry)
            return Lag(
                None,
                f"--film-start says that {film.name} begins at {moment_text(told, telemetry)}; picture and "
                f"receiver move alike only if it begins at {begins} (correlation "
                f"{far.correlation:.2f}). Give --film-start {begins}, or "
                "--telemetry-late 0 beside yours if you are sure of it",
            )
    found = None if close is None else best_beginning(close)
    # At the edge of what was looked at the best is not yet found.
    if found is None or not found.is_clear or abs(found.lag_s - told) > _TOLD_S - 0.5:
        return Lag(
            told,
            f"the film begins at {moment_text(told, telemetry)} of the log, as was told; the movements of "
            "picture and receiver neither confirm nor deny it",
        )
    return Lag(
        round(found.lag_s, 3),
        f"the film begins at {moment_text(found.lag_s, telemetry)} of the log, {found.lag_s - told:+.2f} s "
        f"from what was told, by the movements of picture and receiver (correlation {found.correlation:.2f})",
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

    @property
    def is_clear(self) -> bool:
        """Whether the first is to be believed."""
        return self.lead >= _MARGIN and self.correlation >= _MIN_CORRELATION


def best_beginning(match: Match) -> Beginning:
    """The likeliest lag, and its lead over those that are farther than `spread_s` from it."""
    evidence = match.evidence
    best = int(np.argmax(evidence))
    away_s = np.abs(match.lags_s - match.lags_s[best])
    # Beside the best the curves are nearly the same, and so is what chance does to them.
    chance = np.where(away_s > _REPEAT_S, _DEVIATIONS * match.luck(best), 0.0)
    elsewhere = away_s > _SPREAD_S
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
