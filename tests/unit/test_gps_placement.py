"""Placement by GPS: known similarities, honest covariance, and every gate."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import CameraAngles, cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation, so3_exp
from featuredb.geometry.sim3 import similarity_closed_form
from ingest.own_frame import held_of
from ingest.positions.held import Held
from ingest.register.gps import GpsPlacement, place_by_gps
from ingest.report.page import FIGURES, figure_rows
from tests.support.gps_flights import TRUE, flight, place


def test_exact_positions_give_the_exact_similarity() -> None:
    positions = flight(12)
    placed = place(positions, np.zeros((12, 3)), np.full((12, 3), 2.0))
    assert placed.reason is None
    assert placed.local_from_sfm is not None
    error = (placed.local_from_sfm @ TRUE.inverse()).log()
    assert np.abs(error).max() < 1e-8
    assert placed.residual_rms_m < 1e-8


def test_sigmas_weigh_the_positions() -> None:
    """Heights that are poor by tens of metres must not tilt the map: the answer is weighted least squares."""
    rng = np.random.default_rng(3)
    positions, sigmas = flight(40), np.tile([0.5, 0.5, 10.0], (40, 1))
    noise = rng.normal(0, 1, (40, 3)) * sigmas
    placed = place(positions, noise, sigmas)
    assert placed.local_from_sfm is not None
    shift = placed.local_from_sfm.act(TRUE.inverse().act(positions)) - positions
    assert np.abs(shift[:, :2].mean(axis=0)).max() < 3.5 * 0.5 / np.sqrt(40)
    # The unweighted fit lets the poor heights into the horizontal: it must be the worse one.
    plain = similarity_closed_form(TRUE.inverse().act(positions), positions + noise)
    assert plain is not None
    plain_shift = plain.act(TRUE.inverse().act(positions)) - positions
    assert (shift[:, :2] ** 2).sum() < (plain_shift[:, :2] ** 2).sum()


def test_heights_of_two_data_are_stated_as_wide_as_they_are_apart() -> None:
    """Every second one counts from the ground: that is no noise which averages out, so 18 are no better."""
    noise = np.random.default_rng(5).normal(0, [0.5, 0.5, 1.0], (18, 3))
    noise[1::2, 2] -= 150.0
    placed = place(flight(18), noise, np.tile([4.0, 4.0, 10.0], (18, 1)))
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    sigma = np.sqrt(np.diag(placed.covariance)[4:])
    off = (placed.local_from_sfm @ TRUE.inverse()).act(np.zeros((1, 3)))[0]
    assert 50.0 < abs(off[2]) < 1.96 * sigma[2]
    assert sigma[:2].max() < 5.0


def _scores(noise: Callable[[np.random.Generator], FloatArray], draws: int, count: int) -> FloatArray:
    """Squared errors of the seven parameters over their covariance, of plain receivers."""
    scores = []
    for draw in range(draws):
        rng = np.random.default_rng((draw, count))
        placed = place(flight(count, seed=draw), noise(rng), np.tile([4.0, 4.0, 10.0], (count, 1)))
        assert placed.local_from_sfm is not None
        assert placed.covariance is not None
        error = (TRUE @ placed.local_from_sfm.inverse()).log()
        scores.append(float(error @ np.linalg.solve(placed.covariance, error)))
    return np.array(scores)


@pytest.mark.parametrize(
    "noise",
    [
        lambda rng: rng.normal(0, 1, (25, 3)) * [0.5, 0.5, 1.0] + rng.normal(0, 1, 3) * [4.0, 4.0, 10.0],
        lambda rng: rng.normal(0, 15, (25, 3)),
        lambda rng: (
            rng.normal(0, 2, (25, 3)) + np.outer(np.linspace(0, 1, 25), rng.normal(0, 1, 3) * [20, 20, 60])
        ),
        lambda rng: rng.normal(0, 4, (25, 3)) + (rng.random((25, 1)) < 0.2) * rng.normal(0, 100, (25, 3)),
    ],
    ids=["steady", "white", "drift", "outliers"],
)
def test_covariance_matches_the_scatter_of_the_errors(
    noise: Callable[[np.random.Generator], FloatArray],
) -> None:
    """Whatever the noise is like, told but a plain receiver's sigma, the 95 % bound holds about as often."""
    scores = _scores(noise, 15, 25)
    assert (scores < chi2.ppf(0.95, 7)).sum() >= 12
    assert (scores < chi2.ppf(0.9999, 7)).all()
    assert np.median(scores) > 1.0  # and it is no wider than it must be


