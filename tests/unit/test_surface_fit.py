"""Distances from a scan of rolling ground."""

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from ingest.register.structure.surface_fit import (
    Surface,
    nearest_planes,
    surface_near,
)
from tests.support.scanned_map import ground_points, height, plain_cloud, scan


@pytest.fixture(scope="module")
def surface() -> Surface:
    found = surface_near(scan(np.random.default_rng(0)), ground_points(np.random.default_rng(1), 500))
    assert found is not None
    return found


def _ground(shift: FloatArray) -> FloatArray:
    return ground_points(np.random.default_rng(2), 800, 35.0) + shift


def test_distances_are_those_from_the_ground(surface: Surface) -> None:
    points = _ground(np.array([0.0, 0.0, 0.3]))
    distance = np.abs(nearest_planes(surface, points, 2.0)[0])
    # A vertical offset over a slope is cos(slope) of it across the surface.
    dx = (height(points[:, 0] + 1e-3, points[:, 1]) - height(points[:, 0], points[:, 1])) / 1e-3
    dy = (height(points[:, 0], points[:, 1] + 1e-3) - height(points[:, 0], points[:, 1])) / 1e-3
    assert np.median(np.abs(distance - 0.3 / np.sqrt(1 + dx**2 + dy**2))) < 0.02


def test_points_far_from_the_scan_have_no_distance(surface: Surface) -> None:
    assert np.isnan(nearest_planes(surface, _ground(np.array([0.0, 0.0, 30.0])), 2.0)[0]).all()


def test_no_surface_without_a_scan_below() -> None:
    far = ground_points(np.random.default_rng(0), 100) + np.array([5000.0, 0.0, 0.0])
    assert surface_near(scan(np.random.default_rng(0), 5000), far) is None


def test_thinning_keeps_the_number_of_points_down() -> None:
    cloud = plain_cloud(ground_points(np.random.default_rng(0), 20_000))
    thin = surface_near(cloud, ground_points(np.random.default_rng(1), 100), 3000)
    assert thin is not None
    assert len(thin.points) == 3000
