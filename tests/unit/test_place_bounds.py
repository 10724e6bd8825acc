"""What a placement is worth in figures, against the closed forms of its covariance."""

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.maps.place_bounds import PlaceBounds


def test_bounds_hold_95_per_cent_of_the_errors() -> None:
    tilt, heading = np.radians([2.0, 0.5])
    bounds = PlaceBounds.of(np.diag([0.01, tilt, tilt, heading, 3.0, 3.0, 5.0]) ** 2)
    two, one = np.sqrt(chi2.ppf(0.95, [2, 1]))
    assert bounds.horizontal_m == pytest.approx(3.0 * two, rel=1e-3)
    assert bounds.vertical_m == pytest.approx(5.0 * one, rel=1e-3)
    assert bounds.tilt_deg == pytest.approx(2.0 * two, rel=1e-3)
    assert bounds.heading_deg == pytest.approx(0.5 * one, rel=1e-3)
    place, turn = bounds.words()
    assert "7.34 m horizontally and 9.80 m vertically (95 %)" in place
    assert "tilted by 4.9 degrees, which is 8.6 m of height at 100 m" in turn
    assert "turned about the vertical by 1.0 degrees" in turn
