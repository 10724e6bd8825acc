"""Scans beside the maps of a dataset: the right tiles, every point of them, in the same order always."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyproj
import pytest

from featuredb.errors import MissingExtraError
from featuredb.export.dataset import lidar_part as tile_files
from featuredb.export.dataset.contents import entry_of
from featuredb.export.dataset.lidar_part import touched_tiles
from featuredb.export.selection import Selection
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.tiles import tile_of
from featuredb.lidar.add import AddOptions, add_scan
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.encode import encode_map
from featuredb.store.maintenance import compact
from featuredb.store.scans import find_scan, list_scans, retire_scan, scan_batches, scan_points
from featuredb.store.verify import verify
from tests.support.datasets import export, files_of
from tests.support.las_files import SOUTH, WEST, grid_points, write_scan
from tests.support.maps import random_map

KEPT = AddOptions(outliers=None, height_datum="egm2008")


def map_there(seed: int, east: float = 300.0, north: float = 300.0, epsg: int = 32632) -> FeatureMap:
    """A map 200 m wide around a place in the scan's zone; it may itself be in another zone."""
    base = random_map(seed, extent_m=200.0)
    frame = LocalFrame.from_utm(WEST + east, SOUTH + north, 100.0, 32632)
    utm = frame.utm_from_enu(base.points_local(), epsg)
    return replace(base, epsg=epsg, frame=frame, points=replace(base.points, utm=utm))


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    folder = tmp_path_factory.mktemp("scanned")
    database = Database.create(folder / "maps.db")
    database.commit_map(map_there(1))
    xyz = grid_points(40_000, spacing=6.0)  # 1.2 km wide
    rng = np.random.default_rng(0)
    colours = {name: rng.integers(1, 256, len(xyz)) * 257 for name in ("red", "green", "blue")}
    path = write_scan(
        folder / "near.laz",
        xyz,
        intensity=rng.integers(1, 4000, len(xyz)),
        classification=np.full(len(xyz), 2),
        **colours,
    )
    add_scan(database, [path], KEPT, name="near", licence="CC-BY-4.0", source="test")
    far = write_scan(folder / "far.laz", grid_points(2000) + np.array([20_000.0, 0.0, 0.0]))
    add_scan(database, [far], KEPT, name="far", licence="CC0-1.0", source="test")
    return database


def scans_of(folder: Path) -> list[dict]:  # type: ignore[type-arg]
    found: list[dict] = json.loads((folder / "lidar/scans.json").read_text())["scans"]  # type: ignore[type-arg]
    return found


def test_the_tiles_that_the_maps_touch_have_all_their_points(database: Database, tmp_path: Path) -> None:
    export(database, tmp_path / "out", Selection(), with_lidar=True)
    (known,) = scans_of(tmp_path / "out")
    assert (known["name"], known["licence"]) == ("near", "CC-BY-4.0")
    assert "write_id" not in known
    utm = database.snapshot().load_map("map-1").points.utm
    (e0, n0), (e1, n1) = utm[:, :2].min(axis=0), utm[:, :2].max(axis=0)
    touched = set(tile_of([(e, n) for e in (e0, e1) for n in (n0, n1)]))
    assert {t["tile"] for t in known["tiles"]} == touched
    assert 1 <= len(touched) < len(find_scan(database, known["scan_id"]).row["tiles"])
    columns = ("easting", "northing", "height", "red", "green", "blue", "intensity", "classification", "tile")
    stored = [
        row
        for batch in scan_batches(database, find_scan(database, known["scan_id"]), columns)
        for row in zip(*(batch.column(name).to_pylist() for name in columns), strict=True)
    ]
    for tile in known["tiles"]:
        las = laspy.read(tmp_path / "out" / tile["file"])
        expected = np.array(sorted(row[:-1] for row in stored if row[-1] == tile["tile"]))
        assert len(las) == tile["points"] == len(expected)
        found = np.column_stack(
            [
                las.x,
                las.y,
                las.z,
                *(np.asarray(las[c]) // 257 for c in ("red", "green", "blue", "intensity")),
                las.classification,
            ]
        )
        found = found[np.lexsort(found[:, 2::-1].T)]
        np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=0.0005001)
        np.testing.assert_array_equal(found[:, 3:], expected[:, 3:])
        assert pyproj.CRS(las.header.parse_crs()) == pyproj.CRS("EPSG:32632+3855")


