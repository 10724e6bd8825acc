"""UTM: exact zones, published coordinates, scale and convergence from first principles, refusals."""

import threading

import numpy as np
import pytest

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.utm import (
    geodetic_from_utm,
    meridian_convergence_deg,
    point_scale,
    utm_epsg,
    utm_from_geodetic,
    zone_of,
)


@pytest.mark.parametrize(
    ("latitude", "longitude", "epsg"),
    [
        (49.0, 8.4, 32632),  # Karlsruhe
        (-33.86, 151.21, 32756),  # Sydney
        (0.0, 0.0, 32631),  # the equator is northern
        (-1e-9, 0.0, 32731),
        (0.0, -180.0, 32601),
        (0.0, 180.0, 32601),  # the same meridian
        (0.0, 179.999999, 32660),
        (10.0, 5.999999, 32631),
        (10.0, 6.0, 32632),  # a border belongs to the east
        (84.0, 50.0, 32639),  # the limits are within
        (-80.0, 50.0, 32739),
        # Norway: 32V reaches from 3 E to 12 E between 56 N and 64 N.
        (55.999999, 3.0, 32631),
        (56.0, 2.999999, 32631),
        (56.0, 3.0, 32632),
        (60.39, 5.32, 32632),  # Bergen
        (63.999999, 3.0, 32632),
        (64.0, 3.0, 32631),
        (60.0, 11.999999, 32632),
        (60.0, 12.0, 32633),
        # Svalbard: 31X to 9 E, 33X to 21 E, 35X to 33 E, 37X to 42 E, from 72 N.
        (72.0, -0.000001, 32630),
        (72.0, 0.0, 32631),
        (72.0, 9.0, 32633),
        (78.0, 8.999999, 32631),
        (78.0, 9.0, 32633),
        (78.22, 15.65, 32633),  # Longyearbyen
        (78.0, 20.999999, 32633),
        (78.0, 21.0, 32635),
        (78.0, 32.999999, 32635),
        (78.0, 33.0, 32637),
        (78.0, 41.999999, 32637),
        (78.0, 42.0, 32638),
        (84.0, 9.0, 32633),
        (71.999999, 9.0, 32632),
        (71.999999, 20.0, 32634),
    ],
)
def test_zone_of_a_place(latitude: float, longitude: float, epsg: int) -> None:
    assert utm_epsg(latitude, longitude) == epsg


def test_zone_of_every_degree_against_plain_rule() -> None:
    for longitude in range(-180, 180):
        assert utm_epsg(30.5, longitude + 0.5) == 32600 + (longitude + 180) // 6 + 1
        assert utm_epsg(-75.5, longitude + 0.5) == 32700 + (longitude + 180) // 6 + 1


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [(84.000001, 0), (-80.000001, 0), (90, 0), (np.nan, 0), (0, np.nan), (0, 180.1), (0, -181), (np.inf, 0)],
)
def test_places_without_a_zone_are_refused(latitude: float, longitude: float) -> None:
    with pytest.raises(GeodesyError, match="UTM"):
        utm_epsg(latitude, longitude)


def test_zone_and_hemisphere_of_a_code() -> None:
    assert zone_of(32632) == (32, "north")
    assert zone_of(32756) == (56, "south")
    assert zone_of(32601) == (1, "north")
    assert zone_of(32660) == (60, "north")
    assert zone_of(np.int64(32701)) == (1, "south")


# Geodetic, web Mercator, ETRS89 UTM, NAD83 UTM, the WGS84 polar grids, and the gaps beside the zones.
@pytest.mark.parametrize("epsg", [4326, 3857, 25832, 26910, 32661, 32761, 32600, 32700, 0, -32632, 32632.5])
def test_other_codes_are_refused(epsg: int) -> None:
    for call in (
        lambda: zone_of(epsg),
        lambda: utm_from_geodetic((49.0, 8.0, 0.0), epsg),
        lambda: geodetic_from_utm((5e5, 5e6, 0.0), epsg),
        lambda: point_scale(49.0, 8.0, epsg),
    ):
        with pytest.raises(GeodesyError, match="WGS84 UTM zone"):
            call()


@pytest.mark.parametrize(
    ("place", "epsg", "expected"),
    [
        # CN Tower in the encyclopaedias' UTM example: 17T 630084 4833438.
        ((43.642567, -79.387139, 0.0), 32617, (630084.0, 4833438.0)),
        # The central meridian at the equator, by definition.
        ((0.0, 9.0, 0.0), 32632, (500000.0, 0.0)),
        ((0.0, 9.0, 0.0), 32732, (500000.0, 10000000.0)),
    ],
)
def test_published_coordinates(
    place: tuple[float, float, float], epsg: int, expected: tuple[float, float]
) -> None:
    easting, northing, height = utm_from_geodetic(place, epsg)
    assert (easting, northing) == pytest.approx(expected, abs=0.6)
    assert height == 0.0


def test_meridian_arc_on_the_central_meridian() -> None:
    # Northing there is 0.9996 times the ellipsoid's meridian arc; the quadrant is 10 001 965.729 m long.
    northing = utm_from_geodetic((90.0, 9.0, 0.0), 32632)[1]
    assert northing == pytest.approx(0.9996 * 10_001_965.729, abs=1e-3)


def test_heights_pass_unchanged() -> None:
    utm = utm_from_geodetic([(49.0, 8.0, -12.5), (49.0, 8.0, 8848.0)], 32632)
    np.testing.assert_array_equal(utm[:, 2], [-12.5, 8848.0])
    np.testing.assert_array_equal(utm[0, :2], utm[1, :2])