def test_shared_error_shows_in_the_covariance_not_in_the_residuals() -> None:
    rng = np.random.default_rng(7)
    sigmas = np.tile([3.0, 3.0, 6.0], (20, 1))
    bias = np.array([2.5, -1.5, 5.0])
    placed = place(flight(20), bias + rng.normal(0, 0.1, (20, 3)), sigmas)
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    assert placed.residual_rms_m < 0.3
    error = (TRUE @ placed.local_from_sfm.inverse()).log()
    np.testing.assert_allclose(error[4:], -bias, atol=0.3)
    np.testing.assert_allclose(np.sqrt(np.diag(placed.covariance)[4:]), [3.0, 3.0, 6.0], rtol=0.05)
    # Scale and rotation are as good as the small noise: 0.1 m of noise over 100 m of flight.
    assert np.sqrt(placed.covariance[0, 0]) < 0.002
    assert float(error @ np.linalg.solve(placed.covariance, error)) < chi2.ppf(0.99, 7)


def test_outliers_are_found_and_left_out() -> None:
    rng = np.random.default_rng(9)
    positions, sigmas = flight(20), np.full((20, 3), 1.0)
    noise = rng.normal(0, 0.5, (20, 3))
    noise[[4, 11, 17]] += np.array([[40.0, 0, 0], [0, -60.0, 10], [0, 0, 30.0]])
    placed = place(positions, noise, sigmas)
    assert placed.reason is None
    assert np.flatnonzero(~placed.inliers).tolist() == [4, 11, 17]
    assert placed.local_from_sfm is not None
    shift = placed.local_from_sfm.act(TRUE.inverse().act(positions)) - positions
    assert np.abs(shift).max() < 1.0


def test_two_photos_are_too_few() -> None:
    placed = place(flight(2), np.zeros((2, 3)), np.ones((2, 3)))
    assert placed.reason == "TOO_FEW"
    assert placed.local_from_sfm is None
    assert "2 registered photos" in placed.message


