"""Laws of UTM, local frames, GeoPose and tiles over the whole range where they are defined."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.tiles import TILE_SIZE_M, tile_bounds, tile_of, tiles_touching
from featuredb.geo.utm import geodetic_from_utm, utm_epsg, utm_from_geodetic, zone_of
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3

settings.register_profile("geodesy", deadline=None, max_examples=80, derandomize=True)
LAWS = settings.get_profile("geodesy")

# Latitudes and longitudes with the borders of zones, hemispheres and of UTM itself made likely.
edge = st.sampled_from([0.0, 1e-12, -1e-12, 1e-7, -1e-7])
latitudes = st.one_of(
    st.floats(-80.0, 84.0),
    st.sampled_from([-80.0, 0.0, 56.0, 64.0, 72.0, 84.0]).flatmap(lambda x: edge.map(lambda e: x + e)),
).filter(lambda x: -80.0 <= x <= 84.0)
longitudes = st.one_of(
    st.floats(-180.0, 180.0),
    st.integers(-30, 30).flatmap(lambda k: edge.map(lambda e: 6.0 * k + e)),
    st.sampled_from([3.0, 9.0, 21.0, 33.0]),
).filter(lambda x: -180.0 <= x <= 180.0)
heights = st.floats(-400.0, 9000.0)
places = st.tuples(latitudes, longitudes, heights)
offsets = st.tuples(*(st.floats(-5000.0, 5000.0),) * 3).map(np.array)
GEOD = Geod(ellps="WGS84")


def distance_m(a: FloatArray, b: FloatArray) -> float:
    """Along the ellipsoid, by Karney's geodesics; knows that longitudes 180 and -180 are the same."""
    return float(GEOD.inv(a[1], a[0], b[1], b[0])[2])


@LAWS
@given(places)
def test_utm_round_trip_in_the_places_own_zone(place: tuple[float, float, float]) -> None:
    epsg = utm_epsg(place[0], place[1])
    utm = utm_from_geodetic(place, epsg)
    again = geodetic_from_utm(utm, epsg)
    assert distance_m(again, np.array(place)) < 1e-6
    assert again[2] == place[2]
    # UTM's own design: eastings within a zone, widened ones included, northings never negative.
    assert 100_000.0 < utm[0] < 900_000.0
    assert -1e-6 <= utm[1] <= 10_000_000.0
    by_database = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    np.testing.assert_allclose(utm[:2], by_database.transform(place[1], place[0]), rtol=0, atol=1e-6)


@LAWS
@given(places)
def test_zone_is_the_plain_one_or_a_named_exception(place: tuple[float, float, float]) -> None:
    latitude, longitude, _ = place
    zone, hemisphere = zone_of(utm_epsg(latitude, longitude))
    assert hemisphere == ("north" if latitude >= 0 else "south")
    central_meridian = 6 * zone - 183
    away = abs((longitude - central_meridian + 180.0) % 360.0 - 180.0)
    in_norway = 56 <= latitude < 64 and 3 <= longitude < 12
    in_svalbard = latitude >= 72 and 0 <= longitude < 42
    limit = 6.0 if in_norway or in_svalbard else 3.0
    assert away <= limit + 1e-9
    if in_svalbard:
        assert zone % 2 == 1


@LAWS
@given(places, offsets)
def test_local_frame_round_trips_through_own_and_next_zone(
    place: tuple[float, float, float], offset: FloatArray
) -> None:
    latitude, longitude, height = place
    frame = LocalFrame(latitude_deg=latitude, longitude_deg=longitude, height_m=height)
    epsg = utm_epsg(latitude, longitude)
    zone, hemisphere = zone_of(epsg)
    base = 32600 if hemisphere == "north" else 32700
    for code in (epsg, base + zone % 60 + 1, base + (zone - 2) % 60 + 1):
        again = frame.enu_from_utm(frame.utm_from_enu(offset, code), code)
        np.testing.assert_allclose(again, offset, rtol=0, atol=5e-7)
    np.testing.assert_allclose(
        frame.enu_from_geodetic(frame.geodetic_from_enu(offset)), offset, rtol=0, atol=5e-8
    )


