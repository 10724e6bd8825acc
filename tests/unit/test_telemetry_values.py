"""The value itself: what it refuses, and what it says between its samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry

NAN = float("nan")
LAWS = settings(deadline=None, max_examples=60, derandomize=True)


def telemetry(times: list[float], **columns: object) -> Telemetry:
    """Telemetry on a straight line east unless columns say otherwise."""
    n = len(times)
    given: dict[str, object] = {
        "latitude_deg": np.full(n, 47.0),
        "longitude_deg": 8.0 + 0.001 * np.arange(n),
        "source": "test",
        **columns,
    }
    return Telemetry(times_s=np.array(times), **given)  # type: ignore[arg-type]


def test_columns_left_out_are_not_known_and_arrays_are_read_only() -> None:
    value = telemetry([0.0, 1.0, 2.0])
    assert value.height_m.shape == value.clock_s.shape == (3,)
    assert value.gimbal_ypr_deg.shape == (3, 3)
    assert np.isnan(value.gimbal_ypr_deg).all()
    assert value.clock == "none"
    assert value.height_datum == "unknown"
    with pytest.raises(ValueError, match="read-only"):
        value.latitude_deg[0] = 1.0


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"latitude_deg": np.array([91.0, 0.0])}, "check their order"),
        ({"longitude_deg": np.array([181.0, 0.0])}, "check their order"),
        ({"latitude_deg": np.array([NAN, 47.0])}, "together"),
        ({"latitude_deg": np.array([47.0])}, "shape"),
        ({"height_m": np.array([np.inf, 1.0])}, "infinity"),
        ({"height_m": np.array(["a", "b"])}, "numbers"),
        ({"gimbal_ypr_deg": np.zeros((2, 2))}, "shape"),
        ({"height_datum": "sea"}, "height datum"),
        ({"clock": "utc"}, "readings"),
        ({"clock_s": np.array([1e9, 1e9])}, "readings"),
        ({"clock": "swiss", "clock_s": np.array([1e9, 1e9])}, "expected one of"),
        ({"times_s": np.array([0.0, 0.0])}, "strictly increasing"),
        ({"times_s": np.array([0.0, NAN])}, "finite"),
    ],
)
def test_what_cannot_be_is_refused(columns: dict[str, object], said: str) -> None:
    given: dict[str, object] = {
        "times_s": np.array([0.0, 1.0]),
        "latitude_deg": np.array([47.0, 47.0]),
        "longitude_deg": np.array([8.0, 8.0]),
        "source": "test",
        **columns,
    }
    with pytest.raises(InvalidValueError, match=said):
        Telemetry(**given)  # type: ignore[arg-type]


def test_no_samples_are_no_telemetry() -> None:
    with pytest.raises(InvalidValueError, match="at least one sample"):
        telemetry([])


def test_between_samples_a_straight_line() -> None:
    value = telemetry([10.0, 11.0, 13.0], height_m=np.array([100.0, 110.0, 130.0]))
    there = value.at([10.25, 13.0, 10.0, 12.0])
    np.testing.assert_allclose(there.longitude_deg, [8.00025, 8.002, 8.0, 8.0015], rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.height_m, [102.5, 130.0, 100.0, 120.0], rtol=0, atol=1e-9)
    assert there.times_s.tolist() == [10.25, 13.0, 10.0, 12.0]


def test_beyond_the_ends_a_value_holds_for_half_a_sample() -> None:
    value = telemetry([0.0, 2.0, 4.0])
    there = value.at([-1.0, -1.01, 5.0, 5.01])
    assert there.longitude_deg[[0, 2]].tolist() == [8.0, 8.002]
    assert np.isnan(there.longitude_deg[[1, 3]]).all()
    # A single sample has no usual distance, so that it holds for its own time only.
    alone = telemetry([3.0]).at([3.0, 3.001])
    assert alone.has_position.tolist() == [True, False]


def test_gaps_longer_than_the_limit_stay_empty() -> None:
    value = telemetry([0.0, 1.0, 2.0, 8.0, 9.0])
    there = value.at([2.4, 2.6, 5.0, 7.4, 7.5, 8.5])
    assert there.has_position.tolist() == [True, False, False, False, True, True]
    assert there.longitude_deg[0] == 8.002
    assert telemetry([0.0, 1.0, 2.0, 5.0]).at(3.5).longitude_deg[0] == pytest.approx(8.0025)
    with pytest.raises(InvalidValueError, match="finite"):
        value.at([NAN])


def test_a_sample_without_a_fix_is_bridged_and_its_other_values_kept() -> None:
    value = telemetry(
        [0.0, 1.0, 2.0],
        latitude_deg=np.array([47.0, NAN, 47.002]),
        longitude_deg=np.array([8.0, NAN, 8.0]),
        relative_height_m=np.array([10.0, 99.0, 10.0]),
    )
    there = value.at(1.0)
    assert there.latitude_deg[0] == pytest.approx(47.001, abs=1e-12)
    assert there.relative_height_m[0] == 99.0
    far = telemetry(
        [0.0, 2.0, 4.0], latitude_deg=np.array([47.0, NAN, 47.002]), longitude_deg=value.longitude_deg
    )
    assert np.isnan(far.at(2.0).latitude_deg[0])


def test_longitude_goes_over_the_date_line() -> None:
    value = telemetry([0.0, 1.0], longitude_deg=np.array([179.9, -179.9]))
    there = value.at([0.25, 0.75])
    np.testing.assert_allclose(there.longitude_deg, [179.95, -179.95], rtol=0, atol=1e-9)


@LAWS
@given(
    steps=st.lists(st.floats(-179.0, 179.0), min_size=1, max_size=12),
    start=st.floats(-180.0, 180.0),
    fractions=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8),
)
def test_angles_go_the_shorter_way(steps: list[float], start: float, fractions: list[float]) -> None:
    """Against the unwrapped course, which numpy interpolates as a line."""
    course = start + np.concatenate([[0.0], np.cumsum(steps)])
    times = np.arange(len(course), dtype=float)
    wrapped = (course + 180.0) % 360.0 - 180.0
    value = telemetry(
        times.tolist(), gimbal_ypr_deg=np.stack([wrapped, -wrapped / 2, np.zeros_like(wrapped)], axis=1)
    )
    wanted = np.array(fractions) * times[-1]
    found = value.at(wanted).gimbal_ypr_deg[:, 0]
    expected = np.radians(np.interp(wanted, times, course))
    off = np.degrees(np.angle(np.exp(1j * (np.radians(found) - expected))))
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert ((found >= -180.0) & (found < 180.0)).all()


@LAWS
@given(
    gaps=st.lists(st.floats(0.01, 2.9), min_size=1, max_size=15),
    seed=st.integers(0, 2**31),
)
def test_inside_it_is_linear_interpolation(gaps: list[float], seed: int) -> None:
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    rng = np.random.default_rng(seed)
    heights: FloatArray = rng.uniform(-100.0, 4000.0, len(times))
    wanted = rng.uniform(0.0, times[-1], 20)
    found = telemetry(times.tolist(), height_m=heights).at(wanted).height_m
    np.testing.assert_allclose(found, np.interp(wanted, times, heights), rtol=0, atol=1e-6)