@pytest.mark.parametrize(("across_m", "reason"), [(0.0, "DEGENERATE_LINE"), (0.3, None)])
def test_a_line_of_photos_does_not_answer(across_m: float, reason: str | None) -> None:
    """Little or nothing tells the turn about the line."""
    rng = np.random.default_rng(1)
    positions = np.outer(np.linspace(-60, 60, 12), [0.8, 0.6, 0.0]) + rng.normal(0, 1, (12, 3)) * across_m
    placed = place(positions, rng.normal(0, 0.5, (12, 3)), np.full((12, 3), 1.0))
    assert placed.reason == reason
    assert "along a line" in (placed.provisional if reason is None else placed.message)
    assert placed.covariance is not None
    along, across = np.array([0.8, 0.6, 0.0]), np.array([0.0, 0.0, 1.0])
    assert np.sqrt(along @ placed.covariance[1:4, 1:4] @ along) > 0.17
    assert np.sqrt(across @ placed.covariance[1:4, 1:4] @ across) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_a_line_of_photos_that_are_held_level_has_a_place(seed: int) -> None:
    """Their horizontal image axes tell the turn about the line, and which side is up."""
    rng = np.random.default_rng(seed)
    along = np.array([0.8, 0.6, 0.0])
    positions = np.outer(np.linspace(-60, 60, 12), along) + rng.normal(0, 0.3, (12, 3))
    held = []
    for _ in range(12):  # looking ahead and down, rolled by two degrees
        view = so3_exp(rng.normal(0, 0.03, 3)) @ np.array([0.5 * along[0], 0.5 * along[1], -0.87])
        across = np.array([along[1], -along[0], 0.0])
        across = across - (across @ view) * view
        across /= np.linalg.norm(across)
        roll = so3_exp([0.0, 0.0, rng.normal(0, np.radians(2.0))])
        local = roll @ np.stack([across, np.cross(view, across), view])
        held.append(Rigid3(rotation=nearest_rotation(local @ TRUE.rotation), translation=np.zeros(3)))
    noise, sigmas = rng.normal(0, 0.5, (12, 3)), np.tile([4.0, 4.0, 10.0], (12, 1))
    placed = place_by_gps(TRUE.inverse().act(positions), positions + noise, sigmas, held=held_of(held))
    assert placed.reason is None
    assert "no camera angles" in placed.provisional  # nothing has measured that they are level
    assert placed.local_from_sfm is not None
    assert placed.covariance is not None
    error = (TRUE @ placed.local_from_sfm.inverse()).log()
    assert np.degrees(np.abs(error[1:4]).max()) < 5.0
    assert float(error @ np.linalg.solve(placed.covariance, error)) < chi2.ppf(0.999, 7)


def test_pictures_that_are_stored_upside_down_do_not_turn_a_flight_over() -> None:
    rng = np.random.default_rng(3)
    positions = flight(20)
    held = []
    for heading in rng.uniform(0, 2 * np.pi, 20):
        across = np.array([np.sin(heading), -np.cos(heading), 0.0])
        view = np.array([0.5 * np.cos(heading), 0.5 * np.sin(heading), -np.sqrt(0.75)])
        local = np.stack([across, np.cross(view, across), view])
        held.append(Rigid3(rotation=nearest_rotation(local @ TRUE.rotation), translation=np.zeros(3)))
    level = held_of(held)
    assert level is not None
    level = replace(level, down=-level.down)
    noise, sigmas = rng.normal(0, 1.0, (20, 3)), np.tile([4.0, 4.0, 10.0], (20, 1))
    placed = place_by_gps(TRUE.inverse().act(positions), positions + noise, sigmas, held=level)
    assert placed.reason is None
    assert placed.local_from_sfm is not None
    assert np.degrees(np.abs((TRUE @ placed.local_from_sfm.inverse()).log()[1:4]).max()) < 5.0


def _told(
    local: FloatArray,
    yaw_deg: float = 30.0,
    pitch_deg: float = -60.0,
    off_deg: float = 0.0,
    flips: float = 0.0,
) -> tuple[list[Rigid3], list[CameraAngles | None]]:
    """Cameras at positions (n, 3) that look one way, and angles off by a degree or two and `off_deg`.

    Args:
        flips: share of photos whose yaw is off by 180 degrees.
    """
    rng = np.random.default_rng(5)
    held: list[Rigid3] = []
    told: list[CameraAngles | None] = []
    for k in range(len(local)):
        cam = so3_exp(rng.normal(0, np.radians(1.3), 3)) @ cam_from_enu(yaw_deg, pitch_deg, 0.0)
        held.append(Rigid3(rotation=nearest_rotation(cam @ TRUE.rotation), translation=np.zeros(3)))
        told.append(
            CameraAngles(
                yaw_deg=yaw_deg + (180.0 if k < flips * len(local) else 0.0),
                pitch_deg=pitch_deg + off_deg,
                sigma_yaw_deg=4.0,
                sigma_tilt_deg=2.0,
            )
        )
    return held, told


def _strip(count: int = 12) -> FloatArray:
    rng = np.random.default_rng(2)
    return np.asarray(np.outer(np.linspace(-60, 60, count), [0.8, 0.6, 0.0]) + rng.normal(0, 0.2, (count, 3)))


