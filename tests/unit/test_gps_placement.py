"""Placement by GPS: known similarities, honest covariance, and every gate."""

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from ingest.register.gps import (
    GpsOptions,
    GpsPlacement,
    noise_variance_factor,
    place_by_gps,
)

_OPTIONS = GpsOptions()
_TRUE = Sim3(scale=8.5, rotation=so3_exp([0.3, -0.2, 2.0]), translation=np.array([4.0, -7.0, 50.0]))


def _flight(count: int, seed: int = 0) -> FloatArray:
    """Positions in the local frame: a block of some 100 m by 80 m, heights varying by metres."""
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-50, 50, count), rng.uniform(-40, 40, count), rng.normal(50, 3, count)]
    )


def _place(
    positions: FloatArray, noise: FloatArray, sigmas: FloatArray, options: GpsOptions = _OPTIONS
) -> GpsPlacement:
    return place_by_gps(_TRUE.inverse().act(positions), positions + noise, sigmas, options)


def test_exact_positions_give_the_exact_similarity() -> None:
    positions = _flight(12)
    placed = _place(positions, np.zeros((12, 3)), np.full((12, 3), 2.0))
    assert placed.reason is None
    assert placed.local_from_sfm is not None
    error = (placed.local_from_sfm @ _TRUE.inverse()).log()
    assert np.abs(error).max() < 1e-8
    assert placed.residual_rms_m < 1e-8


def test_sigmas_weigh_the_positions() -> None:
    """Heights that are poor by tens of metres must not tilt the map: the answer is weighted least squares."""
    rng = np.random.default_rng(3)
    positions, sigmas = _flight(40), np.tile([0.5, 0.5, 10.0], (40, 1))
    noise = rng.normal(0, 1, (40, 3)) * sigmas
    placed = _place(positions, noise, sigmas)
    assert placed.local_from_sfm is not None
    shift = placed.local_from_sfm.act(_TRUE.inverse().act(positions)) - positions
    assert np.abs(shift[:, :2].mean(axis=0)).max() < 3.5 * 0.5 / np.sqrt(40)
    # The unweighted fit lets the poor heights into the horizontal: it must be the worse one.
    plain = similarity_closed_form(_TRUE.inverse().act(positions), positions + noise)
    assert plain is not None
    plain_shift = plain.act(_TRUE.inverse().act(positions)) - positions
    assert (shift[:, :2] ** 2).sum() < (plain_shift[:, :2] ** 2).sum()


def test_covariance_matches_the_scatter_of_the_errors() -> None:
    """Normalised squared errors of the seven parameters follow chi-square with seven degrees of freedom."""
    rng = np.random.default_rng(5)
    sigmas = np.tile([2.0, 2.0, 4.0], (15, 1))
    few_samples = GpsOptions(
        max_ransac_samples=40
    )  # where nothing lies far off, all photos are the best start
    scores = []
    for trial in range(300):
        positions = _flight(15, seed=trial)
        placed = _place(positions, rng.normal(0, 1, (15, 3)) * sigmas, sigmas, few_samples)
        assert placed.local_from_sfm is not None
        assert placed.covariance is not None
        error = (_TRUE @ placed.local_from_sfm.inverse()).log()
        scores.append(float(error @ np.linalg.solve(placed.covariance, error)))
    # The noise is never taken for smaller than it may be, which makes the scores a little small.
    assert 5.5 < np.mean(scores) < 7.4
    assert 0.62 < np.mean(np.array(scores) < chi2.ppf(0.68, 7)) < 0.82


def test_shared_error_shows_in_the_covariance_not_in_the_residuals() -> None:
    rng = np.random.default_rng(7)
    sigmas = np.tile([3.0, 3.0, 6.0], (20, 1))
    bias = np.array([2.5, -1.5, 5.0])
    placed = _place(_flight(20), bias + rng.normal(0, 0.1, (20, 3)), sigmas)
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    assert placed.residual_rms_m < 0.3
    error = (_TRUE @ placed.local_from_sfm.inverse()).log()
    np.testing.assert_allclose(error[4:], -bias, atol=0.3)
    np.testing.assert_allclose(np.sqrt(np.diag(placed.covariance)[4:]), [3.0, 3.0, 6.0], rtol=0.05)
    # Scale and rotation are as good as the small noise: 0.1 m of noise over 100 m of flight.
    assert np.sqrt(placed.covariance[0, 0]) < 0.002
    assert float(error @ np.linalg.solve(placed.covariance, error)) < chi2.ppf(0.99, 7)


