"""The parts of a dataset: geometries, areas, covariances on Earth, names, checksums."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pyproj
import pytest
import scipy.spatial.transform as sst

from featuredb.errors import ExportError, GeodesyError, InvalidValueError, StoreError
from featuredb.export.dataset import columns, layout
from featuredb.export.dataset.contents import Contents, Footprint, entry_of, footprint_of
from featuredb.export.dataset.geoparquet import point_columns, wkb_of
from featuredb.export.dataset.layout import check_sums, write_sums
from featuredb.export.shots import pose_covariance
from featuredb.geo.crs.wkt import utm_projjson
from featuredb.geo.heights import HEIGHT_DATUMS
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import geodetic_from_utm
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapMethod
from featuredb.store import Database
from featuredb.store.tables import POINT_COVARIANCE
from tests.support.datasets import map_at
from tests.support.maps import random_map


@pytest.mark.parametrize(
    ("datum", "crs"),
    [
        ("unknown", "EPSG:32755"),
        ("egm96", "EPSG:32755+5773"),
        ("egm2008", "EPSG:32755+3855"),
        ("navd88", "EPSG:32755+5703"),
    ],
)
def test_projjson_is_the_crs(datum: str, crs: str) -> None:
    assert pyproj.CRS.from_json_dict(utm_projjson(32755, datum)) == pyproj.CRS(crs)


def test_projjson_of_ellipsoidal_heights_has_three_axes() -> None:
    found = pyproj.CRS.from_json_dict(utm_projjson(32632, "ellipsoidal"))
    assert found == pyproj.CRS("EPSG:32632").to_3d()
    assert found != pyproj.CRS("EPSG:32632")
    with pytest.raises(GeodesyError):
        utm_projjson(25832, "egm96")
    with pytest.raises(InvalidValueError):
        utm_projjson(32632, "sea level")


def test_wkb_is_what_shapely_writes() -> None:
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1e7, 1e7, (50, 3))
    geometry, bbox = point_columns(xyz)
    points = shapely.points(xyz)
    assert geometry.to_pylist() == list(shapely.to_wkb(points, flavor="iso", byte_order=1))
    for name, axis, below in (("xmin", 0, True), ("ymin", 1, True), ("xmax", 0, False), ("ymax", 1, False)):
        edge = bbox.field(name).to_numpy().astype(np.float64)
        assert ((edge <= xyz[:, axis]) if below else (edge >= xyz[:, axis])).all()
        assert np.abs(edge - xyz[:, axis]).max() <= 1.0
    ring = [[0.0, 0.0], [2.0, 0.0], [1.0, 1.5], [0.0, 0.0]]
    for document in (
        {"type": "Point", "coordinates": [8.4, 49.0]},
        {"type": "Polygon", "coordinates": [ring]},
        {"type": "MultiPolygon", "coordinates": [[ring], [ring]]},
    ):
        expected = shapely.geometry.shape(document)
        assert wkb_of(document) == shapely.to_wkb(expected, flavor="iso", byte_order=1)


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(49.0, 8.4), (-33.9, 18.4), (-17.0, 179.9995), (65.0, -180.0)]
)
def test_a_footprint_holds_every_point_and_camera(latitude: float, longitude: float) -> None:
    shapely = pytest.importorskip("shapely")
    feature_map = map_at(3, latitude, longitude, "unknown")
    footprint = footprint_of(feature_map)
    area = shapely.geometry.shape(footprint.geometry).buffer(1e-9)
    lat_lon = geodetic_from_utm(feature_map.points.utm, feature_map.epsg)
    cameras = np.array([i.cam_from_local.center for i in feature_map.images])
    for lat, lon, _ in [*lat_lon, *feature_map.frame.geodetic_from_enu(cameras)]:
        assert area.covers(shapely.Point(lon, lat))
    west, south, east, north = footprint.bbox
    crosses = abs(longitude) > 179
    assert (footprint.geometry["type"] == "MultiPolygon") is crosses
    assert (west > east) is crosses
    assert south < latitude < north


def test_a_footprint_of_little_is_a_box_or_a_point() -> None:
    empty = map_at(1, 49.0, 8.4, "unknown", points=0, images=0)
    found = footprint_of(empty)
    assert found.geometry["type"] == "Point"
    assert found.geometry["coordinates"] == pytest.approx([8.4, 49.0])
    two = map_at(1, 49.0, 8.4, "unknown", points=2, images=0)
    assert footprint_of(two).geometry["type"] == "Polygon"


def contents_of(*boxes: tuple[float, float, float, float]) -> Contents:
    feature_map = random_map(1)
    entry = entry_of(feature_map, {"map_id": "a"})
    return Contents(
        maps=[
            replace(entry, footprint=Footprint(geometry=entry.footprint.geometry, bbox=box)) for box in boxes
        ]
    )


@pytest.mark.parametrize(
    ("longitudes", "expected"),
    [
        ([(1, 2), (5, 6)], (1, 6)),
        ([(-5, -4), (5, 6)], (-5, 6)),
        ([(170, 171), (-171, -170)], (170, -170)),
        ([(179, -179), (-178, -177)], (179, -177)),
        ([(179, -170), (-178, -177)], (179, -170)),
        ([(-60, 60), (60, 180), (-180, -60)], (-180, 180)),
        ([(179, -179)], (179, -179)),
    ],
)
def test_the_box_of_all_is_the_narrowest(
    longitudes: list[tuple[float, float]], expected: tuple[float, float]
) -> None:
    found = contents_of(*((w, -1.0, e, 1.0) for w, e in longitudes)).bbox()
    assert found == (expected[0], -1.0, expected[1], 1.0)


def test_covariance_on_earth_is_that_of_many_drawn_poses() -> None:
    """Poses drawn from their own covariance, and whole maps moved by draws of the placement's."""
    feature_map = map_at(2, -33.92, 18.42, "unknown")
    image = replace(
        feature_map.images[0],
        cam_from_local=Rigid3.exp([0.3, -1.0, 0.5, 40.0, -20.0, 10.0]),
        covariance=np.diag([4e-6, 1e-6, 9e-6, 1e-4, 4e-4, 9e-4]),
    )
    placement = replace(
        feature_map.placement, covariance=np.diag([1e-8, 2e-6, 1e-6, 4e-6, 2.5e-3, 1e-2, 4e-2]), evidence={}
    )
    feature_map = replace(feature_map, placement=placement, images=(image, *feature_map.images[1:]))
    pose, rng = image.cam_from_local, np.random.default_rng(0)
    true_from_local = feature_map.frame.true_enu_from_enu(pose.center)
    drawn = []
    for _ in range(6000):
        own = Rigid3.exp(rng.normal(size=6) * np.sqrt(np.diag(image.covariance)))
        moved = Sim3.exp(rng.normal(size=7) * np.sqrt(np.diag(placement.covariance)))
        there = own @ pose
        local_from_cam = moved.rotation @ there.rotation.T
        turn = sst.Rotation.from_matrix(local_from_cam @ pose.rotation).as_rotvec()
        centre = moved.act(there.center)
        drawn.append([*true_from_local @ turn, *true_from_local @ (centre - pose.center)])
    expected = np.cov(np.array(drawn).T)
    sigma = np.sqrt(np.diag(expected))
    found = pose_covariance(feature_map, image)
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.06)
    alone = pose_covariance(feature_map, replace(image, covariance=None))
    assert (np.diag(alone) < np.diag(found)).all()


