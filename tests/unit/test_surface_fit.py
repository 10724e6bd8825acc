"""GICP against a scan of rolling ground, and the guard that keeps it to the evidence."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from ingest.register.structure.surface_fit import (
    Surface,
    SurfaceFitOptions,
    guarded_gicp,
    plane_distances,
    reach_of,
    surface_near,
)
from tests.support.scanned_map import ground_points, height, plain_cloud, scan

pytest.importorskip("small_gicp")

_OPTIONS = SurfaceFitOptions()
_LOOSE = np.diag([1e-6] + [1e-6] * 3 + [0.1**2] * 3)
_TIGHT = np.diag([1e-12] * 4 + [1e-4**2] * 3)


@pytest.fixture(scope="module")
def surface() -> Surface:
    found = surface_near(
        scan(np.random.default_rng(0)), ground_points(np.random.default_rng(1), 500), _OPTIONS
    )
    assert found is not None
    return found


def _ground(shift: FloatArray) -> FloatArray:
    return ground_points(np.random.default_rng(2), 800, 35.0) + shift


def _distances(surface: Surface, placed: FloatArray) -> FloatArray:
    return plane_distances(surface, placed, reach_of(surface, _OPTIONS))


def test_distances_are_those_from_the_ground(surface: Surface) -> None:
    points = _ground(np.array([0.0, 0.0, 0.3]))
    distance = np.abs(plane_distances(surface, points, 2.0))
    # A vertical offset over a slope is cos(slope) of it across the surface.
    dx = (height(points[:, 0] + 1e-3, points[:, 1]) - height(points[:, 0], points[:, 1])) / 1e-3
    dy = (height(points[:, 0], points[:, 1] + 1e-3) - height(points[:, 0], points[:, 1])) / 1e-3
    assert np.median(np.abs(distance - 0.3 / np.sqrt(1 + dx**2 + dy**2))) < 0.02


def test_points_far_from_the_scan_have_no_distance(surface: Surface) -> None:
    assert np.isnan(plane_distances(surface, _ground(np.array([0.0, 0.0, 30.0])), 2.0)).all()


def test_gicp_brings_a_shifted_map_back(surface: Surface) -> None:
    shift = np.array([0.10, -0.08, 0.15])
    placed = _ground(shift)
    outcome = guarded_gicp(surface, placed, _distances(surface, placed), placed[:200], _LOOSE, _OPTIONS)
    assert outcome.accepted, outcome.message
    moved = outcome.move.act(placed)
    assert np.linalg.norm(moved - (placed - shift), axis=1).mean() < 0.03
    assert outcome.figures["median_distance_after_m"] < outcome.figures["median_distance_before_m"]


def test_the_guard_fires_when_gicp_leaves_the_evidence(surface: Surface) -> None:
    placed = _ground(np.array([0.10, -0.08, 0.15]))
    outcome = guarded_gicp(surface, placed, _distances(surface, placed), placed[:200], _TIGHT, _OPTIONS)
    assert not outcome.accepted
    assert "sigmas" in outcome.message
    assert outcome.figures["move_of_evidence_sigmas"] > _OPTIONS.max_move_sigmas


def test_gicp_that_gains_nothing_is_refused(surface: Surface) -> None:
    placed = _ground(np.zeros(3))
    outcome = guarded_gicp(
        surface, placed, _distances(surface, placed), placed[:200], _LOOSE, replace(_OPTIONS, min_gain=0.5)
    )
    assert not outcome.accepted
    assert "closer" in outcome.message


def test_too_few_points_near_the_scan_are_refused(surface: Surface) -> None:
    placed = np.vstack([_ground(np.zeros(3))[:20], _ground(np.array([0.0, 0.0, 50.0]))])
    outcome = guarded_gicp(surface, placed, _distances(surface, placed), placed[:20], _LOOSE, _OPTIONS)
    assert not outcome.accepted
    assert outcome.figures["points"] == 20


def test_no_surface_without_a_scan_below() -> None:
    far = ground_points(np.random.default_rng(0), 100) + np.array([5000.0, 0.0, 0.0])
    assert surface_near(scan(np.random.default_rng(0), 5000), far, _OPTIONS) is None


def test_thinning_keeps_the_number_of_points_down() -> None:
    cloud = plain_cloud(ground_points(np.random.default_rng(0), 20_000))
    thin = surface_near(
        cloud, ground_points(np.random.default_rng(1), 100), replace(_OPTIONS, max_surface_points=3000)
    )
    assert thin is not None
    assert len(thin.points) == 3000
