"""What others read in a dataset: GeoParquet by DuckDB, pyarrow and geopandas, STAC by its schemas."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import pyproj
import pytest
from referencing import Registry, Resource

from featuredb.export.dataset.contents import footprint_of
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.store import Database
from tests.support.datasets import export, varied_database, varied_maps

duckdb = pytest.importorskip("duckdb")

CRS = {
    "32612-navd88": "EPSG:32612+5703",
    "32632-egm2008": "EPSG:32632+3855",
    "32632-unknown": "EPSG:32632",
    "32734-egm96": "EPSG:32734+5773",
}


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    return varied_database(tmp_path_factory.mktemp("varied") / "maps.db")


@pytest.fixture(scope="module")
def folder(database: Database, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "out"
    export(database, out)
    return out


def geo_of(path: Path) -> dict[str, Any]:
    geo: dict[str, Any] = json.loads(pq.read_schema(path).metadata[b"geo"])
    return geo


def geo_files(folder: Path) -> list[Path]:
    return [folder / "maps.parquet", *sorted(folder.glob("points/*")), *sorted(folder.glob("images/*"))]


def test_every_geo_file_has_the_metadata_of_geoparquet(folder: Path) -> None:
    """The rules of the 1.1 specification, and PROJ's own schema for the CRS."""
    schema = json.loads((Path(pyproj.datadir.get_data_dir()) / "projjson.schema.json").read_text())
    for path in geo_files(folder):
        geo = geo_of(path)
        assert set(geo) == {"version", "primary_column", "columns"}
        assert geo["version"] == "1.1.0"
        column = geo["columns"][geo["primary_column"]]
        assert column["encoding"] == "WKB"
        corners = ("xmin", "ymin", "xmax", "ymax")
        assert column["covering"] == {"bbox": {name: ["bbox", name] for name in corners}}
        arrow = pq.read_schema(path)
        assert [f.name for f in arrow.field("bbox").type] == list(corners)
        assert pq.ParquetFile(path).schema.column(arrow.get_field_index("geometry")) is not None
        if path.name == "maps.parquet":
            assert "crs" not in column  # OGC:CRS84, by the specification
            assert set(column["geometry_types"]) <= {"Point", "Polygon", "MultiPolygon"}
        else:
            jsonschema.Draft7Validator(schema).validate(column["crs"])
            assert column["geometry_types"] == ["Point Z"]
            assert len(column["bbox"]) == 6


def test_the_crs_is_zone_and_height_datum(folder: Path) -> None:
    for name, definition in CRS.items():
        for table in ("points", "images"):
            found = pyproj.CRS(geo_of(folder / table / f"{name}-0000.parquet")["columns"]["geometry"]["crs"])
            assert found == pyproj.CRS(definition), name
    three = pyproj.CRS(geo_of(folder / "points/32760-ellipsoidal-0000.parquet")["columns"]["geometry"]["crs"])
    assert three == pyproj.CRS("EPSG:32760").to_3d()
    assert [axis.direction for axis in three.axis_info] == ["east", "north", "up"]


def test_duckdb_reads_all_of_it(database: Database, folder: Path) -> None:
    connection = duckdb.connect(config={"autoinstall_known_extensions": False})
    snapshot = database.snapshot()
    for table in ("points", "images", "observations"):
        rows = connection.sql(
            f"SELECT map_id, count(*) FROM '{folder}/{table}/*.parquet' GROUP BY 1"
        ).fetchall()
        expected = {m.map_id: getattr(m, table) for m in snapshot.maps(include_retired=True)}
        assert dict(rows) == {name: count for name, count in expected.items() if count}
    rows = connection.sql(f"SELECT map_id, points, status FROM '{folder}/maps.parquet'").fetchall()
    assert rows == [(m.map_id, m.points, m.status) for m in snapshot.maps(include_retired=True)]
    ((key,),) = connection.sql(
        f"SELECT value FROM parquet_kv_metadata('{folder}/points/32734-egm96-0000.parquet') WHERE key = 'geo'"
    ).fetchall()
    assert json.loads(key)["columns"]["geometry"]["crs"]["name"] == "WGS 84 / UTM zone 34S + EGM96 height"


def test_duckdb_finds_points_by_their_boxes(database: Database, folder: Path) -> None:
    """A box in plan finds, by the bbox column alone, what the coordinates say, and few others."""
    utm = database.snapshot().load_map("crater").points.utm
    (e0, n0), (e1, n1) = np.quantile(utm[:, :2], (0.2, 0.6), axis=0).tolist()
    inside = (utm[:, 0] >= e0) & (utm[:, 0] <= e1) & (utm[:, 1] >= n0) & (utm[:, 1] <= n1)
    connection = duckdb.connect(config={"autoinstall_known_extensions": False})
    rows = connection.sql(
        f"""SELECT point_index, easting, northing, height FROM '{folder}/points/32612-*.parquet'
        WHERE bbox.xmax >= {e0!r} AND bbox.xmin <= {e1!r} AND bbox.ymax >= {n0!r} AND bbox.ymin <= {n1!r}"""
    ).fetchall()
    found = {row[0]: row[1:] for row in rows}
    assert set(np.flatnonzero(inside)) <= set(found)
    assert 20 < len(found) <= inside.sum() + 5
    for index, coordinates in found.items():
        assert coordinates == tuple(utm[index])