@LAWS
@given(places, offsets, offsets)
def test_local_distances_are_straight_lines_in_space(
    place: tuple[float, float, float], first: FloatArray, second: FloatArray
) -> None:
    frame = LocalFrame(latitude_deg=place[0], longitude_deg=place[1], height_m=place[2])
    geocentric = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    ends = frame.geodetic_from_enu(np.array([first, second]))
    x, y, z = geocentric.transform(ends[:, 1], ends[:, 0], ends[:, 2])
    straight = np.linalg.norm(np.diff(np.stack([x, y, z]), axis=1))
    assert np.linalg.norm(second - first) == pytest.approx(straight, abs=1e-7)


@LAWS
@given(places, offsets)
def test_frames_compose(place: tuple[float, float, float], offset: FloatArray) -> None:
    a = LocalFrame(latitude_deg=place[0], longitude_deg=place[1], height_m=place[2])
    b = LocalFrame(latitude_deg=-place[0], longitude_deg=-place[1] / 2, height_m=0.0)
    c = LocalFrame(latitude_deg=10.0, longitude_deg=20.0, height_m=30.0)
    direct, through_b = c.enu_from(a), c.enu_from(b) @ b.enu_from(a)
    np.testing.assert_allclose(direct.matrix(), through_b.matrix(), rtol=0, atol=1e-8)
    assert isinstance(direct, Rigid3)


@LAWS
@given(places, offsets, st.tuples(*(st.floats(-2.0, 2.0),) * 3).map(np.array))
def test_geopose_round_trip(place: tuple[float, float, float], center: FloatArray, omega: FloatArray) -> None:
    frame = LocalFrame(latitude_deg=place[0], longitude_deg=place[1], height_m=place[2])
    turned = Rigid3.exp(np.concatenate([omega, np.zeros(3)]))
    cam_from_local = Rigid3(rotation=turned.rotation, translation=-turned.rotation @ center)
    pose = geopose_from_camera(cam_from_local, frame)
    here = frame.enu_from_geodetic((pose.latitude_deg, pose.longitude_deg, pose.height_m))
    np.testing.assert_allclose(here, center, rtol=0, atol=1e-7)
    # The body's x is ahead, y left, z up, in the ENU of the pose's own position.
    right, down, ahead = cam_from_local.rotation
    axes = frame.true_enu_from_enu(center) @ np.column_stack([ahead, -right, -down])
    np.testing.assert_allclose(pose.true_enu_from_body, axes, atol=1e-10)


coordinates = st.one_of(
    st.floats(-1e7, 2e7),
    st.integers(-20_000, 30_000).map(lambda k: k * TILE_SIZE_M),
    st.integers(-20_000, 30_000).map(lambda k: float(np.nextafter(k * TILE_SIZE_M, -np.inf))),
)
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=20)


@LAWS
@given(points)
def test_tiles_partition_the_plane(plane: list[tuple[float, float]]) -> None:
    names = tile_of(np.array(plane))
    for (easting, northing), name in zip(plane, names, strict=True):
        e0, n0, e1, n1 = tile_bounds(str(name))
        assert e0 <= easting < e1
        assert n0 <= northing < n1
        assert (e1 - e0, n1 - n0) == (TILE_SIZE_M, TILE_SIZE_M)
        # The tile is the only one: its corner and its last point are its own.
        corner = tile_of([[e0, n0], [np.nextafter(e1, -np.inf), np.nextafter(n1, -np.inf)]])
        assert set(corner.tolist()) == {name}


@LAWS
@given(st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1e7)), min_size=2, max_size=20))
def test_tile_names_sort_as_their_numbers(plane: list[tuple[float, float]]) -> None:
    names = tile_of(np.array(plane)).tolist()
    assert sorted(names) == sorted(names, key=tile_bounds)


@LAWS
@given(
    st.tuples(coordinates, coordinates),
    st.tuples(st.floats(0, 3000.0), st.floats(0, 3000.0)),
    st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_box_touches_the_tiles_of_its_points(
    corner: tuple[float, float], size: tuple[float, float], within: tuple[float, float]
) -> None:
    (e0, n0), (e1, n1) = corner, (corner[0] + size[0], corner[1] + size[1])
    touched = tiles_touching(e0, n0, e1, n1)
    inside = (min(e0 + within[0] * size[0], e1), min(n0 + within[1] * size[1], n1))
    assert set(tile_of([inside, (e0, n0), (e1, n1)]).tolist()) <= set(touched)
    assert len(set(touched)) == len(touched)
    for name in touched:  # and no others
        t_e0, t_n0, t_e1, t_n1 = tile_bounds(name)
        assert t_e0 <= e1
        assert t_e1 > e0
        assert t_n0 <= n1
        assert t_n1 > n0
