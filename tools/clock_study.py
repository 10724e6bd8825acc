"""How surely films are laid on the clock of a log by the movements of both: right, wrong, refused.

    python -m tools.clock_study [--flights N] [--films N] [--minutes M] [--seed S]

Simulated flights of M minutes: somebody with two sticks; those of the simulated town's films, whose camera
swings all the time (smooth, and jerky with gusts and turns on the spot); a survey of equal legs; a straight
line at one speed. Films are stretches of a flight at random times; their pictures move as flat ground does,
with noise. The log has a receiver's slow errors, and nothing is known of the film's clock. A line for each
kind of flight, rate of the log and length of the films: films, share laid, share laid more than a second
wrong, median and largest error of the others (seconds); and the share laid on the log of another flight,
where all are wrong. Then the same shares over all films by the thresholds of `ClockOptions`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise, product

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.flight_path import FlightPath, FlightStyle, PathOptions
from featuredb.simworld.shot import look_pose
from featuredb.simworld.town import make_town
from featuredb.video.telemetry.values import Telemetry
from ingest.video.clocks import Beginning, ClockOptions, best_beginning
from ingest.video.match import match_movement
from ingest.video.motion import Motion
from tools.growth_common import table

_RATE_HZ = 10.0
_FOCAL = 0.757  # in shares of the picture's longer side, as the simulated drone's
_NOISE = 2e-4  # of how far the picture moved from frame to frame, in shares of its side
# A receiver errs by metres, but slowly: it tells speed to some centimetres a second (u-blox M8: 0.05).
_DRIFT_M_S, _DRIFT_MEMORY_S, _WHITE_M = 0.1, 5.0, 0.02
_KINDS = ("pilot", "smooth", "jerky", "survey", "steady")
_BEGIN = datetime(2025, 6, 21, 12, 0, tzinfo=UTC)
_LENGTHS_S = (15.0, 30.0, 60.0, 120.0, 300.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flight:
    """n frames: (n,) seconds, (n, 3) places in metres, (n, 2, 3) similarities as `Motion.step`."""

    times_s: FloatArray
    places_m: FloatArray
    step: FloatArray


_MARGINS, _DEVIATIONS, _LEAST = (2.0, 4.0, 7.0), (0.0, 1.0, 2.0, 3.0), (0.4, 0.5, 0.6, 0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Case:
    """One film: its error in seconds, and what is found in its log and another flight's, by deviations."""

    error_s: float
    own: dict[float, Beginning]
    other: dict[float, Beginning]


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    options = ClockOptions()
    rows, every = [], []
    for kind in args.kinds:
        flights = [_flight(kind, args.seed + k, 60.0 * args.minutes) for k in range(args.flights + 1)]
        for rate_hz in (1.0, 10.0):
            for length_s in _LENGTHS_S:
                rng = np.random.default_rng((args.seed, len(rows)))
                cases = _cases(flights, rate_hz, length_s, args.films, rng)
                every += cases
                good = [c.error_s for c in cases if _clear(c.own, options) and c.error_s <= 1.0]
                errors = (np.median(good), max(good)) if good else (np.nan, np.nan)
                laid, wrong, other = _shares(cases, options)
                rows.append((kind, rate_hz, length_s, len(cases), laid, wrong, *errors, other))
    head = ("flight", "log Hz", "film s", "films", "laid", "wrong", "median s", "most s", "other flight's")
    sys.stdout.write(table(rows, head) + "\n\n")
    found = [
        (*how, *_shares(every, replace(options, margin=how[0], deviations=how[1], min_correlation=how[2])))
        for how in product(_MARGINS, _DEVIATIONS, _LEAST)
    ]
    sys.stdout.write(table(found, ("margin", "deviations", "least r", *head[4:6], head[-1])) + "\n")
    return 0


def _clear(found: dict[float, Beginning], options: ClockOptions) -> bool:
    best = found[options.deviations]
    return best.lead >= options.margin and best.correlation >= options.min_correlation