def test_bbox_columns_hold_their_geometries(folder: Path) -> None:
    for path in [p for p in geo_files(folder) if p.name != "maps.parquet"]:
        table = pq.read_table(path)
        box = {
            name: table["bbox"].combine_chunks().field(name).to_numpy()
            for name in ("xmin", "ymin", "xmax", "ymax")
        }
        east, north = table["easting"].to_numpy(), table["northing"].to_numpy()
        assert (box["xmin"] <= east).all()
        assert (east <= box["xmax"]).all()
        assert (box["ymin"] <= north).all()
        assert (north <= box["ymax"]).all()
        assert (box["ymax"] - box["ymin"]).max() <= 1.0  # single precision at ten million metres
        whole = geo_of(path)["columns"]["geometry"]["bbox"]
        height = table["height"].to_numpy()
        assert whole == [east.min(), north.min(), height.min(), east.max(), north.max(), height.max()]


def test_a_row_group_has_rows_of_one_map(database: Database, folder: Path) -> None:
    for path in [*folder.glob("points/*"), *folder.glob("observations/*")]:
        file = pq.ParquetFile(path)
        groups = [set(file.read_row_group(k)["map_id"].to_pylist()) for k in range(file.num_row_groups)]
        assert all(len(group) == 1 for group in groups)
    assert (
        len(pq.ParquetFile(folder / "points/32632-unknown-0000.parquet").read(["map_id"])["map_id"].unique())
        == 4
    )


