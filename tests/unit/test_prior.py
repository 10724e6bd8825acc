"""Does an answer contradict the prior: on both sides of the line, in any direction."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from featuredb.maps.feature_map import GeoPrior
from reloc.localise.localise import contradicts_prior
from reloc.localise.result import LocalisedPose
from tests.unit.test_answer import POSE, a_map, answer_of

SIGMA_M = 4.0


@pytest.fixture(scope="module")
def answer() -> LocalisedPose:
    """An answer whose own horizontal covariance is (1 m)^2 east, (3 m)^2 north."""
    made = answer_of([a_map(placed=np.zeros((7, 7)))], POSE, np.arange(20))
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1.0, 9.0, 4.0])
    return replace(made, covariance=covariance)


def prior_at(answer: LocalisedPose, east_m: float, north_m: float, height_m: float | None = None) -> GeoPrior:
    """That far from the answer, by the geodesic of pyproj."""
    azimuth = np.degrees(np.arctan2(east_m, north_m))
    pose = answer.geopose
    lon, lat, _ = pyproj.Geod(ellps="WGS84").fwd(
        pose.longitude_deg, pose.latitude_deg, azimuth, np.hypot(east_m, north_m)
    )
    return GeoPrior(
        latitude_deg=lat,
        longitude_deg=lon,
        height_m=height_m,
        sigma_horizontal_m=SIGMA_M,
        sigma_vertical_m=1.0,
    )


@pytest.mark.parametrize(
    ("direction", "own_sigma_m"), [((1, 0), 1.0), ((-1, 0), 1.0), ((0, 1), 3.0), ((0, -1), 3.0)]
)
def test_the_line_is_where_both_uncertainties_put_it(
    answer: LocalisedPose, direction: tuple[int, int], own_sigma_m: float
) -> None:
    limit_m = np.sqrt(18.42 * (own_sigma_m**2 + SIGMA_M**2))
    inside = prior_at(answer, *(0.99 * limit_m * np.array(direction)))
    outside = prior_at(answer, *(1.01 * limit_m * np.array(direction)))
    assert contradicts_prior(answer, inside) is None
    found = contradicts_prior(answer, outside)
    assert found is not None
    assert f"{1.01 * limit_m:.1f} m from the prior" in found


def test_the_limit_is_the_ten_thousandth_of_a_chi_square_with_two_degrees_of_freedom() -> None:
    rng = np.random.default_rng(0)
    drawn = (rng.normal(size=(4_000_000, 2)) ** 2).sum(axis=1)
    assert np.mean(drawn > 18.42) == pytest.approx(1e-4, rel=0.2)


def test_heights_and_missing_priors_say_nothing(answer: LocalisedPose) -> None:
    assert contradicts_prior(answer, None) is None
    assert contradicts_prior(answer, prior_at(answer, 1.0, 1.0, height_m=5000.0)) is None


def test_a_prior_in_another_country_contradicts(answer: LocalisedPose) -> None:
    assert contradicts_prior(answer, prior_at(answer, 600_000.0, 0.0)) is not None
