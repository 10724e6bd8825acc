"""Where a film lies on the clock of a log: found by movement, believed only where that is clear."""

from datetime import UTC, datetime, timedelta

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import InvalidValueError, TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoFrame
from featuredb.video.telemetry.values import Clock, Telemetry
from ingest.video.clocks import check_overlap, lay_on_film
from ingest.video.film_time import FilmTime, film_start
from ingest.video.match import _picture_turn
from ingest.video.motion import Motion, measure_motion
from tests.support.films import picture

_NOON = datetime(2024, 5, 31, 12, 0, tzinfo=UTC)
_LOG_S, _FILM_S, _BEGIN_S = 1200.0, 150.0, 431.7
_VIEW_M = 60.0  # what the picture shows across


class _Flight:
    """Speed and course over time: legs of random length, speed and turn, softened as a drone flies them."""

    def __init__(self, seed: int, *, steady: bool = False, period_s: float | None = None) -> None:
        rng = np.random.default_rng(seed)
        self.times_s = np.arange(0.0, _LOG_S + 1.0, 0.05)
        speed, turn = np.full(len(self.times_s), 6.0), np.zeros(len(self.times_s))
        k = 0
        while k < len(speed) and not steady:
            n = int(20 * rng.uniform(3.0, 9.0))
            speed[k : k + n], turn[k : k + n] = rng.uniform(1.0, 10.0), rng.normal(0.0, 0.12)
            k += n
        soft = np.hanning(40) / np.hanning(40).sum()
        speed, turn = (np.convolve(np.pad(v, 40, mode="edge"), soft, "same")[40:-40] for v in (speed, turn))
        if period_s is not None:
            again = np.round(20 * (self.times_s % period_s)).astype(int)
            speed, turn = speed[again], turn[again]
        self.speed, self.turn = speed, turn
        course = np.cumsum(turn) * 0.05
        self.east, self.north = (np.cumsum(speed * way(course)) * 0.05 for way in (np.sin, np.cos))

    def film(self, rng: np.random.Generator, begin_s: float = _BEGIN_S, length_s: float = _FILM_S) -> Motion:
        times = np.arange(0.0, length_s, 1 / 25)
        speed, turn = (np.interp(times + begin_s, self.times_s, v) / 25 for v in (self.speed, self.turn))
        step = np.zeros((len(times), 2, 3))
        step[:, 0, 0], step[:, 0, 1] = np.cos(turn), np.sin(turn)
        step[:, 1, 0], step[:, 1, 1] = -np.sin(turn), np.cos(turn)
        # The picture's middle goes down as the camera flies on, and aside as it turns.
        step[:, :, 2] = np.stack([-0.5 * turn, speed / _VIEW_M], axis=1)
        step += rng.normal(0.0, 2e-4, step.shape)
        return Motion(
            index=np.arange(len(times)),
            time_s=times,
            step=step,
            broken=np.arange(len(times)) == 0,
            cut=np.arange(len(times)) == 0,
            kind=np.zeros(len(times), dtype=np.int8),
            sharpness=np.ones(len(times)),
        )

    def log(self, rng: np.random.Generator, clock: Clock = "utc", rate_hz: float = 1.0) -> Telemetry:
        times = np.arange(0.0, _LOG_S, 1 / rate_hz)
        east, north = (
            np.interp(times, self.times_s, v) + rng.normal(0.0, 0.05, len(times))
            for v in (self.east, self.north)
        )
        return Telemetry(
            times_s=times,
            latitude_deg=48.0 + north / 111_320.0,
            longitude_deg=8.0 + east / (111_320.0 * np.cos(np.radians(48.0))),
            clock_s=np.full(len(times), np.nan) if clock == "none" else _NOON.timestamp() + times,
            clock=clock,
            in_video_time=False,
            source="GPX",
            origin="flight.gpx",
        )


@pytest.fixture(scope="module")
def flight() -> _Flight:
    return _Flight(1)


