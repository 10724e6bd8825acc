"""Every gate of growth: a figure that passes, one that does not, and what stands between them."""

import numpy as np
import pytest

from ingest.growth import gates


def test_one_photo_is_never_enough() -> None:
    assert not gates.agreement(1, 0).passes
    assert gates.agreement(1, 0).reason == "TOO_FEW_AGREE"
    assert gates.agreement(2, 0).passes
    assert not gates.agreement(0, 0).passes


def test_a_third_of_the_photos_may_disagree() -> None:
    assert gates.agreement(2, 1).passes
    refused = gates.agreement(2, 2)
    assert not refused.passes
    assert (refused.figure, refused.reason) == (0.5, "PHOTOS_DISAGREE")
    assert "2 of 4" in refused.message


def test_a_lying_geotag_of_one_photo_does_not_matter() -> None:
    spread = np.tile(np.eye(2) * 25.0, (4, 1, 1))
    liar = np.array([[3.0, 1.0], [-2.0, 4.0], [5000.0, 0.0]])
    assert gates.geotags(liar, spread[:3]).passes
    assert gates.geotags(liar[2:], spread[:1]).passes  # alone, too
    most = np.array([[400.0, 0.0], [400.0, 0.0], [400.0, 0.0], [5000.0, 0.0]])
    refused = gates.geotags(most, spread)
    assert not refused.passes
    assert refused.figure == pytest.approx(0.15**4)
    assert "which is 400 m to the east" in refused.message
    assert "placement by map, which is 5.0 km" in gates.geotags(liar, spread[:3], by="map").message
    assert gates.geotags(np.zeros((0, 2)), np.zeros((0, 2, 2))).passes


def test_more_wrong_geotags_than_come_by_accident_are_none() -> None:
    """Where 15 % are wrong, two of two happen 2.3 % of the time, three of three 0.3, eight of twenty 0.6."""
    spread = np.tile(np.eye(2) * 900.0, (20, 1, 1))

    def passes(wrong: int, count: int) -> bool:
        offsets = np.zeros((count, 2))
        offsets[:wrong] = (150.0, 0.0)
        return gates.geotags(offsets, spread[:count]).passes

    assert passes(2, 2)
    assert not passes(3, 3)
    assert passes(3, 6)
    assert passes(7, 20)
    assert not passes(8, 20)
    assert not passes(10, 20)


def test_geotags_count_by_their_own_sigma() -> None:
    """Chi-square of (15, 0) is 9 at a sigma of 5 m and 14 at 4 m; the limit is 11.8."""
    offsets = np.tile([[15.0, 0.0]], (3, 1))
    assert gates.geotags(offsets, np.tile(np.eye(2) * 25.0, (3, 1, 1))).passes
    assert not gates.geotags(offsets, np.tile(np.eye(2) * 16.0, (3, 1, 1))).passes


def test_photos_that_do_not_show_what_they_should() -> None:
    assert gates.visibility(np.array([0.9, 0.8, 0.1])).passes
    refused = gates.visibility(np.array([0.9, 0.1, 0.0]))
    assert not refused.passes
    assert refused.reason == "NOT_VISIBLE"
    assert gates.visibility(np.zeros(0)).passes


def test_limit_of_three_sigmas_by_degrees_of_freedom() -> None:
    """Tables of chi-square: 99.73 % lies below 9, 11.83 and 20.06 for 1, 2 and 6 degrees of freedom."""
    assert gates.sigmas_limit(1) == pytest.approx(9.0)
    assert gates.sigmas_limit(2) == pytest.approx(11.829, abs=1e-3)
    assert gates.sigmas_limit(6) == pytest.approx(20.062, abs=1e-3)


def test_figures_as_json_has_them() -> None:
    assert gates.drift(0.9, 0.5).as_json() == {"figure": 0.9, "limit": 0.5, "passes": False}
    assert gates.drift(float("nan"), 0.5).as_json()["figure"] is None
