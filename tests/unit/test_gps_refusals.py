"""Positions that place no map, or hardly: by chance, at one place, without heights."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from ingest.placed_models import placement_evidence
from ingest.register.gps import place_by_gps
from tests.support.gps_flights import TRUE, flight, place


def test_positions_at_one_place_are_refused() -> None:
    placed = place_by_gps(flight(6), np.zeros((6, 3)), np.ones((6, 3)))
    assert placed.reason == "DEGENERATE_LINE"


@pytest.mark.parametrize("seed", range(4))
def test_positions_of_other_photos_are_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = flight(25)
    placed = place_by_gps(
        TRUE.inverse().act(positions),
        positions[rng.permutation(25)],
        np.tile([4.0, 4.0, 10.0], (25, 1)),
    )
    assert placed.reason == "RESIDUALS"
    assert "other photos" in placed.message


def test_positions_drawn_by_chance_let_no_map_answer() -> None:
    for seed in range(20):
        rng = np.random.default_rng((seed, 5))
        count = int(rng.integers(3, 9))
        drawn = np.column_stack([rng.uniform(-500, 500, (count, 2)), rng.uniform(0, 100, count)])
        placed = place_by_gps(
            TRUE.inverse().act(flight(count, seed)), drawn, np.tile([4.0, 4.0, 10.0], (count, 1))
        )
        assert placed.reason is not None or placed.provisional


def test_three_positions_are_too_few_to_answer_by() -> None:
    """They always agree with some similarity; nothing is left to check it by."""
    positions = np.array([[0.0, 0, 0], [60, 0, 0], [0, 55, 0]])
    noise = np.random.default_rng(4).normal(0, 1, (3, 3))
    placed = place(positions, noise, np.full((3, 3), 2.0))
    assert placed.reason is None
    assert "too few" in placed.provisional


def test_a_flight_that_is_as_small_as_its_noise_waits_and_a_smaller_one_is_refused() -> None:
    noise, sigmas = np.random.default_rng(4).normal(0, 1, (12, 3)) * 3.0, np.full((12, 3), 3.0)
    assert place(flight(12) * 0.1, noise, sigmas).provisional
    assert place(flight(12) * 0.03, noise, sigmas).reason is not None


def test_positions_without_heights_place_a_map() -> None:
    rng = np.random.default_rng(6)
    positions = flight(20) + np.column_stack([np.zeros((20, 2)), np.linspace(-20, 20, 20)])
    noisy = positions + rng.normal(0, 1, (20, 3))
    noisy[:, 2] = 0.0
    sigmas = np.tile([2.0, 2.0, np.inf], (20, 1))
    placed = place_by_gps(TRUE.inverse().act(positions), noisy, sigmas)
    assert placed.reason is None
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    error = (TRUE @ placed.local_from_sfm.inverse()).log()
    assert abs(error[0]) < 0.1
    assert np.sqrt(placed.covariance[6, 6]) > 1000.0  # nobody knows the height
    evidence = placement_evidence(placed, [SimpleNamespace(name=f"{k}.jpg") for k in range(20)])
    json.dumps(evidence, allow_nan=False)  # a map keeps it
    assert evidence["residuals_enu_m"]["0.jpg"][2] is None


def test_one_height_for_all_photos_does_not_level_their_way() -> None:
    """A street that rises by nine metres, every photo told the same height."""
    turn = np.linspace(0.0, 6.0, 30)
    positions = np.column_stack([50.0 * turn, 40.0 * np.sin(turn), 1.5 * turn])
    noise = np.random.default_rng(1).normal(0.0, 1.0, (30, 3)) * [2.0, 2.0, 0.0]
    noise[:, 2] = 4.0 - positions[:, 2]
    placed = place(positions, noise, np.tile([4.0, 4.0, 10.0], (30, 1)))
    assert placed.reason is None
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    off = (TRUE @ placed.local_from_sfm.inverse()).log()
    assert off @ np.linalg.solve(placed.covariance, off) < chi2.ppf(0.99, 7)


@pytest.mark.parametrize("count", [399, 401, 900])
def test_one_height_for_many_photos_is_that_of_the_map(count: int) -> None:
    """However many are thinned out."""
    rng = np.random.default_rng(2)
    positions = np.column_stack([rng.uniform(-150, 150, (count, 2)), np.full(count, 60.0)])
    measured = positions + rng.normal(0.0, 1.0, positions.shape) * [2.0, 2.0, 0.0]
    measured[0, :2] += 2500.0  # one is tagged elsewhere
    placed = place(positions, measured - positions, np.tile([4.0, 4.0, 10.0], (count, 1)))
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    assert np.abs(placed.local_from_sfm.act(TRUE.inverse().act(positions))[:, 2] - 60.0).max() < 15.0
    assert 5.0 < np.sqrt(placed.covariance[6, 6]) < 20.0


def test_measured_heights_of_a_level_flight_all_count() -> None:
    """Survey-grade heights 2 cm apart over a kilometre are no one height."""
    rng = np.random.default_rng(3)
    positions = np.column_stack([rng.uniform(-500, 500, (60, 2)), np.full(60, 80.0)])
    placed = place(positions, rng.normal(0.0, 0.02, positions.shape), np.full((60, 3), 0.03))
    assert placed.covariance is not None
    assert np.degrees(np.sqrt(placed.covariance[1, 1])) < 0.01


def test_a_refusal_without_heights_names_none() -> None:
    rng = np.random.default_rng(1)
    positions = flight(25)
    sigmas = np.tile([4.0, 4.0, np.inf], (25, 1))
    centers = TRUE.inverse().act(positions)
    placed = place_by_gps(centers, positions[rng.permutation(25)] * [9.0, 9.0, 0.0], sigmas)
    assert placed.reason == "RESIDUALS"
    assert "in height" not in placed.message
    assert placed.figures["rms_vertical_m"] is None


def test_many_positions_are_thinned_and_all_are_judged() -> None:
    rng = np.random.default_rng(10)
    positions = flight(900)
    noise = rng.normal(0, 1, (900, 3))
    noise[[3, 700, 701]] += 200.0
    placed = place(positions, noise, np.full((900, 3), 2.0))
    assert placed.reason is None
    assert not placed.inliers[[3, 700, 701]].any()
    assert placed.inliers.sum() >= 890


def test_the_same_input_gives_the_same_answer() -> None:
    positions = flight(60)
    noise = np.random.default_rng(8).normal(0, 1, (60, 3))
    a, b = (place(positions, noise, np.ones((60, 3))) for _ in range(2))
    assert a.local_from_sfm is not None
    assert b.local_from_sfm is not None
    np.testing.assert_array_equal(a.local_from_sfm.matrix(), b.local_from_sfm.matrix())


def test_a_steady_height_hides_no_bias_behind_an_unsteady_position() -> None:
    """Heights off by 5 m and steady to 0.1 m beside positions with all their error in the noise."""
    rng = np.random.default_rng(3)
    sigmas = np.tile([1.5, 1.5, 5.0], (40, 1))
    noise = rng.normal(0, 1, (40, 3)) * [1.5, 1.5, 0.1] + [0.0, 0.0, 5.0]
    placed = place(flight(40), noise, sigmas)
    assert placed.covariance is not None
    assert np.sqrt(placed.covariance[6, 6]) == pytest.approx(5.0, rel=0.03)