def _film(created: datetime | None = None, told_s: float | None = None) -> FilmTime:
    return FilmTime(name="film.mp4", duration_s=_FILM_S, created=created, told_s=told_s)


_TRUE = _NOON + timedelta(seconds=_BEGIN_S)


@pytest.mark.parametrize(
    ("created", "said"),
    [
        (None, "of the log by the movements"),
        (_TRUE, "by the movements"),
        (_TRUE + timedelta(hours=2), "+7200.0 s from there"),
        (_TRUE - timedelta(hours=7), "-25200.0 s from there"),
        (_TRUE + timedelta(hours=5.75), "+20700.0 s from there"),
        (_TRUE + timedelta(seconds=_FILM_S), f"{_FILM_S:+.1f} s from there"),
        (_TRUE + timedelta(hours=-3.5, seconds=_FILM_S), f"{_FILM_S - 12600.0:+.1f} s from there"),
        (_TRUE + timedelta(seconds=40), "+40.0 s from there"),
        (datetime(1970, 1, 1, tzinfo=UTC), "by the movements"),
    ],
)
def test_a_film_is_found_whatever_its_clock_means(
    flight: _Flight, created: datetime | None, said: str
) -> None:
    rng = np.random.default_rng(2)
    found = lay_on_film(flight.film(rng), flight.log(rng), _film(created))
    assert found.late_s == pytest.approx(_BEGIN_S, abs=0.15), found.message
    assert said in found.message
    assert "2024-05-31T12:07:1" in found.message


@pytest.mark.parametrize("clock", ["local", "none"])
@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_clocks_of_no_zone_and_no_clock_at_all(flight: _Flight, clock: Clock, rate_hz: float) -> None:
    rng = np.random.default_rng(3)
    created = _TRUE - timedelta(hours=9, seconds=3)
    found = lay_on_film(flight.film(rng), flight.log(rng, clock, rate_hz), _film(created))
    assert found.late_s == pytest.approx(_BEGIN_S, abs=0.15), found.message


def test_a_film_that_begins_before_the_log(flight: _Flight) -> None:
    rng = np.random.default_rng(4)
    log = flight.log(rng, rate_hz=5.0)
    rows = log.times_s >= _BEGIN_S + 40.0
    late = Telemetry(
        times_s=log.times_s[rows] - log.times_s[rows][0],
        latitude_deg=log.latitude_deg[rows],
        longitude_deg=log.longitude_deg[rows],
        clock_s=log.clock_s[rows],
        clock="utc",
        in_video_time=False,
        source="GPX",
    )
    found = lay_on_film(flight.film(rng), late, _film())
    assert found.late_s == pytest.approx(_BEGIN_S - log.times_s[rows][0], abs=0.15), found.message


def test_the_seam_of_longitude_is_no_movement() -> None:
    rng = np.random.default_rng(5)
    flight = _Flight(6)
    log = flight.log(rng)
    moved = log.longitude_deg + (180.0 - float(np.median(log.longitude_deg)))
    seam = Telemetry(
        times_s=log.times_s,
        latitude_deg=log.latitude_deg,
        longitude_deg=(moved + 180.0) % 360.0 - 180.0,
        in_video_time=False,
        source="GPX",
    )
    assert np.ptp(seam.longitude_deg) > 300.0
    assert lay_on_film(flight.film(rng), seam, _film()).late_s == pytest.approx(_BEGIN_S, abs=0.15)


@pytest.mark.parametrize(
    ("flown", "logged"),
    [
        (_Flight(1, steady=True), _Flight(1, steady=True)),
        (_Flight(1, period_s=60.0), _Flight(1, period_s=60.0)),
        (_Flight(1), _Flight(2)),
        (_Flight(3), _Flight(1, steady=True)),
    ],
    ids=["steady", "repeated", "another flight", "another, steady"],
)
def test_what_does_not_tell_is_refused_with_what_to_do(flown: _Flight, logged: _Flight) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = lay_on_film(flown.film(rng), logged.log(rng), _film(_TRUE))
        assert found.late_s is None
        assert "--film-start" in found.message
        assert "--no-telemetry" in found.message
        assert (
            "flight.gpx has positions from 2024-05-31T12:00:00.0Z to 2024-05-31T12:19:59.0Z" in found.message
        )