def _placed_by(positions: FloatArray, held: Held | None) -> GpsPlacement:
    noise = np.random.default_rng(3).normal(0, 0.5, positions.shape)
    sigmas = np.tile([4.0, 4.0, 10.0], (len(positions), 1))
    return place_by_gps(TRUE.inverse().act(positions), positions + noise, sigmas, held=held)


def _turn_deg(placed: GpsPlacement) -> float:
    assert placed.local_from_sfm is not None
    return float(np.degrees(np.linalg.norm((TRUE @ placed.local_from_sfm.inverse()).log()[1:4])))


@pytest.mark.parametrize("yaw_deg", [30.0, 143.0, 250.0])
def test_a_strip_with_the_cameras_angles_answers(yaw_deg: float) -> None:
    """Whichever way the cameras look, along the line or across, and whichever side up the start is."""
    held, told = _told(_strip(), yaw_deg=yaw_deg)
    placed = _placed_by(_strip(), held_of(held, told))
    assert (placed.reason, placed.provisional, placed.message) == (None, "", "placed by GPS")
    assert placed.figures["turn_sigma_deg"] < 3.0
    assert _turn_deg(placed) < 3.0
    figures = placed.figures.keys() | placed.figures["angles"].keys()
    assert figures - FIGURES.keys() == {"angles"}  # the report explains each


def test_a_strip_whose_photos_look_across_waits_without_angles() -> None:
    """That photos are level tells nothing of the turn about a line along their horizontal axes."""
    held, _ = _told(_strip(), yaw_deg=np.degrees(np.arctan2(-0.6, 0.8)), pitch_deg=-80.0)
    placed = _placed_by(_strip(), held_of(held))
    assert placed.reason == "DEGENERATE_LINE" or "no camera angles" in placed.provisional
    assert placed.figures["turn_sigma_deg"] > 10.0


@pytest.mark.parametrize("positions", [_strip(), flight(20)], ids=["strip", "block"])
def test_yaws_off_by_180_degrees_in_all_photos_are_said_and_drag_nothing(positions: FloatArray) -> None:
    held, told = _told(positions, flips=1.0)
    placed = _placed_by(positions, held_of(held, told))
    assert placed.reason is None
    assert placed.figures["angles"]["yaw_contradicts"]
    assert "angles contradict" in placed.message
    assert "yaw by 1" in placed.message
    assert _turn_deg(placed) < 3.0


def test_tilts_off_by_180_degrees_turn_no_flight_over() -> None:
    positions = flight(20)
    held, told = _told(positions, off_deg=180.0)
    placed = _placed_by(positions, held_of(held, told))
    assert placed.reason is None
    assert "upside down" in placed.provisional
    assert _turn_deg(placed) < 3.0


@pytest.mark.parametrize("pitch_deg", [-80.0, -20.0])
def test_latitudes_and_longitudes_that_are_exchanged_let_no_map_answer(pitch_deg: float) -> None:
    positions = flight(20)
    held, _ = _told(positions, pitch_deg=pitch_deg)
    sigmas = np.tile([4.0, 4.0, 10.0], (20, 1))
    for order, waits in (([0, 1, 2], False), ([1, 0, 2], True)):
        placed = place_by_gps(TRUE.inverse().act(positions), positions[:, order], sigmas, held=held_of(held))
        assert placed.reason is None
        assert ("exchanged" in placed.provisional) == waits


def test_a_third_of_yaws_off_by_180_degrees_drags_nothing() -> None:
    positions = flight(20)
    held, told = _told(positions, flips=0.34)
    placed = _placed_by(positions, held_of(held, told))
    assert placed.message == "placed by GPS"
    assert _turn_deg(placed) < 3.0