def test_two_hemispheres_differ_by_the_false_northing_alone() -> None:
    place = (-0.5, 8.0, 10.0)
    shift = utm_from_geodetic(place, 32732) - utm_from_geodetic(place, 32632)
    np.testing.assert_allclose(shift, [0.0, 1e7, 0.0], atol=1e-8)


def test_antimeridian_is_no_border_for_the_projection() -> None:
    # 0.01 degrees on both sides of the border of zones 60 and 1, both in zone 60.
    west, east = utm_from_geodetic([(10.0, 179.99, 0.0), (10.0, -179.99, 0.0)], 32660)
    assert 0 < east[0] - west[0] < 2300.0
    assert geodetic_from_utm(east, 32660)[1] == pytest.approx(-179.99, abs=1e-9)


@pytest.mark.parametrize("epsg", [32632, 32732])
@pytest.mark.parametrize("longitude", [6.1, 8.0, 9.0, 11.9])
@pytest.mark.parametrize("latitude", [-79.0, -33.0, -1.0, 1.0, 49.0, 83.5])
def test_convergence_and_scale_against_finite_differences(
    latitude: float, longitude: float, epsg: int
) -> None:
    step_deg = 1e-4
    north = (latitude + step_deg, longitude, 0.0)
    south = (latitude - step_deg, longitude, 0.0)
    d_easting, d_northing, _ = utm_from_geodetic(north, epsg) - utm_from_geodetic(south, epsg)
    # Going true north leads along grid azimuth -convergence.
    grid_azimuth_deg = np.degrees(np.arctan2(d_easting, d_northing))
    assert meridian_convergence_deg(latitude, longitude, epsg) == pytest.approx(-grid_azimuth_deg, abs=1e-5)
    # The meridian's radius of curvature, from the ellipsoid's definition.
    flattening = 1 / 298.257223563
    e2 = flattening * (2 - flattening)
    radius = 6378137.0 * (1 - e2) / (1 - e2 * np.sin(np.radians(latitude)) ** 2) ** 1.5
    scale = np.hypot(d_easting, d_northing) / (2 * np.radians(step_deg) * radius)
    assert point_scale(latitude, longitude, epsg) == pytest.approx(scale, abs=1e-8)


def test_scale_and_convergence_at_the_central_meridian() -> None:
    assert point_scale(49.0, 9.0, 32632) == pytest.approx(0.9996, abs=1e-9)
    assert meridian_convergence_deg(49.0, 9.0, 32632) == pytest.approx(0.0, abs=1e-9)
    # tan(convergence) = tan(dlon) sin(lat) on the sphere, the leading term on the ellipsoid.
    spherical = np.degrees(np.arctan(np.tan(np.radians(2.0)) * np.sin(np.radians(49.0))))
    assert meridian_convergence_deg(49.0, 11.0, 32632) == pytest.approx(spherical, abs=1e-3)
    assert meridian_convergence_deg(-49.0, 11.0, 32732) == pytest.approx(-spherical, abs=1e-3)


def test_latitude_and_longitude_taken_for_utm_are_refused() -> None:
    with pytest.raises(GeodesyError, match="degrees"):
        geodetic_from_utm([(500000.0, 5e6, 0.0), (49.0, 8.4, 120.0)], 32632)


@pytest.mark.parametrize("place", [(91.0, 8.0, 0.0), (49.0, 181.0, 0.0), (500000.0, 5e6, 0.0)])
def test_utm_taken_for_degrees_is_refused(place: tuple[float, float, float]) -> None:
    with pytest.raises(GeodesyError, match="order of the columns"):
        utm_from_geodetic(place, 32632)
    with pytest.raises(GeodesyError, match="order of the columns"):
        meridian_convergence_deg(place[0], place[1], 32632)


def test_places_beyond_the_projection_are_refused() -> None:
    with pytest.raises(GeodesyError, match=r"PROJ cannot convert 1 of 2 points"):
        geodetic_from_utm([(500000.0, 5e6, 0.0), (1e9, 1e9, 0.0)], 32632)
    with pytest.raises(GeodesyError, match="central meridian"):
        point_scale(0.0, 99.0, 32632)


@pytest.mark.parametrize("value", [[1.0, 2.0], np.zeros((2, 2)), [np.nan, 0, 0], [["a", "b", "c"]], None])
def test_malformed_points_are_refused(value: object) -> None:
    with pytest.raises(InvalidValueError):
        utm_from_geodetic(value, 32632)  # type: ignore[arg-type]


def test_shapes_single_many_none() -> None:
    assert utm_from_geodetic((49.0, 8.0, 0.0), 32632).shape == (3,)
    assert utm_from_geodetic([(49.0, 8.0, 0.0)], 32632).shape == (1, 3)
    assert utm_from_geodetic(np.empty((0, 3)), 32632).shape == (0, 3)
    assert utm_from_geodetic(np.array([49, 8, 0], dtype=np.int32), 32632).dtype == np.float64


def test_threads_agree() -> None:
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-80, 84, 500), rng.uniform(6, 12, 500), rng.uniform(0, 500, 500)])
    expected = utm_from_geodetic(places, 32632)
    convergence = meridian_convergence_deg(49.0, 8.0, 32632)
    wrong: list[int] = []

    def work(number: int) -> None:
        for _ in range(20):
            same = np.array_equal(utm_from_geodetic(places, 32632), expected)
            if not same or meridian_convergence_deg(49.0, 8.0, 32632) != convergence:
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
