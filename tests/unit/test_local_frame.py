"""LocalFrame against PROJ's own topocentric conversion and against geometry known by hand."""

import dataclasses

import numpy as np
import pytest
from pyproj import Transformer

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import point_scale, utm_epsg, utm_from_geodetic
from featuredb.geometry.arrays import FloatArray

MICROMETRE = 1e-6
FRAMES = [
    LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=120.0),
    LocalFrame(latitude_deg=-33.8568, longitude_deg=151.2153, height_m=25.0),
    LocalFrame(latitude_deg=0.0, longitude_deg=-180.0, height_m=0.0),
    LocalFrame(latitude_deg=83.9, longitude_deg=17.0, height_m=8000.0),
    LocalFrame(latitude_deg=-79.9, longitude_deg=-69.0, height_m=-400.0),
]


def points_around(seed: int, extent_m: float, n: int = 300) -> FloatArray:
    return np.asarray(np.random.default_rng(seed).uniform(-extent_m, extent_m, (n, 3)), dtype=np.float64)


def proj_topocentric(frame: LocalFrame) -> Transformer:
    """An independent pipeline: longitude, latitude, height to topocentric, all of it PROJ's."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={frame.latitude_deg!r} "
        f"+lon_0={frame.longitude_deg!r} +h_0={frame.height_m!r}"
    )


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("extent_m", [10.0, 3000.0, 20000.0])
def test_agrees_with_proj_topocentric(frame: LocalFrame, extent_m: float) -> None:
    enu = points_around(1, extent_m)
    latitude, longitude, height = frame.geodetic_from_enu(enu).T
    expected = np.stack(proj_topocentric(frame).transform(longitude, latitude, height), axis=1)
    np.testing.assert_allclose(enu, expected, rtol=0, atol=MICROMETRE / 10)
    geodetic = np.column_stack([latitude, longitude, height])
    np.testing.assert_allclose(frame.enu_from_geodetic(geodetic), expected, rtol=0, atol=MICROMETRE / 10)


@pytest.mark.parametrize("frame", FRAMES)
def test_utm_round_trip_is_below_a_micrometre(frame: LocalFrame) -> None:
    enu = points_around(2, 5000.0)
    epsg = utm_epsg(frame.latitude_deg, frame.longitude_deg)
    utm = frame.utm_from_enu(enu, epsg)
    np.testing.assert_allclose(frame.enu_from_utm(utm, epsg), enu, rtol=0, atol=MICROMETRE / 10)
    latitude, longitude, height = frame.geodetic_from_enu(enu).T
    by_crs = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    easting, northing = by_crs.transform(longitude, latitude)
    np.testing.assert_allclose(utm, np.column_stack([easting, northing, height]), rtol=0, atol=MICROMETRE)


def test_round_trip_stays_exact_far_above_the_ellipsoid() -> None:
    # PROJ's own inverse is off by a micrometre at 9 km and by millimetres at 400 km.
    frame = FRAMES[0]
    enu = np.array([[1000.0, -2000.0, 9000.0], [0.0, 0.0, 400e3], [300e3, 200e3, 50e3]])
    again = frame.enu_from_geodetic(frame.geodetic_from_enu(enu))
    np.testing.assert_allclose(again, enu, rtol=0, atol=1e-8)


def test_distances_are_true_although_the_grid_shrinks_them() -> None:
    # Two points 1 km apart on the central meridian at height 0: 999.6 m of northing.
    frame = LocalFrame(latitude_deg=49.0, longitude_deg=9.0, height_m=0.0)
    ends = np.array([[0.0, -500.0, 0.0], [0.0, 500.0, 0.0]])
    utm = frame.utm_from_enu(ends, 32632)
    grid_distance = np.linalg.norm(utm[1, :2] - utm[0, :2])
    assert grid_distance == pytest.approx(1000.0 * point_scale(49.0, 9.0, 32632), abs=1e-4)
    assert grid_distance < 999.61
    enu = frame.enu_from_utm(utm, 32632)
    assert np.linalg.norm(enu[1] - enu[0]) == pytest.approx(1000.0, abs=MICROMETRE)


def test_up_is_height_at_the_origin_and_the_earth_curves_away() -> None:
    frame = FRAMES[0]
    assert frame.geodetic_from_enu((0.0, 0.0, 77.0))[2] == pytest.approx(frame.height_m + 77.0, abs=1e-8)
    # A tangent plane rises d^2 / 2R above the ellipsoid: 7.8 cm at 1 km.
    rise = frame.geodetic_from_enu((1000.0, 0.0, 0.0))[2] - frame.height_m
    assert rise == pytest.approx(1000.0**2 / (2 * 6.39e6), rel=0.01)


def test_two_zones_meet_in_one_frame() -> None:
    # Points at the border of 31N and 32N, the same in both zones' coordinates.
    frame = LocalFrame(latitude_deg=48.0, longitude_deg=6.0, height_m=300.0)
    enu = points_around(3, 2000.0)
    in_31, in_32 = frame.utm_from_enu(enu, 32631), frame.utm_from_enu(enu, 32632)
    assert np.abs(in_31[:, 0] - in_32[:, 0]).min() > 400e3
    np.testing.assert_allclose(
        frame.enu_from_utm(in_31, 32631), frame.enu_from_utm(in_32, 32632), rtol=0, atol=MICROMETRE / 10
    )


def test_from_utm_puts_the_origin_there() -> None:
    frame = LocalFrame.from_utm(456_789.125, 5_429_321.5, 118.75, 32632)
    np.testing.assert_allclose(
        frame.utm_from_enu((0.0, 0.0, 0.0), 32632), [456_789.125, 5_429_321.5, 118.75], rtol=0, atol=1e-7
    )
    np.testing.assert_allclose(
        frame.enu_from_utm((456_789.125, 5_429_321.5, 118.75), 32632), np.zeros(3), atol=1e-7
    )


@pytest.mark.parametrize("other", FRAMES)
def test_change_of_frame_is_exact_and_rigid(other: LocalFrame) -> None:
    here = LocalFrame(latitude_deg=49.02, longitude_deg=8.43, height_m=90.0)
    enu_other = points_around(4, 2000.0)
    expected = here.enu_from_geodetic(other.geodetic_from_enu(enu_other))
    # Antipodal frames lie 1e7 m apart, where float64 resolves 2e-9 m.
    np.testing.assert_allclose(here.enu_from(other).act(enu_other), expected, rtol=0, atol=2e-8)
    back_and_forth = here.enu_from(other) @ other.enu_from(here)
    np.testing.assert_allclose(back_and_forth.matrix(), np.eye(4), atol=1e-8)


def test_change_to_the_same_frame_is_the_identity() -> None:
    np.testing.assert_allclose(FRAMES[0].enu_from(FRAMES[0]).matrix(), np.eye(4), atol=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (4000.0, -3000.0, 200.0)])
def test_axes_against_finite_differences(frame: LocalFrame, point: tuple[float, float, float]) -> None:
    latitude, longitude, height = frame.geodetic_from_enu(point)
    step_deg, step_m = 1e-5, 1.0
    here = np.array([latitude, longitude, height])

    def enu(geodetic: FloatArray) -> FloatArray:
        wrapped = (geodetic[1] + 180.0) % 360.0 - 180.0  # one frame lies on the antimeridian
        return frame.enu_from_geodetic((geodetic[0], wrapped, geodetic[2]))

    def direction(delta: FloatArray) -> FloatArray:
        difference = enu(here + delta) - enu(here - delta)
        return np.asarray(difference / np.linalg.norm(difference), dtype=np.float64)

    rows = [direction(np.array([0, step_deg, 0])), direction(np.array([step_deg, 0, 0]))]
    rows.append(direction(np.array([0, 0, step_m])))
    rotation = frame.true_enu_from_enu(point)
    np.testing.assert_allclose(rotation, np.array(rows), atol=1e-8)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_axes_at_the_origin_are_the_frame() -> None:
    np.testing.assert_allclose(FRAMES[1].true_enu_from_enu((0.0, 0.0, 50.0)), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (4000.0, -3000.0, 200.0)])
def test_grid_axes_against_finite_differences(frame: LocalFrame, point: tuple[float, float, float]) -> None:
    epsg = utm_epsg(frame.latitude_deg, frame.longitude_deg)
    grid_from_enu = frame.grid_from_enu(point, epsg)
    # Steps along the local axes that are level at the point; their images in the grid, scale taken out.
    level_from_true = frame.true_enu_from_enu(point).T
    for axis in (level_from_true[:, 0], level_from_true[:, 1]):
        ahead = frame.utm_from_enu(np.array(point) + 5.0 * axis, epsg)
        behind = frame.utm_from_enu(np.array(point) - 5.0 * axis, epsg)
        moved = (ahead - behind) / np.linalg.norm(ahead - behind)
        np.testing.assert_allclose(grid_from_enu @ axis, moved, atol=1e-6)
    np.testing.assert_allclose(grid_from_enu @ level_from_true[:, 2], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(grid_from_enu) == pytest.approx(1.0)


def test_grid_north_is_east_of_true_north_east_of_the_central_meridian() -> None:
    frame = LocalFrame(latitude_deg=49.0, longitude_deg=11.0, height_m=0.0)
    true_north_in_grid = frame.grid_from_enu((0.0, 0.0, 0.0), 32632) @ [0.0, 1.0, 0.0]
    assert np.degrees(np.arcsin(-true_north_in_grid[0])) == pytest.approx(1.5097, abs=1e-4)


def test_frames_are_values() -> None:
    same = LocalFrame(latitude_deg=49, longitude_deg=np.float64(8.4), height_m=120)
    assert same == FRAMES[0]
    assert hash(same) == hash(FRAMES[0])
    assert same != dataclasses.replace(same, height_m=121.0)
    assert dataclasses.asdict(same) == {"latitude_deg": 49.0, "longitude_deg": 8.4, "height_m": 120.0}
    with pytest.raises(dataclasses.FrozenInstanceError):
        same.height_m = 3.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("latitude", "longitude", "height"),
    [(90.1, 0, 0), (0, -180.1, 0), (np.nan, 0, 0), (0, np.nan, 0), (0, 0, np.inf), (0, 0, np.nan)],
)
def test_impossible_origins_are_refused(latitude: float, longitude: float, height: float) -> None:
    with pytest.raises(InvalidValueError, match="LocalFrame"):
        LocalFrame(latitude_deg=latitude, longitude_deg=longitude, height_m=height)


def test_bad_coordinates_are_refused() -> None:
    frame = FRAMES[0]
    with pytest.raises(GeodesyError, match="degrees"):
        frame.enu_from_utm([(8.4, 49.0, 100.0)], 32632)
    with pytest.raises(GeodesyError, match="WGS84 UTM zone"):
        frame.enu_from_utm([(456_789.0, 5_429_321.0, 100.0)], 25832)
    with pytest.raises(GeodesyError, match="order of the columns"):
        frame.enu_from_geodetic((456_789.0, 5_429_321.0, 100.0))
    with pytest.raises(InvalidValueError, match="finite"):
        frame.utm_from_enu([(np.nan, 0.0, 0.0)], 32632)
    with pytest.raises(InvalidValueError, match="shape"):
        frame.geodetic_from_enu(np.zeros((2, 2)))
    with pytest.raises(InvalidValueError, match="one point"):
        frame.true_enu_from_enu(np.zeros((1, 3)))


def test_shapes_single_many_none() -> None:
    frame = FRAMES[0]
    utm = utm_from_geodetic((49.001, 8.401, 130.0), 32632)
    assert frame.enu_from_utm(utm, 32632).shape == (3,)
    assert frame.enu_from_utm(utm[None], 32632).shape == (1, 3)
    for method in (frame.enu_from_utm, frame.utm_from_enu):
        assert method(np.empty((0, 3)), 32632).shape == (0, 3)
    for convert in (frame.enu_from_geodetic, frame.geodetic_from_enu):
        assert convert(np.empty((0, 3))).shape == (0, 3)


def test_poles_are_finite() -> None:
    frame = LocalFrame(latitude_deg=90.0, longitude_deg=0.0, height_m=0.0)
    enu = np.array([[0.0, 0.0, 10.0], [100.0, 50.0, 0.0]])
    np.testing.assert_allclose(frame.enu_from_geodetic(frame.geodetic_from_enu(enu)), enu, atol=1e-8)


@pytest.mark.parametrize("latitude", [0.0, 60.0, 89.99])
def test_longitudes_stay_in_range_at_the_antimeridian(latitude: float) -> None:
    # On the meridian itself rounding decides the side; what comes out must be fit to go in again.
    frame = LocalFrame(latitude_deg=latitude, longitude_deg=180.0, height_m=0.0)
    enu = points_around(6, 5000.0, n=3000) * [1e-9, 1.0, 1.0]
    geodetic = frame.geodetic_from_enu(enu)
    assert np.abs(geodetic[:, 1]).max() <= 180.0
    np.testing.assert_allclose(frame.enu_from_geodetic(geodetic), enu, rtol=0, atol=2e-8)


@pytest.mark.parametrize("epsg", [32601, 32660, 32701, 32760])
def test_utm_at_the_antimeridian_has_a_place(epsg: int) -> None:
    """PROJ's longitude may lie a rounding beyond 180 degrees."""
    latitudes = np.linspace(0.0, 80.0, 161) * (-1.0 if epsg > 32700 else 1.0)
    places = np.column_stack([latitudes, np.full(len(latitudes), 180.0), np.zeros(len(latitudes))])
    utm = utm_from_geodetic(places, epsg)
    frame = LocalFrame(latitude_deg=latitudes[80], longitude_deg=180.0, height_m=0.0)
    np.testing.assert_allclose(frame.enu_from_utm(utm, epsg), frame.enu_from_geodetic(places), atol=1e-6)


@pytest.mark.parametrize("middle", [180.0, -180.0, 0.0, 8.41])
def test_the_middle_of_places_is_among_them_on_every_meridian(middle: float) -> None:
    east = np.array([-3e-4, -2e-4, -1e-4, 1e-4, 2e-4, 3e-4])
    longitude = (middle + east + 180.0) % 360.0 - 180.0
    places = np.column_stack([np.full(6, -17.0), longitude, [10.0, 11.0, np.nan, 12.0, np.nan, 13.0]])
    stray = np.array([[60.0, middle / 2.0 + 60.0, 5000.0]])
    for given in (places, places[::-1], np.concatenate([stray, places])):
        frame = LocalFrame.amid(given)
        assert np.abs((frame.longitude_deg - middle + 180.0) % 360.0 - 180.0) < 3e-4
        assert frame.latitude_deg == -17.0
        assert 11.0 <= frame.height_m <= 12.0
    assert LocalFrame.amid(np.array([[48.0, 8.0, np.nan]])).height_m == 0.0