def _shares(cases: list[_Case], options: ClockOptions) -> tuple[float, float, float]:
    """Of the films that are laid, laid wrong, and laid on the log of another flight."""
    laid = np.array([_clear(c.own, options) for c in cases])
    wrong = laid & (np.array([c.error_s for c in cases]) > 1.0)
    other = np.array([_clear(c.other, options) for c in cases])
    return float(laid.mean()), float(wrong.mean()), float(other.mean())


def _cases(
    flights: list[Flight], rate_hz: float, length_s: float, films: int, rng: np.random.Generator
) -> list[_Case]:
    logs = [_log(flight, rate_hz, rng) for flight in flights]
    cases = []
    for k, flight in enumerate(flights[:-1]):
        for _ in range(films):
            begin = rng.uniform(0.0, flight.times_s[-1] - length_s)
            motion = _film(flight, begin, length_s, rng)
            own, other = _judged(motion, logs[k]), _judged(motion, logs[k + 1])
            cases.append(_Case(error_s=abs(own[0.0].lag_s - begin), own=own, other=other))
    return cases


def _judged(motion: Motion, log: Telemetry) -> dict[float, Beginning]:
    """As `lay_on_film` looks for it."""
    options = ClockOptions()
    span = (float(log.times_s[0] - motion.time_s[-1]), float(log.times_s[-1] - motion.time_s[0]))
    match = match_movement(motion, log, span, options.match)
    assert match is not None
    return {d: best_beginning(match, replace(options, deviations=d)) for d in _DEVIATIONS}


def _flight(kind: str, seed: int, duration_s: float) -> Flight:
    times = np.arange(0.0, duration_s, 1.0 / _RATE_HZ)
    if kind in ("smooth", "jerky"):
        style: FlightStyle = "jerky" if kind == "jerky" else "smooth"
        path = FlightPath(make_town(1), PathOptions(seed=seed, style=style, duration_s=duration_s))
        poses = [path.pose(t) for t in times]
    else:
        poses = _poses(*{"pilot": _pilot, "survey": _survey, "steady": _steady}[kind](times, seed))
    steps = [np.eye(2, 3), *(_step(before, now) for before, now in pairwise(poses))]
    return Flight(times_s=times, places_m=np.array([p.center for p in poses]), step=np.array(steps))


# Headings (n,) in degrees, speeds (n,) along them in m/s, and pitches (n,) in degrees.
_Course = tuple[FloatArray, FloatArray, FloatArray]


def _pilot(times_s: FloatArray, seed: int) -> _Course:
    """Somebody with two sticks: stops, flies, flies in bends, and sometimes tilts the camera."""
    rng = np.random.default_rng((seed, 81))
    turn, speed, pitch = (np.zeros(len(times_s)) for _ in range(3))
    k, tilt = 0, -50.0
    while k < len(times_s):
        n = int(_RATE_HZ * rng.uniform(4.0, 15.0))
        hover = rng.random() < 0.25
        speed[k : k + n] = 0.0 if hover else rng.uniform(2.0, 11.0)
        turn[k : k + n] = rng.choice([0.0, 0.0, 1.0]) * rng.normal(0.0, 15.0)
        tilt = float(rng.uniform(-75.0, -35.0)) if rng.random() < 0.2 else tilt
        pitch[k : k + n] = tilt
        k += n
    soft = np.hanning(int(3.0 * _RATE_HZ))
    speed, turn, pitch = (
        np.convolve(np.pad(v, len(soft), mode="edge"), soft / soft.sum(), "same")[len(soft) : -len(soft)]
        for v in (speed, turn, pitch)
    )
    return np.cumsum(turn) / _RATE_HZ, speed, pitch