def test_noise_factor_is_measured_when_large_and_careful_when_small() -> None:
    assert noise_variance_factor(4.0 * 35, 35, 0.95) == pytest.approx(4.0)
    assert noise_variance_factor(0.01 * 35, 35, 0.95) == pytest.approx(0.01 * 35 / chi2.ppf(0.05, 35))
    assert noise_variance_factor(1.0, 2, 0.95) == 1.0  # two degrees of freedom prove nothing


def test_outliers_are_found_and_left_out() -> None:
    rng = np.random.default_rng(9)
    positions, sigmas = _flight(20), np.full((20, 3), 1.0)
    noise = rng.normal(0, 0.5, (20, 3))
    noise[[4, 11, 17]] += np.array([[40.0, 0, 0], [0, -60.0, 10], [0, 0, 30.0]])
    placed = _place(positions, noise, sigmas)
    assert placed.reason is None
    assert np.flatnonzero(~placed.inliers).tolist() == [4, 11, 17]
    assert placed.local_from_sfm is not None
    shift = placed.local_from_sfm.act(_TRUE.inverse().act(positions)) - positions
    assert np.abs(shift).max() < 1.0


def test_two_photos_are_too_few() -> None:
    placed = _place(_flight(2), np.zeros((2, 3)), np.ones((2, 3)))
    assert placed.reason == "TOO_FEW"
    assert placed.local_from_sfm is None
    assert "2 registered photos" in placed.message


@pytest.mark.parametrize("across_m", [0.0, 0.3])
def test_a_line_of_photos_is_refused(across_m: float) -> None:
    rng = np.random.default_rng(1)
    positions = np.outer(np.linspace(-60, 60, 12), [0.8, 0.6, 0.0]) + rng.normal(0, 1, (12, 3)) * across_m
    placed = _place(positions, rng.normal(0, 0.5, (12, 3)), np.full((12, 3), 1.0))
    assert placed.reason == "DEGENERATE_LINE"
    assert placed.covariance is None
    assert "line" in placed.message


def test_a_wide_strip_is_no_line() -> None:
    rng = np.random.default_rng(1)
    positions = np.outer(np.linspace(-60, 60, 12), [0.8, 0.6, 0.0]) + rng.normal(0, 6, (12, 3))
    assert _place(positions, rng.normal(0, 0.5, (12, 3)), np.full((12, 3), 1.0)).reason is None


def test_positions_at_one_place_are_refused() -> None:
    placed = place_by_gps(_flight(6), np.zeros((6, 3)), np.ones((6, 3)), _OPTIONS)
    assert placed.reason == "DEGENERATE_LINE"


def test_positions_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(2)
    positions = _flight(15)
    placed = _place(positions, rng.normal(0, 1, (15, 3)) * 20.0, np.full((15, 3), 0.5))
    assert placed.reason == "RESIDUALS"
    assert placed.covariance is None


def test_an_unknown_scale_is_refused() -> None:
    """Three photos with metres between them and metres of error."""
    positions = np.array([[0.0, 0, 0], [12, 0, 0], [0, 11, 0]])
    noise = np.random.default_rng(4).normal(0, 1, (3, 3))
    placed = _place(positions, noise, np.full((3, 3), 2.0))
    assert placed.reason == "SCALE"
    assert placed.figures["scale_sigma"] > _OPTIONS.max_scale_sigma


def test_the_same_input_gives_the_same_answer() -> None:
    positions = _flight(60)
    noise = np.random.default_rng(8).normal(0, 1, (60, 3))
    a, b = (_place(positions, noise, np.ones((60, 3))) for _ in range(2))
    assert a.local_from_sfm is not None
    assert b.local_from_sfm is not None
    np.testing.assert_array_equal(a.local_from_sfm.matrix(), b.local_from_sfm.matrix())


def test_a_steady_height_hides_no_bias_behind_an_unsteady_position() -> None:
    """Heights off by 5 m and steady to 0.1 m beside positions with all their error in the noise."""
    rng = np.random.default_rng(3)
    sigmas = np.tile([1.5, 1.5, 5.0], (40, 1))
    noise = rng.normal(0, 1, (40, 3)) * [1.5, 1.5, 0.1] + [0.0, 0.0, 5.0]
    placed = _place(_flight(40), noise, sigmas)
    assert placed.covariance is not None
    assert np.sqrt(placed.covariance[6, 6]) == pytest.approx(5.0, rel=0.03)
