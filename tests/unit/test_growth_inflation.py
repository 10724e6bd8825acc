"""A grown map's covariance is of one size in all directions, and nowhere less than what was known."""

import numpy as np
import pytest

from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import point_jacobian
from ingest.growth.map_places import (
    drift_m,
    inflated,
    isotropic_inflation,
    place_sigmas_m,
    places_of,
)
from tests.support.growth_box import existing


def weak_in_height() -> np.ndarray:
    """Ten times as unsure of height and tilt as of azimuth and place, about a point 500 m west of the map."""
    west = np.array([-500.0, 0.0, 0.0])
    about = np.vstack([np.zeros((1, 3)), np.eye(3), skew(west)])
    turns = np.diag([1e-3, 1e-3, 1e-4]) ** 2
    return about @ turns @ about.T + np.diag([1e-8, 0.0, 0.0, 0.0, 0.02**2, 0.02**2, 0.2**2])


def test_one_size_in_all_directions() -> None:
    feature_map = existing()
    alike = isotropic_inflation(feature_map, weak_in_height())
    middle = np.mean([image.cam_from_local.center for image in feature_map.images], axis=0)
    jacobian = point_jacobian(middle)
    shift, turn = jacobian @ alike @ jacobian.T, alike[1:4, 1:4]
    for matrix in (shift, turn):
        np.testing.assert_allclose(matrix, matrix[0, 0] * np.eye(3), rtol=1e-6, atol=1e-12)
    assert turn[2, 2] >= 1e-3**2
    assert np.linalg.eigvalsh(alike)[0] > -1e-12


def test_nowhere_less_than_in_the_worst_direction_before() -> None:
    feature_map, given = existing(), weak_in_height()
    places = places_of(feature_map)
    alike = isotropic_inflation(feature_map, given)
    assert (place_sigmas_m(alike, places) >= 0.999 * place_sigmas_m(given, places)).mean() >= 0.99
    assert drift_m(given, places) <= drift_m(alike, places) < 1.5 * drift_m(given, places)


def test_what_is_alike_already_stays() -> None:
    feature_map = existing(sigma_m=0.3)
    again = inflated(inflated(feature_map)).placement.covariance
    once = inflated(feature_map).placement.covariance
    np.testing.assert_allclose(again, once, rtol=1e-6, atol=1e-12)
    assert drift_m(once, places_of(feature_map)) == pytest.approx(1.96 * 0.3, rel=0.02)


def test_a_height_that_nobody_knows_leaves_the_place_in_plan() -> None:
    feature_map, given = existing(), weak_in_height()
    given[6, 6] = 1e10
    alike = isotropic_inflation(feature_map, given)
    assert alike[6, 6] >= 1e10
    middle = np.mean([image.cam_from_local.center for image in feature_map.images], axis=0)
    in_plan = (point_jacobian(middle) @ alike @ point_jacobian(middle).T)[:2, :2]
    assert np.sqrt(np.linalg.eigvalsh(in_plan)[-1]) < 3.0
