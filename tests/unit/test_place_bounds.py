"""What a placement is worth in figures, against the closed forms of its covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.maps.place_bounds import PlaceBounds


def test_bounds_hold_95_per_cent_of_the_errors() -> None:
    tilt, heading = np.radians([2.0, 0.5])
    bounds = PlaceBounds.of(np.diag([0.01, tilt, tilt, heading, 3.0, 3.0, 5.0]) ** 2, [0.0, 0.0, 0.0])
    two, one = np.sqrt(chi2.ppf(0.95, [2, 1]))
    assert bounds.horizontal_m == pytest.approx(3.0 * two, rel=1e-3)
    assert bounds.vertical_m == pytest.approx(5.0 * one, rel=1e-3)
    assert bounds.tilt_deg == pytest.approx(2.0 * two, rel=1e-3)
    assert bounds.heading_deg == pytest.approx(0.5 * one, rel=1e-3)
    place, turn = bounds.words()
    assert "7.34 m horizontally and 9.80 m vertically (95 %)" in place
    assert "tilted by 4.9 degrees, which is 8.6 m of height at 100 m" in turn
    assert "turned about the vertical by 1.0 degrees" in turn


def test_the_place_is_that_of_the_middle() -> None:
    """A map known to 0.1 m where it lies, turned about its own middle, 800 m from the frame's origin."""
    middle = np.array([800.0, 0.0, 0.0])
    turn = np.diag([0.0, 0.0, 0.0, np.radians(0.2), 0.1, 0.1, 0.1]) ** 2
    away = np.eye(7)
    away[4:, 1:4] = -np.cross(np.eye(3), middle).T  # a turn about the middle moves the origin
    bounds = PlaceBounds.of(away @ turn @ away.T, middle)
    about = PlaceBounds.of(turn, [0.0, 0.0, 0.0])
    assert bounds.horizontal_m == pytest.approx(about.horizontal_m, rel=1e-6)
    far = PlaceBounds.of(turn, middle)
    assert far.horizontal_m > 800.0 * np.radians(0.2)


def test_a_height_that_nobody_told_is_not_a_figure() -> None:
    place, _ = PlaceBounds.of(np.diag([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1e10]), [0.0, 0.0, 0.0]).words()
    assert place.endswith("2.45 m horizontally (95 %); its height is not known")