def test_a_short_film_is_refused(flight: _Flight) -> None:
    rng = np.random.default_rng(7)
    found = lay_on_film(flight.film(rng, length_s=25.0), flight.log(rng), _film(_TRUE))
    assert found.late_s is None
    assert "less than 40 s of movement" in found.message


def test_a_clock_that_is_no_zone_off_is_told_and_not_believed(flight: _Flight) -> None:
    rng = np.random.default_rng(8)
    found = lay_on_film(flight.film(rng), flight.log(rng), _film(_TRUE + timedelta(minutes=14)))
    assert found.late_s is None
    assert "+840 s from there, and that is no time zone" in found.message
    assert "--film-start 2024-05-31T12:07:1" in found.message


def test_what_a_person_tells_is_moved_a_little(flight: _Flight) -> None:
    rng = np.random.default_rng(9)
    found = lay_on_film(flight.film(rng), flight.log(rng), _film(told_s=_BEGIN_S + 1.3))
    assert found.late_s == pytest.approx(_BEGIN_S, abs=0.15)
    assert "from what was told" in found.message


def test_what_a_person_tells_stands_where_movements_are_silent() -> None:
    rng = np.random.default_rng(10)
    steady = _Flight(1, steady=True)
    found = lay_on_film(steady.film(rng), steady.log(rng), _film(told_s=_BEGIN_S))
    assert found.late_s == _BEGIN_S
    assert "neither confirm nor deny" in found.message


def test_what_a_person_tells_is_refused_where_movements_deny_it(flight: _Flight) -> None:
    rng = np.random.default_rng(11)
    found = lay_on_film(flight.film(rng), flight.log(rng), _film(told_s=_BEGIN_S + 300.0))
    assert found.late_s is None
    assert "move alike only if it begins at 2024-05-31T12:07:1" in found.message
    assert "--telemetry-late 0" in found.message


def test_logs_that_cannot_be_of_the_film_are_refused_with_both_spans(flight: _Flight) -> None:
    log = flight.log(np.random.default_rng(12))
    with pytest.raises(
        TelemetryError,
        match=r"from 2024-05-31T12:00:00.0Z to 2024-05-31T12:19:59.0Z; film.mp4 lasts 150 s and was made at "
        r"2024-06-02T12:00:00.0Z .* do not overlap in any time zone.*--film-start",
    ):
        check_overlap(_film(_NOON + timedelta(days=2)), log)
    with pytest.raises(TelemetryError, match=r"begins at 2024-05-31T13:00:00.0Z \(--film-start\)"):
        check_overlap(_film(told_s=3600.0), log)
    for created in (None, _NOON + timedelta(hours=14), _NOON - timedelta(hours=12), _NOON.replace(year=1904)):
        check_overlap(_film(created), log)
    check_overlap(_film(told_s=-100.0), log)


def test_a_log_of_days_is_not_searched(flight: _Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ingest.video.clocks._MAX_SEARCH_S", 600.0)
    rng = np.random.default_rng(13)
    log = flight.log(rng)
    found = lay_on_film(flight.film(rng), log, _film())
    assert found.late_s is None
    assert "too long to look for a film in" in found.message


@pytest.mark.parametrize(
    ("text", "clock", "seconds"),
    [
        ("2024-05-31T12:07:11.7Z", "utc", _BEGIN_S),
        ("2024-05-31T14:07:11.7+02:00", "utc", _BEGIN_S),
        ("2024-05-31 12:07:11.7", "local", _BEGIN_S),
        ("431.7", "none", _BEGIN_S),
    ],
)
def test_film_starts(flight: _Flight, text: str, clock: Clock, seconds: float) -> None:
    log = flight.log(np.random.default_rng(14), clock)
    assert film_start(text, log) == pytest.approx(seconds, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "clock", "said"),
    [
        ("2024-05-31T12:07:11", "utc", "name the zone"),
        ("2024-05-31T12:07:11Z", "local", "without a zone"),
        ("2024-05-31T12:07:11Z", "none", "has no clock"),
        ("431.7", "utc", "expected a date and time"),
        ("noon", "local", "expected a date and time"),
        ("2024-13-31T12:07:11Z", "utc", "expected a date and time"),
        ("9999-12-31T23:59:59-12:00", "utc", "expected a date and time"),
        ("0001-01-01T00:00:00+12:00", "utc", "expected a date and time"),
        ("nan", "none", "has no clock"),
    ],
)
def test_film_starts_that_mean_nothing(flight: _Flight, text: str, clock: Clock, said: str) -> None:
    with pytest.raises(InvalidValueError, match=said):
        film_start(text, flight.log(np.random.default_rng(15), clock))


