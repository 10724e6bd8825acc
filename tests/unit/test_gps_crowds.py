"""Placement by positions that many people, or several drones, told."""

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation
from ingest.own_frame import held_of
from ingest.register.gps import place_by_gps
from tests.support.gps_flights import TRUE, flight


def _crowd(count: int) -> tuple[FloatArray, list[Rigid3]]:
    """Photographers along a square, who all look at one front, each with a roll of a degree."""
    rng = np.random.default_rng(8)
    local = np.column_stack(
        [rng.uniform(-60, 60, count), rng.normal(0, 12, count), rng.normal(1.6, 0.2, count)]
    )
    held = []
    for _ in range(count):
        cam = cam_from_enu(rng.normal(0.0, 10.0), rng.normal(8.0, 3.0), rng.normal(0.0, 1.0))
        held.append(Rigid3(rotation=nearest_rotation(cam @ TRUE.rotation), translation=np.zeros(3)))
    return local, held


def test_photos_of_many_people_who_look_one_way_tell_the_vertical_and_those_of_one_do_not() -> None:
    local, held = _crowd(40)
    sigmas = np.tile([4.0, 4.0, np.inf], (40, 1))
    tagged = local + np.random.default_rng(9).normal(0, 5.0, local.shape)
    by_many, by_one = (
        place_by_gps(TRUE.inverse().act(local), tagged, sigmas, held=held_of(held, (), camera_of))
        for camera_of in (np.arange(40), np.zeros(40, dtype=np.int64))
    )
    assert (by_many.reason, by_many.provisional) == (None, "")
    assert by_many.figures["turn_sigma_deg"] < 6.0
    assert by_many.local_from_sfm is not None
    off_deg = np.degrees(np.linalg.norm((TRUE @ by_many.local_from_sfm.inverse()).log()[1:4]))
    assert off_deg < 3.0 * by_many.figures["turn_sigma_deg"]
    assert by_one.reason == "DEGENERATE_LINE" or "no camera angles" in by_one.provisional


def test_positions_by_many_receivers_share_no_bias() -> None:
    """Geotags said to be good to 20 m that agree to 2 m: of one receiver all may be off, of forty not."""
    positions = flight(40)
    tagged = positions + np.random.default_rng(6).normal(0, 2.0, positions.shape)
    sigmas = np.full((40, 3), 20.0)
    by_many, by_one = (
        place_by_gps(TRUE.inverse().act(positions), tagged, sigmas, camera_of=camera_of)
        for camera_of in (np.arange(40), None)
    )
    assert by_many.figures["bias_sigma_m"][0] < 4.0
    assert by_one.figures["bias_sigma_m"][0] > 15.0


@pytest.mark.parametrize("drones", [2, 4])
def test_drones_that_share_a_block_are_as_uncertain_as_one(drones: int) -> None:
    """Each has its own bias, and flies a part of the block after the others: four draws of each."""
    placements = 0
    for seed in range(4):
        rng = np.random.default_rng((seed, drones))
        positions = flight(12 * drones, seed)
        positions = positions[np.argsort(positions[:, 0])]
        camera_of = np.repeat(np.arange(drones), 12)
        bias = rng.normal(0.0, 1.0, (drones, 3)) * [2.0, 2.0, 5.0]
        told = positions + bias[camera_of] + rng.normal(0, 0.5, positions.shape)
        sigmas, times = np.tile([4.0, 4.0, 10.0], (len(positions), 1)), 4.0 * np.arange(len(positions))
        placed = place_by_gps(
            TRUE.inverse().act(positions), told, sigmas, times + 600.0 * camera_of, None, camera_of
        )
        if placed.reason is None:
            placements += 1
            assert placed.local_from_sfm is not None
            assert placed.covariance is not None
            error = (TRUE @ placed.local_from_sfm.inverse()).log()[1:4]
            assert float(error @ np.linalg.solve(placed.covariance[1:4, 1:4], error)) < chi2.ppf(0.999, 3)
    assert placements >= 3


def test_people_who_stand_at_two_places_leave_nothing_to_check_by() -> None:
    rng = np.random.default_rng(12)
    at = rng.integers(0, 2, 40)
    local = np.array([[-40.0, 0, 1.6], [40.0, 5, 1.6]])[at] + rng.normal(0, 0.5, (40, 3))
    tagged = np.array([[10.0, 60, 0], [-20.0, -30, 0]])[at] + rng.normal(0, 4.0, (40, 3))
    _, held = _crowd(40)
    sigmas = np.tile([4.0, 4.0, np.inf], (40, 1))
    placed = place_by_gps(
        TRUE.inverse().act(local),
        tagged,
        sigmas,
        None,
        held_of(held, (), np.arange(40)),
        np.arange(40),
    )
    assert placed.reason is not None or placed.provisional