def test_a_compass_tells_the_heading_of_a_small_flight() -> None:
    """Photos within four metres, positions noisy by half a metre; they look at the horizon."""
    positions = flight(12) * 0.04
    held, told = _told(positions, pitch_deg=-5.0)
    compass = [
        CameraAngles(yaw_deg=one.yaw_deg, pitch_deg=None, sigma_yaw_deg=5.0, sigma_tilt_deg=180.0)
        for one in told
        if one is not None
    ]
    with_compass, without = (_placed_by(positions, held_of(held, angles)) for angles in (compass, ()))
    assert with_compass.covariance is not None
    assert without.covariance is not None
    up_with, up_without = (np.degrees(np.sqrt(p.covariance[3, 3])) for p in (with_compass, without))  # type: ignore[index]
    assert up_with < 5.0 < up_without


def test_positions_that_are_late_say_by_how_much() -> None:
    """Strips to and fro at 5 m/s, positions of two seconds before."""
    rng = np.random.default_rng(11)
    x = np.linspace(-60, 60, 7)
    plan = [(v, 30.0 * k) for k in range(4) for v in (x if k % 2 == 0 else x[::-1])]
    positions = np.column_stack([plan, rng.normal(50, 1, len(plan))])
    times = 4.0 * np.arange(len(plan))
    speed = np.gradient(positions, times, axis=0)
    late = positions - 2.0 * speed + rng.normal(0, 0.3, positions.shape)
    sigmas = np.tile([4.0, 4.0, 10.0], (len(plan), 1))
    placed = place_by_gps(TRUE.inverse().act(positions), late, sigmas, times)
    assert placed.reason is None
    assert placed.figures["lag_s"] == pytest.approx(2.0, abs=0.3)


def test_a_wide_strip_is_no_line() -> None:
    rng = np.random.default_rng(1)
    positions = np.outer(np.linspace(-60, 60, 12), [0.8, 0.6, 0.0]) + rng.normal(0, 6, (12, 3))
    placed = place(positions, rng.normal(0, 0.5, (12, 3)), np.full((12, 3), 1.0))
    assert placed.reason is None
    assert placed.provisional == ""


def test_figures_of_heights_that_nobody_told_are_not_known() -> None:
    positions, sigmas = flight(30), np.tile([4.0, 4.0, np.inf], (30, 1))
    noise = np.random.default_rng(1).normal(0, 1, (30, 3))
    figures = place(positions, noise, sigmas).figures
    assert [value is None for value in figures["noise_m"]] == [False, True]
    assert [value is None for value in figures["bias_sigma_m"]] == [False, False, True]
    (row,) = [value for name, value, _ in figure_rows(figures) if name == "noise_m"]
    assert row.endswith(", not known")


def test_positions_close_together_place_a_map_whose_scale_is_wide() -> None:
    positions = flight(30) * 0.1
    placed = place(positions, np.random.default_rng(4).normal(0, 4.0, positions.shape), np.full((30, 3), 4.0))
    assert placed.reason is None
    assert placed.covariance is not None
    assert placed.local_from_sfm is not None
    assert 0.1 < placed.figures["scale_sigma"] < 0.3
    error = (TRUE @ placed.local_from_sfm.inverse()).log()
    assert float(error @ np.linalg.solve(placed.covariance, error)) < chi2.ppf(0.999, 7)


def test_positions_along_another_way_are_no_place() -> None:
    """Two ways without corners resemble each other far more often than as many single positions."""
    x = np.linspace(-60, 60, 9)
    strips = np.array([(v, 30.0 * k, 60.0) for k in range(2) for v in (x if k == 0 else x[::-1])])
    turn = np.linspace(0.0, 2.0 * np.pi, 24)[:18]
    orbit = np.column_stack([40 * np.cos(turn), 30 * np.sin(turn), 25 + 5 * np.sin(3 * turn)])
    sigmas = np.tile([4.0, 4.0, 10.0], (18, 1))
    placed = place_by_gps(TRUE.inverse().act(strips), orbit, sigmas, 4.0 * np.arange(18.0))
    assert placed.reason == "RESIDUALS"