def test_geopandas_reads_coordinates_and_crs(database: Database, folder: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    snapshot = database.snapshot()
    for name, map_id in (
        ("32734-egm96", "cape-town"),
        ("32760-ellipsoidal", "fiji"),
        ("32612-navd88", "crater"),
    ):
        frame = geopandas.read_parquet(folder / "points" / f"{name}-0000.parquet")
        utm = snapshot.load_map(map_id).points.utm
        assert frame.crs == (pyproj.CRS(CRS[name]) if name in CRS else pyproj.CRS("EPSG:32760").to_3d())
        assert frame.geometry.has_z.all()
        xyz = np.stack([frame.geometry.x, frame.geometry.y, frame.geometry.z], axis=1)
        np.testing.assert_array_equal(xyz, utm)
    images = geopandas.read_parquet(folder / "images/32734-egm96-0000.parquet")
    cape = snapshot.load_map("cape-town")
    centres = cape.frame.utm_from_enu(np.array([i.cam_from_local.center for i in cape.images]), cape.epsg)
    np.testing.assert_allclose(
        np.stack([images.geometry.x, images.geometry.y], axis=1), centres[:, :2], atol=1e-6
    )


def test_geopandas_reads_the_maps_areas(folder: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    maps = geopandas.read_parquet(folder / "maps.parquet").set_index("map_id")
    assert maps.crs == "OGC:CRS84"
    assert maps.geometry.is_valid.all()
    assert Counter(maps.geom_type) == {"Polygon": 8, "MultiPolygon": 1, "Point": 1}
    for feature_map in varied_maps():
        west, south, east, north = footprint_of(feature_map).bbox
        bounds = maps.geometry[feature_map.map_id].bounds
        if feature_map.map_id == "fiji":
            assert west > 179.99
            assert east < -179.99
            assert bounds == (-180.0, south, 180.0, north)
        else:
            assert bounds == (west, south, east, north)
    here = geopandas.read_parquet(folder / "maps.parquet", bbox=(18.0, -34.0, 19.0, -33.0))
    assert list(here["map_id"]) == ["cape-town"]
    there = geopandas.read_parquet(folder / "maps.parquet", bbox=(-180.0, -17.1, -179.999, -16.9))
    assert list(there["map_id"]) == ["fiji"]
    whole = geo_of(folder / "maps.parquet")["columns"]["geometry"]["bbox"]
    assert whole == pytest.approx(list(maps.total_bounds))


def test_poses_on_earth_say_the_same_in_every_way(database: Database, folder: Path) -> None:
    """Grid quaternion, GeoPose and local pose of each image look along one axis, by three routes."""
    rows = {
        (r["map_id"], r["image_id"]): r for p in folder.glob("images/*") for r in pq.read_table(p).to_pylist()
    }
    snapshot = database.snapshot()
    for map_id in ("cape-town", "fiji", "crater"):
        feature_map = snapshot.load_map(map_id)
        zone = pyproj.Proj(feature_map.epsg)
        for image in feature_map.images:
            row = rows[map_id, image.image_id]
            geopose = geopose_from_camera(image.cam_from_local, feature_map.frame)
            assert row["geopose_xyzw"] == pytest.approx(geopose.quaternion_xyzw)
            assert [row["yaw_deg"], row["pitch_deg"], row["roll_deg"]] == pytest.approx(
                geopose.yaw_pitch_roll_deg
            )
            easting, northing = zone(row["longitude_deg"], row["latitude_deg"])
            assert [row["easting"], row["northing"]] == pytest.approx([easting, northing], abs=1e-6)
            forward_grid = matrix_from_quaternion(row["cam_from_utm_xyzw"]).T @ [0, 0, 1]
            forward_true = matrix_from_quaternion(row["geopose_xyzw"]) @ [1, 0, 0]
            convergence = np.radians(
                zone.get_factors(row["longitude_deg"], row["latitude_deg"]).meridian_convergence
            )
            turned = [
                np.cos(convergence) * forward_true[0] - np.sin(convergence) * forward_true[1],
                np.sin(convergence) * forward_true[0] + np.cos(convergence) * forward_true[1],
                forward_true[2],
            ]
            assert forward_grid == pytest.approx(turned, abs=1e-9)


def stac_validators() -> dict[str, Any]:
    """The schemas of STAC 1.0.0 that pystac has beside it: nothing is fetched."""
    from pystac.validation.local_validator import get_local_schema_cache

    cache = get_local_schema_cache()
    registry = Registry().with_resources((uri, Resource.from_contents(s)) for uri, s in cache.items())
    base = "https://schemas.stacspec.org/v1.0.0/{0}-spec/json-schema/{0}.json"
    return {
        kind: jsonschema.Draft7Validator(cache[base.format(name)], registry=registry)
        for kind, name in (("Feature", "item"), ("Collection", "collection"))
    }


def test_the_catalogue_follows_the_schemas(folder: Path) -> None:
    validators = stac_validators()
    files = [folder / "stac/collection.json", *(folder / "stac/items").iterdir()]
    assert len(files) == 11
    for path in files:
        document = json.loads(path.read_text())
        assert document["stac_version"] == "1.0.0"
        validator = validators[document["type"]]
        assert list(validator.iter_errors(document)) == []
        del document["links"]
        assert not validator.is_valid(document)


def test_the_catalogue_leads_to_every_map_and_file(database: Database, folder: Path) -> None:
    import pystac

    collection = pystac.Collection.from_file(str(folder / "stac/collection.json"))
    items = {item.id: item for item in collection.get_items()}
    snapshot = database.snapshot()
    assert set(items) == {m.map_id for m in snapshot.maps(include_retired=True)}
    for item in items.values():
        assert item.get_collection() is collection
        for asset in item.assets.values():
            path = Path(asset.get_absolute_href() or "")
            assert path.is_file()
            assert item.id in pq.read_table(path, columns=["map_id"])["map_id"].to_pylist()
    assert {Path(a.get_absolute_href() or "").resolve() for a in collection.assets.values()} == {
        folder / name for name in ("maps.parquet", "cameras.parquet", "attribution.csv", "README.md")
    }


def test_items_say_where_and_when(database: Database, folder: Path) -> None:
    schema = json.loads((Path(pyproj.datadir.get_data_dir()) / "projjson.schema.json").read_text())
    for feature_map in varied_maps():
        path = next(
            p
            for p in (folder / "stac/items").iterdir()
            if json.loads(p.read_text())["id"] == feature_map.map_id
        )
        item = json.loads(path.read_text())
        properties = item["properties"]
        assert item["stac_extensions"] == ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"]
        assert properties["proj:epsg"] == feature_map.epsg
        jsonschema.Draft7Validator(schema).validate(properties["proj:projjson"])
        times = [i.capture_time for i in feature_map.images if i.capture_time]
        if times:
            assert properties["datetime"] is None
            assert properties["start_datetime"] < properties["end_datetime"]
            assert properties["end_datetime"] == "2024-06-01T10:00:03.123456Z"
        else:
            assert properties["datetime"] == properties["created"]
        if len(feature_map.points):
            low, high = feature_map.points.utm.min(axis=0), feature_map.points.utm.max(axis=0)
            assert properties["proj:bbox"] == [low[0], low[1], high[0], high[1]]
    collection = json.loads((folder / "stac/collection.json").read_text())
    # The narrowest way around: from Fiji, which lies on the antimeridian, over the crater to the Cape.
    west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
    assert 179.9 < west < 180.0
    assert 18.4 < east < 18.5
    assert (-34.0 < south < -33.9, 49.0 < north < 49.1) == (True, True)
