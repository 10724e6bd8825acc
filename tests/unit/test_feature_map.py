"""FeatureMap and its parts: they refuse what contradicts itself, and convert between frames exactly."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from featuredb.errors import FeatureDbError, GeodesyError, InvalidValueError
from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import geodetic_from_utm
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapImage, MapObservations, MapPoints, Placement
from tests.support.maps import EASTING, EPSG, HEIGHT, NORTHING, random_map


@pytest.fixture(scope="module")
def feature_map() -> FeatureMap:
    return random_map(1)


def points(n: int = 4, **change: Any) -> MapPoints:
    values: dict[str, Any] = {
        "utm": np.tile([EASTING, NORTHING, HEIGHT], (n, 1)),
        "rgb": np.zeros((n, 3), np.uint8),
        "track_length": np.full(n, 3, np.int32),
        "error_px": np.full(n, 0.5, np.float32),
        "covariance": np.zeros((n, 6), np.float32),
    }
    return MapPoints(**(values | change))


def observations(m: int = 5, **change: Any) -> MapObservations:
    values: dict[str, Any] = {
        "point_index": np.zeros(m, np.int64),
        "image_id": np.zeros(m, np.int32),
        "xy": np.zeros((m, 2), np.float32),
        "scale": np.ones(m, np.float32),
        "angle": np.zeros(m, np.float32),
        "has_descriptor": np.zeros(m, np.bool_),
        "descriptors": np.zeros((m, 128), np.uint8),
    }
    return MapObservations(**(values | change))


@pytest.mark.parametrize(
    "change",
    [
        {"utm": np.zeros((3, 3))},
        {"utm": np.zeros((4, 2))},
        {"utm": np.full((4, 3), np.nan)},
        {"rgb": np.full((4, 3), 256)},
        {"rgb": np.full((4, 3), 0.5)},
        {"track_length": np.zeros(3, np.int32)},
        {"track_length": np.full(4, 2**31)},
        {"error_px": np.full(4, np.inf)},
        {"covariance": np.zeros((4, 3, 3))},
    ],
)
def test_points_refuse_ragged_or_lossy_columns(change: dict[str, Any]) -> None:
    assert len(points()) == 4
    with pytest.raises(InvalidValueError, match="MapPoints"):
        points(**change)


@pytest.mark.parametrize(
    "change",
    [
        {"point_index": np.full(5, 0.5)},
        {"image_id": np.zeros(4, np.int32)},
        {"xy": np.zeros((5, 3), np.float32)},
        {"xy": np.full((5, 2), np.nan)},
        {"has_descriptor": np.full(5, 2)},
        {"descriptors": np.zeros((5, 64), np.uint8)},
        {"descriptors": np.full((5, 128), -1)},
    ],
)
def test_observations_refuse_ragged_or_lossy_columns(change: dict[str, Any]) -> None:
    assert len(observations()) == 5
    with pytest.raises(InvalidValueError, match="MapObservations"):
        observations(**change)


def test_columns_are_read_only_copies() -> None:
    utm = np.tile([EASTING, NORTHING, HEIGHT], (4, 1))
    held = points(utm=utm)
    utm[:] = 0.0
    assert held.utm[0, 0] == EASTING
    with pytest.raises(ValueError, match="read-only"):
        held.utm[0, 0] = 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"latitude_deg": 90.5}, "latitude"),
        ({"latitude_deg": np.nan}, "latitude"),
        ({"longitude_deg": 200.0}, "longitude"),
        ({"height_m": np.inf}, "height_m"),
        ({"sigma_horizontal_m": 0.0}, "deviations"),
        ({"sigma_vertical_m": np.nan}, "deviations"),
    ],
)
def test_priors_refuse_impossible_values(change: dict[str, float], message: str) -> None:
    good: dict[str, Any] = {
        "latitude_deg": 49.0,
        "longitude_deg": 8.4,
        "height_m": None,
        "sigma_horizontal_m": 3.0,
        "sigma_vertical_m": 7.0,
    }
    assert GeoPrior(**good).height_m is None
    with pytest.raises(InvalidValueError, match=message):
        GeoPrior(**(good | change))


BAD_COVARIANCES = {
    "not square": np.eye(5),
    "not finite": np.full((7, 7), np.nan),
    "not symmetric": np.eye(7) + np.diag(np.ones(6), 1),
    "negative": np.diag([1.0, 1, 1, 1, 1, 1, -0.1]),
    "correlation above one": np.eye(7) + 1.5 * (np.eye(7)[::-1] - np.diag(np.eye(7)[::-1].diagonal())),
}


@pytest.mark.parametrize("name", BAD_COVARIANCES)
def test_covariances_that_are_none_are_refused(name: str) -> None:
    good: dict[str, Any] = {"method": "gps", "local_from_sfm": Sim3.identity(), "residual_rms_m": 0.5}
    Placement(**good, covariance=np.diag([1e-10, 1e-8, 1e-8, 1e-8, 1.0, 1.0, 4.0]))
    with pytest.raises(InvalidValueError, match=r"Placement\.covariance"):
        Placement(**good, covariance=BAD_COVARIANCES[name])
    image: dict[str, Any] = {"image_id": 0, "name": "a.jpg", "sha256": "", "camera_id": 0}
    image["cam_from_local"] = Rigid3.identity()
    MapImage(**image, covariance=np.zeros((6, 6)))
    with pytest.raises(InvalidValueError, match=r"MapImage\.covariance"):
        MapImage(**image, covariance=BAD_COVARIANCES[name][1:, 1:])


@pytest.mark.parametrize(
    "change", [{"method": "guess"}, {"residual_rms_m": -1.0}, {"residual_rms_m": np.nan}]
)
def test_placements_refuse_impossible_values(feature_map: FeatureMap, change: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match="Placement"):
        replace(feature_map.placement, **change)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"map_id": ""}, InvalidValueError, "map_id"),
        ({"epsg": 4326}, GeodesyError, "WGS84 UTM zone"),
        ({"epsg": 25832}, GeodesyError, "WGS84 UTM zone"),
        ({"height_datum": "sea level"}, InvalidValueError, "height datum"),
        ({"status": "deleted"}, InvalidValueError, "status"),
        ({"camera_keys": ("one",)}, InvalidValueError, "camera keys"),
        ({"cameras": ()}, InvalidValueError, "camera"),
        ({"images": ()}, InvalidValueError, "image that the map does not have"),
        ({"points": points(0)}, InvalidValueError, "point that the map does not have"),
        (
            {"observations": observations(point_index=np.full(5, -1))},
            InvalidValueError,
            "point that the map does not have",
        ),
        (
            {"observations": observations(image_id=np.full(5, 77))},
            InvalidValueError,
            "image that the map does not have",
        ),
    ],
)
def test_maps_refuse_parts_that_contradict_each_other(
    feature_map: FeatureMap, change: dict[str, Any], error: type[FeatureDbError], message: str
) -> None:
    with pytest.raises(error, match=message):
        replace(feature_map, **change)


def test_image_ids_are_unique_and_cameras_exist(feature_map: FeatureMap) -> None:
    first, *others = feature_map.images
    with pytest.raises(InvalidValueError, match="repeat"):
        replace(feature_map, images=(first, first, *others))
    for camera_id in (-1, 2):
        with pytest.raises(InvalidValueError, match="camera that the map does not have"):
            replace(feature_map, images=(replace(first, camera_id=camera_id), *others))


def test_empty_map_is_allowed(feature_map: FeatureMap) -> None:
    empty = replace(feature_map, images=(), points=points(0), observations=observations(0))
    assert empty.points_local().shape == (0, 3)


def test_points_come_into_any_frame(feature_map: FeatureMap) -> None:
    # Independent: geodetic coordinates of the stored points, straight into the frame.
    geodetic = geodetic_from_utm(feature_map.points.utm, EPSG)
    own = feature_map.points_local()
    np.testing.assert_allclose(own, feature_map.frame.enu_from_geodetic(geodetic), rtol=0, atol=1e-7)
    assert np.abs(own).max() < 400.0
    elsewhere = LocalFrame.from_utm(EASTING + 3000.0, NORTHING, HEIGHT, EPSG)
    moved = feature_map.points_local(elsewhere)
    np.testing.assert_allclose(moved, elsewhere.enu_from(feature_map.frame).act(own), rtol=0, atol=1e-7)
    assert moved[:, 0].mean() == pytest.approx(own[:, 0].mean() - 3000.0, abs=5.0)


def test_status_changes_by_a_new_value(feature_map: FeatureMap) -> None:
    retired = feature_map.with_status("retired")
    assert (retired.status, feature_map.status) == ("retired", "active")
    assert retired.points is feature_map.points


def features(**change: Any) -> Features:
    rng = np.random.default_rng(0)
    values: dict[str, Any] = {
        "xy": rng.uniform(0, 100, (6, 2)).astype(np.float32),
        "scale": np.ones(6, np.float32),
        "angle": np.zeros(6, np.float32),
        "response": np.arange(6, dtype=np.float32),
        "descriptors": rng.integers(0, 256, (6, 128), dtype=np.uint8),
        "width": 100,
        "height": 100,
        "fingerprint": "rootsift-test",
    }
    return Features(**(values | change))


def test_features_take_rows_in_order() -> None:
    some = features()
    taken = some.take(np.array([4, 1]))
    assert len(taken) == 2
    np.testing.assert_array_equal(taken.response, [4, 1])
    np.testing.assert_array_equal(taken.descriptors, some.descriptors[[4, 1]])
    np.testing.assert_array_equal(some.take(some.response > 3).xy, some.xy[4:])
    assert (taken.width, taken.height, taken.fingerprint) == (100, 100, "rootsift-test")


@pytest.mark.parametrize(
    "change",
    [
        {"xy": np.zeros((5, 2))},
        {"xy": np.full((6, 2), np.nan)},
        {"descriptors": np.zeros((6, 64), np.uint8)},
        {"descriptors": np.full((6, 128), 0.5)},
        {"width": 0},
        {"height": -3},
    ],
)
def test_features_refuse_bad_columns(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match="Features"):
        features(**change)