def test_tiles_are_in_the_checksums_and_the_catalogue(database: Database, tmp_path: Path) -> None:
    export(database, tmp_path / "out", Selection(), with_lidar=True)
    (known,) = scans_of(tmp_path / "out")
    sums = (tmp_path / "out/SHA256SUMS").read_text()
    assets = json.loads((tmp_path / "out/stac/collection.json").read_text())["assets"]
    for tile in known["tiles"]:
        assert tile["file"] in sums
        assert assets[tile["file"]]["href"] == f"../{tile['file']}"


def test_the_same_bytes_whatever_the_storage(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Again; in small pieces, whose points must neither double nor vanish; after compaction, in any order."""
    export(database, tmp_path / "a", Selection(), with_lidar=True)
    export(database, tmp_path / "b", Selection(), with_lidar=True)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    with monkeypatch.context() as patch:
        patch.setattr(tile_files, "_LARGEST_PIECE", 500)
        export(database, tmp_path / "c", Selection(), with_lidar=True)
    (a,), (c,) = scans_of(tmp_path / "a"), scans_of(tmp_path / "c")
    assert a["tiles"] == c["tiles"]
    for tile in a["tiles"]:
        one, other = (laspy.read(tmp_path / name / tile["file"]) for name in ("a", "c"))
        assert sorted(zip(one.X, one.Y, one.Z, strict=True)) == sorted(
            zip(other.X, other.Y, other.Z, strict=True)
        )
    compact(database)

    def shuffled(*where: Any) -> pa.Table:
        rows = scan_points(*where)
        return rows.take(np.random.default_rng(0).permutation(len(rows)))

    monkeypatch.setattr(tile_files, "scan_points", shuffled)
    export(database, tmp_path / "d", Selection(), with_lidar=True)
    tiles = [t["file"] for t in a["tiles"]]
    for name in tiles:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "d" / name).read_bytes()


def test_a_map_of_the_next_zone_touches_the_same_tiles(database: Database) -> None:
    scan = next(s for s in list_scans(database) if s.name == "near")
    tiles = []
    for epsg in (32632, 32633):
        feature_map = map_there(1, epsg=epsg)
        row = encode_map(feature_map, "", scan.created_at).row
        tiles.append(touched_tiles(scan, [entry_of(feature_map, row)]))
    assert tiles[0] <= tiles[1]
    assert len(tiles[1]) <= len(tiles[0]) + 2  # the box of a turned box is a little larger


def test_scans_need_the_licence_too_and_not_be_retired(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "db")
    database.commit_map(map_there(1))
    path = write_scan(tmp_path / "a.laz", grid_points(3000, spacing=10.0))
    scan = add_scan(database, [path], KEPT, name="a", licence="proprietary", source="test").scan
    export(database, tmp_path / "part", Selection(licences=("cc-by",)), with_lidar=True)
    assert not (tmp_path / "part/lidar").exists()
    assert b"proprietary" not in b"".join(files_of(tmp_path / "part").values())
    export(database, tmp_path / "whole", Selection(), with_lidar=True)
    assert len(scans_of(tmp_path / "whole")) == 1
    export(database, tmp_path / "without", Selection())
    assert not (tmp_path / "without/lidar").exists()
    retire_scan(database, scan.scan_id, "replaced")
    export(database, tmp_path / "retired", Selection(), with_lidar=True)
    assert not (tmp_path / "retired/lidar").exists()


def test_tiles_can_be_added_as_a_scan_again(database: Database, tmp_path: Path) -> None:
    export(database, tmp_path / "out", Selection(), with_lidar=True)
    (known,) = scans_of(tmp_path / "out")
    target = Database.create(tmp_path / "target.db")
    files = [tmp_path / "out" / t["file"] for t in known["tiles"]]
    scan = add_scan(target, files, AddOptions(outliers=None), name="again", licence="", source="").scan
    assert scan.points == sum(t["points"] for t in known["tiles"])
    assert (scan.epsg, scan.height_datum, scan.colour) == (32632, "egm2008", "file")
    assert verify(target).ok


@pytest.mark.parametrize("package", ["laspy", "lazrs"])
def test_a_missing_package_is_named_before_anything_is_written(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"{package}.*featuredb\[lidar\]"):
        export(database, tmp_path / "out", Selection(), with_lidar=True)
    assert list(tmp_path.iterdir()) == []