def test_telemetry_in_the_films_time_has_no_beginning() -> None:
    own = Telemetry(times_s=np.arange(3.0), latitude_deg=np.ones(3), longitude_deg=np.ones(3), source="SRT")
    with pytest.raises(InvalidValueError, match="in the film's time already"):
        film_start("2024-05-31T12:07:11Z", own)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    steps=st.lists(st.sampled_from([1e-9, 0.01, 0.2, 1.0, 30.0, 5000.0]), min_size=1, max_size=60),
    places=st.lists(
        st.one_of(st.just(float("nan")), st.floats(-1.0, 1.0), st.sampled_from([0.0, 90.0])),
        min_size=60,
        max_size=60,
    ),
    told=st.one_of(st.none(), st.floats(-1e5, 1e5)),
    clock=st.sampled_from(["utc", "none"]),
)
def test_any_log_is_laid_or_refused(
    steps: list[float], places: list[float], told: float | None, clock: Clock
) -> None:
    times, values = np.cumsum(steps), np.array(places[: len(steps)])
    log = Telemetry(
        times_s=times,
        latitude_deg=values,
        longitude_deg=values,
        clock_s=np.full(len(times), np.nan) if clock == "none" else _NOON.timestamp() + times,
        clock=clock,
        in_video_time=False,
        source="CSV",
    )
    film = _film(_TRUE, told)
    motion = _Flight(1).film(np.random.default_rng(1), length_s=60.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ingest.video.clocks._MAX_SEARCH_S", 20_000.0)
        found = lay_on_film(motion, log, film)
    assert found.message
    assert found.late_s is None or np.isfinite(found.late_s)


def test_a_camera_that_turns_clockwise_turns_its_picture_the_other_way() -> None:
    """Measured in pictures, so that the signs of `match.py` are those of cameras that look down."""
    ground = picture(0, 480, 360)
    frames = [
        cv2.warpAffine(ground, cv2.getRotationMatrix2D((240, 180), 0.5 * k, 1.0), (480, 360))[60:300, 80:400]
        for k in range(6)  # OpenCV's positive angles are counter-clockwise
    ]
    motion = measure_motion(
        VideoFrame(index=k, time_s=0.1 * k, gray=np.ascontiguousarray(f[:, :, 0]), rgb=lambda f=f: f)  # type: ignore[misc]
        for k, f in enumerate(frames)
    )
    np.testing.assert_allclose(_picture_turn(motion).values, np.radians(5.0), rtol=0.05)


def test_errors_over_many_flights() -> None:
    """None is laid more than half a second off, and most are laid."""
    errors: list[float] = []
    for seed in range(20, 32):
        rng = np.random.default_rng(seed)
        flight = _Flight(seed)
        begin = float(rng.uniform(-20.0, _LOG_S - _FILM_S))
        found = lay_on_film(flight.film(rng, max(begin, 0.0)), flight.log(rng), _film())
        errors.append(np.nan if found.late_s is None else found.late_s - max(begin, 0.0))
    off: FloatArray = np.array(errors)
    assert np.isfinite(off).mean() > 0.8
    assert np.nanmax(np.abs(off)) < 0.5
