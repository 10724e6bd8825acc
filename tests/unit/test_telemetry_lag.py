"""The lag of telemetry behind its film, by the speeds of both."""

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry
from ingest.video.lag import estimate_lag
from ingest.video.motion import Motion

_RATE_HZ, _SECONDS = 30.0, 30.0
_HEIGHT_M, _VIEW_M = 40.0, 50.0  # what the picture shows across


def _path(times_s: FloatArray, steady: bool = False) -> FloatArray:
    """Metres east: a drone that starts, stops, and starts again."""
    if steady:
        return 5.0 * times_s
    speed = 4.0 + 3.0 * np.sin(times_s / 2.3) + 1.5 * np.sin(times_s / 0.9 + 1.0)
    dense = np.linspace(-5.0, 40.0, 45_001)
    dense_speed = 4.0 + 3.0 * np.sin(dense / 2.3) + 1.5 * np.sin(dense / 0.9 + 1.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (dense_speed[1:] + dense_speed[:-1]) * np.diff(dense))])
    assert speed.min() > -1.0
    return np.interp(times_s, dense, way)


def _motion(rng: np.random.Generator, steady: bool = False) -> Motion:
    times = np.arange(0.0, _SECONDS, 1 / _RATE_HZ)
    step = np.tile(np.eye(2, 3), (len(times), 1, 1))
    step[1:, 0, 2] = -np.diff(_path(times, steady)) / _VIEW_M + rng.normal(0, 2e-4, len(times) - 1)
    return Motion(
        index=np.arange(len(times)),
        time_s=times,
        step=step,
        broken=np.arange(len(times)) == 0,
        cut=np.arange(len(times)) == 0,
        kind=np.zeros(len(times), np.int8),
        sharpness=np.ones(len(times)),
    )


def _telemetry(
    rng: np.random.Generator, late_s: float, rate_hz: float, *, steady: bool = False, digits: int = 7
) -> Telemetry:
    times = np.arange(0.0, _SECONDS, 1 / rate_hz)
    east = _path(times - late_s, steady) + rng.normal(0, 0.02, len(times))
    longitude = np.round(8.0 + east / (111_320.0 * np.cos(np.radians(48.0))), digits)
    return Telemetry(
        times_s=times, latitude_deg=np.full(len(times), 48.0), longitude_deg=longitude, source="test"
    )


@pytest.mark.parametrize("late_s", [-0.8, 0.0, 0.35, 1.5])
@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 30.0])
def test_the_lag_is_found(late_s: float, rate_hz: float) -> None:
    rng = np.random.default_rng(5)
    found = estimate_lag(_motion(rng), _telemetry(rng, late_s, rate_hz))
    assert found.late_s is not None, found.message
    assert found.late_s == pytest.approx(late_s, abs=0.12 if rate_hz < 5 else 0.08)


def test_positions_that_repeat_are_a_slower_receiver() -> None:
    """A subtitle a frame, a fix a second."""
    rng = np.random.default_rng(6)
    slow = _telemetry(rng, 0.4, 1.0)
    times = np.arange(0.0, _SECONDS, 1 / _RATE_HZ)
    rows = np.floor(times).astype(int)
    repeated = Telemetry(
        times_s=times,
        latitude_deg=slow.latitude_deg[rows],
        longitude_deg=slow.longitude_deg[rows],
        source="test",
    )
    found = estimate_lag(_motion(rng), repeated)
    assert found.late_s == pytest.approx(0.4, abs=0.15)


def test_a_steady_flight_does_not_tell() -> None:
    rng = np.random.default_rng(7)
    found = estimate_lag(_motion(rng, steady=True), _telemetry(rng, 0.5, 10.0, steady=True))
    assert found.late_s is None
    assert "do not tell the lag" in found.message


def test_telemetry_of_another_flight_is_not_believed() -> None:
    rng = np.random.default_rng(8)
    other = _telemetry(rng, 0.0, 10.0)
    shuffled = Telemetry(
        times_s=other.times_s,
        latitude_deg=other.latitude_deg,
        longitude_deg=8.0 + np.cumsum(rng.uniform(0, 1e-5, len(other))),
        source="test",
    )
    assert estimate_lag(_motion(rng), shuffled).late_s is None


def test_too_little_is_said_so() -> None:
    rng = np.random.default_rng(9)
    motion, telemetry = _motion(rng), _telemetry(rng, 0.0, 10.0)
    one = Telemetry(
        times_s=telemetry.times_s[:1],
        latitude_deg=telemetry.latitude_deg[:1],
        longitude_deg=telemetry.longitude_deg[:1],
        source="test",
    )
    assert "too few samples" in estimate_lag(motion, one).message
    elsewhen = Telemetry(
        times_s=telemetry.times_s + 500.0,
        latitude_deg=telemetry.latitude_deg,
        longitude_deg=telemetry.longitude_deg,
        source="test",
    )
    assert "no 5 s in common" in estimate_lag(motion, elsewhen).message