def test_names_of_files_are_safe_and_different() -> None:
    assert layout.file_name("map-1_b") == "map-1_b"
    names = ["../../etc/passwd", "a/b", "a_b", "a b", "", ".", "x" * 300, "ä", "x.txt", "Map", "map"]
    made = [layout.file_name(name) for name in names]
    assert len({name.lower() for name in made}) == len(made)
    assert all(
        name and set(name) <= set("_-") | set(map(chr, range(48, 123))) and len(name) < 100 for name in made
    )
    assert not any("/" in name or "." in name for name in made)


def test_checksums_find_each_damage(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a/b").write_bytes(b"one")
    (tmp_path / "c d").write_bytes(b"two")
    write_sums(tmp_path)
    assert check_sums(tmp_path) == {"a/b", "c d"}
    (tmp_path / "new").write_bytes(b"of somebody else's")
    assert check_sums(tmp_path) == {"a/b", "c d"}
    (tmp_path / "c d").write_bytes(b"tw0")
    with pytest.raises(ExportError, match="c d: the content is not"):
        check_sums(tmp_path)
    (tmp_path / "c d").unlink()
    with pytest.raises(ExportError, match="c d: SHA256SUMS lists this file, and it is missing"):
        check_sums(tmp_path)


def test_every_column_is_explained() -> None:
    for table in (columns.MAPS, columns.CAMERAS, columns.IMAGES, columns.POINTS, columns.OBSERVATIONS):
        meaning = table.meaning()
        assert table.schema.names == list(meaning)
        assert all(meaning.values())
        assert set(table.words) <= set(meaning)
        assert set(table.repeating) <= set(table.schema.names)


def test_columns_are_explained_as_a_dataset_has_them() -> None:
    maps, points = columns.MAPS.meaning(), columns.POINTS.meaning()
    assert "unplaced" not in maps["status"]
    assert "hex" not in columns.OBSERVATIONS.meaning()["descriptor"]
    assert all(datum in maps["height_datum"] for datum in HEIGHT_DATUMS)
    assert all(method in maps["method"] for method in get_args(MapMethod))
    assert all("local frame" in points[name] for name in POINT_COVARIANCE)


def test_a_status_may_come_with_its_reason(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "db")
    retired: FeatureMap = random_map(1).with_status("retired")
    with pytest.raises(StoreError, match="found a retired one"):
        database.commit_maps([retired])
    with pytest.raises(StoreError, match="found a retired one"):
        database.commit_maps([retired], reasons={"map-1": ""})
    database.commit_maps(
        [retired, random_map(2).with_status("quarantined"), random_map(3)],
        reasons={"map-1": "too old", "map-2": "one owner"},
    )
    found = {m.map_id: (m.status, m.status_reason) for m in database.snapshot().maps(include_retired=True)}
    assert found == {
        "map-1": ("retired", "too old"),
        "map-2": ("quarantined", "one owner"),
        "map-3": ("active", ""),
    }


def test_frames_and_zones_agree() -> None:
    """What the tests' maps are made by: the origin of a map's frame lies in its zone."""
    feature_map = map_at(1, -33.92, 18.42, "egm96")
    assert feature_map.epsg == 32734
    easting, northing = pyproj.Proj(32734)(18.42, -33.92)
    assert LocalFrame.from_utm(easting, northing, 100.0, 32734).latitude_deg == pytest.approx(-33.92)