def _survey(times_s: FloatArray, seed: int) -> _Course:
    """Legs of 40 s at 6 m/s, one like the other, slow while it turns: to and fro."""
    phase = times_s % 40.0
    near = np.minimum(phase, 40.0 - phase)
    turning = np.clip(1.0 - near / 4.0, 0.0, 1.0)
    side = np.where((times_s // 40.0).astype(int) % 2 == 0, 1.0, -1.0) * np.sign(phase - 20.0)
    turn = side * np.where(turning > 0, 22.5, 0.0)  # 180 degrees in the eight seconds around the end of a leg
    return np.cumsum(turn) / _RATE_HZ, 6.0 - 4.0 * turning, np.full(len(times_s), -70.0 + seed % 5)


def _steady(times_s: FloatArray, seed: int) -> _Course:
    """Straight ahead."""
    ones = np.ones(len(times_s))
    return 40.0 * seed * ones, 6.0 * ones, -60.0 * ones


def _poses(heading_deg: FloatArray, speed_m_s: FloatArray, pitch_deg: FloatArray) -> list[Rigid3]:
    h = np.radians(heading_deg)
    places = np.cumsum(speed_m_s[:, None] * np.stack([np.sin(h), np.cos(h)], axis=1), axis=0) / _RATE_HZ
    return [
        look_pose(np.array([*place, 60.0]), float(heading), float(pitch))
        for place, heading, pitch in zip(places, heading_deg, pitch_deg, strict=True)
    ]


_GRID = np.array([[x, y, 1.0] for x in (-0.2, 0.0, 0.2) for y in (-0.12, 0.0, 0.12)])


def _step(before: Rigid3, now: Rigid3) -> FloatArray:
    """(2, 3) similarity between two pictures, lengths in shares of the longer side: flat ground at 0."""
    rays = (_GRID / (_FOCAL, _FOCAL, 1.0)) @ before.rotation
    far = np.where(rays[:, 2] < -0.05, -before.center[2] / np.minimum(rays[:, 2], -0.05), 1000.0)
    seen = (before.center + rays * far[:, None]) @ now.rotation.T + now.translation
    there = _FOCAL * seen[:, :2] / seen[:, 2:]
    # One complex number turns and scales, another shifts.
    complexes = np.stack([_GRID[:, 0] + 1j * _GRID[:, 1], np.ones(len(_GRID))], axis=1)
    (turn, shift), *_ = np.linalg.lstsq(complexes, there[:, 0] + 1j * there[:, 1], rcond=None)
    return np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag]])


def _film(flight: Flight, begin_s: float, length_s: float, rng: np.random.Generator) -> Motion:
    rows = np.flatnonzero((flight.times_s >= begin_s) & (flight.times_s < begin_s + length_s))
    step = flight.step[rows] + rng.normal(0.0, _NOISE, (len(rows), 2, 3))
    return Motion(
        index=np.arange(len(rows)),
        time_s=flight.times_s[rows] - begin_s,
        step=step,
        broken=np.arange(len(rows)) == 0,
        sharpness=np.ones(len(rows)),
    )


def _log(flight: Flight, rate_hz: float, rng: np.random.Generator) -> Telemetry:
    every = round(_RATE_HZ / rate_hz)
    times, places = flight.times_s[::every], flight.places_m[::every, :2]
    keep = np.exp(-1.0 / (_RATE_HZ * _DRIFT_MEMORY_S))
    drift = rng.standard_normal((len(flight.times_s), 2)) * _DRIFT_M_S
    for k in range(1, len(drift)):
        drift[k] = keep * drift[k - 1] + np.sqrt(1.0 - keep**2) * drift[k]
    wander = (np.cumsum(drift, axis=0) / _RATE_HZ)[::every]
    east, north = (places + wander + rng.normal(0.0, _WHITE_M, places.shape)).T
    latitude = 48.0 + north / 111_195.0
    longitude = 8.0 + east / (111_195.0 * np.cos(np.radians(48.0)))
    return Telemetry(
        times_s=times,
        latitude_deg=np.round(latitude, 7),
        longitude_deg=np.round(longitude, 7),
        clock_s=_BEGIN.timestamp() + times,
        clock="utc",
        in_video_time=False,
        source="simulated",
    )


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=3, help="of each kind; default: 3")
    parser.add_argument("--films", type=int, default=10, help="of each flight and length; default: 10")
    parser.add_argument("--minutes", type=float, default=20.0, help="of a flight; default: 20")
    parser.add_argument("--kinds", nargs="+", choices=_KINDS, default=_KINDS)
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
