"""Scans of every kind go into a database and come back; broken ones leave nothing."""

import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from deltalake import DeltaTable
from scipy.spatial import cKDTree

from featuredb.cli.main import main
from featuredb.errors import (
    ScanError,
    ScanNotFoundError,
)
from featuredb.geo.local_frame import LocalFrame
from featuredb.lidar.add import AddOptions, add_scan
from featuredb.lidar.load import chosen_scans, load_cloud, scan_frame
from featuredb.store import Database
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.scans import find_scan, list_scans, retire_scan
from featuredb.store.sql import SqlSession
from featuredb.store.verify import verify
from ingest.register.anchor.start.first_place import scans_of_one_zone
from tests.support.las_files import SOUTH, WEST, grid_points, write_scan
from tests.support.stored_scans import sorted_rows, stored

OPTIONS = AddOptions()


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database(str(tmp_path / "scans.db"))


def folder_state(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    ("version", "point_format", "suffix"),
    [("1.2", 0, ".las"), ("1.2", 3, ".laz"), ("1.3", 1, ".laz"), ("1.4", 6, ".las"), ("1.4", 8, ".laz")],
)
def test_all_versions_come_back_point_for_point(
    database: Database, tmp_path: Path, version: str, point_format: int, suffix: str
) -> None:
    xyz = grid_points()
    xyz[:, 0] -= 10.0  # across the edge between two tiles: 500 000 = 976.56 tiles, so move to one
    xyz[:, 0] += np.ceil(WEST / 512.0) * 512.0 - WEST
    path = write_scan(
        tmp_path / f"scan{suffix}",
        xyz,
        version=version,
        point_format=point_format,
        intensity=np.arange(len(xyz)) % 1000,
        classification=np.where(xyz[:, 2] > 100, 6, 2),
    )
    result = add_scan(database, [path])
    assert result.created
    found = stored(database)
    utm = np.stack([found[name] for name in ("easting", "northing", "height")], axis=1)
    with laspy.open(path) as reader:
        las = reader.read()
        expected = np.stack([las.x, las.y, las.z], axis=1)
    np.testing.assert_allclose(utm, sorted_rows(expected), atol=1e-6)
    assert len(set(found["tile"])) == 2
    assert set(found["zone"]) == {32632}
    assert result.scan.classes == {2: int((xyz[:, 2] <= 100).sum()), 6: int((xyz[:, 2] > 100).sum())}
    assert result.scan.points == result.scan.points_in_files == len(xyz)
    assert sum(result.scan.level_points) == len(xyz)
    assert result.scan.has_intensity
    assert not result.scan.colour  # formats with colours have them all zero here
    assert verify(database).ok
    assert not (Path(database.url) / "_work").exists()


def test_colours_of_8_and_16_bits(database: Database, tmp_path: Path) -> None:
    xyz = grid_points()
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (len(xyz), 3))
    for name, factor in (("narrow", 1), ("wide", 257)):
        moved = xyz + np.array([0.0, 5000.0 * factor, 0.0])
        path = write_scan(
            tmp_path / f"{name}.laz",
            moved,
            red=rgb[:, 0] * factor,
            green=rgb[:, 1] * factor,
            blue=rgb[:, 2] * factor,
        )
        scan = add_scan(database, [path]).scan
        assert scan.colour == "file"
        cloud = load_cloud(database, scan_frame(scan), scan_ids=[scan.scan_id])
        assert cloud.rgb is not None
        assert cloud.intensity is None
        local = scan_frame(scan).enu_from_utm(moved, 32632)
        nearest = np.argmin(np.linalg.norm(cloud.xyz[:200, None] - local[None], axis=2), axis=1)
        np.testing.assert_array_equal(cloud.rgb[:200], rgb[nearest])


def test_without_colour_and_intensity_there_are_places_and_classes(
    database: Database, tmp_path: Path
) -> None:
    xyz = grid_points()
    scan = add_scan(database, [write_scan(tmp_path / "bare.laz", xyz, point_format=6)]).scan
    cloud = load_cloud(database, scan_frame(scan))
    assert cloud.rgb is None
    assert cloud.intensity is None
    assert (cloud.classification == 1).all()  # 0, never classified, is unclassified
    assert len(cloud) == len(xyz)


def test_noise_withheld_and_outliers_are_dropped_and_counted(database: Database, tmp_path: Path) -> None:
    xyz = grid_points()
    classes = np.full(len(xyz), 2)
    classes[:30], classes[30:40] = 7, 18
    withheld = np.zeros(len(xyz), np.uint8)
    withheld[35:60] = 1
    xyz[100, 2] += 50.0
    path = write_scan(tmp_path / "noisy.laz", xyz, classification=classes, withheld=withheld)
    scan = add_scan(database, [path]).scan
    assert (scan.row["dropped_noise"], scan.row["dropped_withheld"], scan.row["dropped_outliers"]) == (
        40,
        20,
        1,
    )
    assert scan.points == len(xyz) - 61
    np.testing.assert_allclose(
        np.sort(stored(database)["easting"]),
        np.sort(np.delete(xyz, [*range(60), 100], axis=0)[:, 0]),
        atol=6e-4,
    )
    kept = add_scan(database, [path], AddOptions(outliers=None)).scan
    assert kept.points == len(xyz) - 60
    everything = write_scan(tmp_path / "only.laz", xyz, classification=np.full(len(xyz), 7))
    with pytest.raises(ScanError, match="3000 are classified as noise"):
        add_scan(database, [everything])
    assert len(list_scans(database)) == 2


def test_adding_twice_changes_nothing(database: Database, tmp_path: Path) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points())
    first = add_scan(database, [path])
    state = folder_state(Path(database.url))
    copy = Path(shutil.copy(path, tmp_path / "another name.laz"))
    for files in ([path], [copy], [path, copy]):
        again = add_scan(database, files)
        assert not again.created
        assert again.scan.scan_id == first.scan.scan_id
    assert folder_state(Path(database.url)) == state
    other = add_scan(database, [path], AddOptions(height_unit="ft"))
    assert other.created
    assert other.scan.scan_id != first.scan.scan_id


def test_files_of_one_survey_become_one_scan(database: Database, tmp_path: Path) -> None:
    xyz = grid_points(4000)
    west = xyz[:, 0] < np.median(xyz[:, 0])
    files = [
        write_scan(tmp_path / "west.laz", xyz[west], red=np.full(west.sum(), 200)),
        write_scan(tmp_path / "east.laz", xyz[~west], point_format=6),
    ]
    result = add_scan(database, files, name="both", licence="CC0", source="test")
    assert result.scan.points == 4000
    assert (result.scan.name, result.scan.licence, result.scan.row["source"]) == ("both", "CC0", "test")
    assert [f["points"] for f in result.scan.row["files"]] == [int(west.sum()), int((~west).sum())]
    assert add_scan(database, files[::-1]).scan.scan_id == result.scan.scan_id
    red = stored(database)["red"]
    assert np.isnan(red).sum() == (~west).sum()  # one file has no colours: null, not black
    assert set(red[~np.isnan(red)]) == {200.0}
    cloud = load_cloud(database, scan_frame(result.scan))
    assert cloud.rgb is not None
    assert (cloud.rgb == 128).all(axis=1).sum() == (~west).sum()
    datums = [files[0], write_scan(tmp_path / "navd.laz", xyz[~west], crs="EPSG:32632+5773")]
    with pytest.raises(ScanError, match="two scans"):
        add_scan(database, datums)


def test_blocks_do_not_show_in_the_result(tmp_path: Path) -> None:
    xyz = grid_points(12_000, 4, spacing=0.4)
    xyz[5000, 2] += 9.0
    path = write_scan(tmp_path / "a.laz", xyz, intensity=np.arange(len(xyz)) % 500)
    whole = Database(str(tmp_path / "whole.db"))
    pieces = Database(str(tmp_path / "pieces.db"))
    one = add_scan(whole, [path]).scan
    many = add_scan(pieces, [path], AddOptions(block_points=700, chunk_points=1000)).scan
    assert one.scan_id == many.scan_id
    a, b = stored(whole), stored(pieces)
    for name in ("easting", "northing", "height", "intensity", "classification", "tile"):
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    # Blocks of 16 m and less cut the coarsest cells' neighbourhood, but no cell.
    assert (a["level"] != b["level"]).mean() < 1e-3
    assert one.row["points_checksum"] == many.row["points_checksum"]


def test_parts_of_scans_are_loaded(database: Database, tmp_path: Path) -> None:
    xyz = grid_points(30_000, 7, spacing=0.5)
    scan = add_scan(database, [write_scan(tmp_path / "a.laz", xyz)]).scan
    frame = LocalFrame.from_utm(WEST + 40.0, SOUTH + 30.0, 100.0, 32632)
    enu = frame.enu_from_utm(xyz, 32632)
    box = (-10.0, -5.0, 15.0, 20.0)
    inside = ((enu[:, :2] >= box[:2]) & (enu[:, :2] <= box[2:])).all(axis=1)
    cloud = load_cloud(database, frame, box)
    assert inside.sum() <= len(cloud) <= 1.05 * inside.sum()
    distance, _ = cKDTree(cloud.xyz).query(enu[inside])
    assert distance.max() < 2e-3  # the file's millimetre
    nodes = cloud.nodes
    assert (np.diff(nodes.level) >= 0).all()
    for k in range(len(nodes)):
        run = cloud.xyz[nodes.start[k] : nodes.start[k] + nodes.count[k]]
        np.testing.assert_array_equal(nodes.box_min[k], run.min(axis=0))
        np.testing.assert_array_equal(nodes.box_max[k], run.max(axis=0))
    capped = load_cloud(database, frame, largest_points=5000)
    assert len(capped) == np.cumsum(scan.level_points)[np.cumsum(scan.level_points) <= 5000][-1]
    with pytest.raises(ScanError, match="smaller area"):
        load_cloud(database, frame, largest_points=10)
    elsewhere = LocalFrame.from_utm(WEST + 9000.0, SOUTH, 100.0, 32632)
    assert len(load_cloud(database, elsewhere, (0.0, 0.0, 50.0, 50.0))) == 0


def test_scans_of_neighbouring_zones_meet_in_one_frame(database: Database, tmp_path: Path) -> None:
    xyz = grid_points(3000)
    path = write_scan(tmp_path / "a.laz", xyz)
    add_scan(database, [path])
    add_scan(database, [path], AddOptions(epsg=32631))
    frame = LocalFrame.from_utm(WEST, SOUTH, 100.0, 32632)
    both = load_cloud(database, frame)
    one = load_cloud(database, frame, scan_ids=[list_scans(database)[0].scan_id])
    assert len(both) == 2 * len(one)
    distance, _ = cKDTree(one.xyz).query(both.xyz)
    assert distance.max() < 2e-3


def test_what_cannot_be_loaded_together(database: Database, tmp_path: Path) -> None:
    Database.create(database.url)
    frame = LocalFrame.from_utm(WEST, SOUTH, 100.0, 32632)
    with pytest.raises(ScanNotFoundError, match="lidar add"):
        load_cloud(database, frame)
    assert list_scans(database) == []
    path = write_scan(tmp_path / "a.laz", grid_points())
    add_scan(database, [path])
    add_scan(database, [path], AddOptions(height_datum="egm96"))
    with pytest.raises(ScanError, match="egm96, unknown"):
        load_cloud(database, frame)
    with pytest.raises(ScanNotFoundError, match="no scan 77"):
        load_cloud(database, frame, scan_ids=["77"])


def test_scans_are_known_by_their_first_letters(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points())
    scan = add_scan(database, [path]).scan
    assert chosen_scans(database, [scan.scan_id[:6], scan.scan_id]) == chosen_scans(database, None)
    assert scans_of_one_zone(database, [scan.scan_id[:6]]) == scans_of_one_zone(database, [])
    with pytest.raises(ScanNotFoundError, match=r"expected a scan.*found nothing.*lidar list"):
        chosen_scans(database, [scan.scan_id, ""])
    three = [replace(scan, scan_id=name) for name in ("abc", "abcd1", "abcd2")]
    monkeypatch.setattr("featuredb.lidar.load.list_scans", lambda _: three)
    assert chosen_scans(database, ["abcd2", "abc"]) == [three[0], three[2]]
    with pytest.raises(ScanNotFoundError, match=r"abcd: 2 scans begin so \(abcd1, abcd2\); write more"):
        chosen_scans(database, ["abcd"])


def test_retire_and_add_again(database: Database, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points())
    scan = add_scan(database, [path]).scan
    assert main(["retire", database.url, scan.scan_id, "--reason", "wrong datum"]) == 0
    assert scan.scan_id in capsys.readouterr().out
    assert list_scans(database) == []
    gone = find_scan(database, scan.scan_id)
    assert (gone.status, gone.status_reason) == ("retired", "wrong datum")
    assert not retire_scan(database, scan.scan_id, "again")
    with pytest.raises(ScanNotFoundError):
        retire_scan(database, "0" * 16, "no such")
    with pytest.raises(ScanNotFoundError):
        load_cloud(database, scan_frame(scan))
    again = add_scan(database, [path])
    assert again.created
    assert again.scan.write_id != scan.write_id
    now = VacuumOptions(history_h=0.0, orphan_grace_h=0.0, file_grace_h=0.0)
    assert vacuum(database, now).write_ids == (scan.write_id,)
    assert len(stored(database)["easting"]) == again.scan.points
    assert verify(database).ok


def test_compaction_keeps_scans_and_vacuum_frees_retired_ones(database: Database, tmp_path: Path) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points(5000))
    scan = add_scan(database, [path], AddOptions(block_points=900)).scan
    other = add_scan(database, [path], AddOptions(height_unit="us-ft")).scan
    before = load_cloud(database, scan_frame(scan), scan_ids=[scan.scan_id])
    compact(database)
    assert verify(database).ok
    after = load_cloud(database, scan_frame(scan), scan_ids=[scan.scan_id])
    np.testing.assert_array_equal(sorted_rows(after.xyz), sorted_rows(before.xyz))
    retire_scan(database, other.scan_id, "test")
    kept = VacuumOptions(history_h=24.0, orphan_grace_h=0.0, file_grace_h=0.0)
    assert vacuum(database, kept).write_ids == ()
    assert vacuum(database, VacuumOptions(history_h=0.0, orphan_grace_h=0.0)).write_ids == (other.write_id,)
    assert verify(database).ok


def test_damage_is_found(database: Database, tmp_path: Path) -> None:
    scan = add_scan(database, [write_scan(tmp_path / "a.laz", grid_points())]).scan
    assert verify(database).ok
    table = DeltaTable(f"{database.url}/lidar_points")
    table.update(updates={"height": "height + 0.001"}, predicate="level = 1")
    assert [p.what for p in verify(database).problems] == [
        "its points are not those that were committed: checksums differ"
    ]
    DeltaTable(f"{database.url}/lidar_points").delete("level = 0")
    assert f"scan {scan.scan_id}" in {p.where for p in verify(database).problems}


def test_points_in_a_wrong_tile_are_found(database: Database, tmp_path: Path) -> None:
    """Their coordinates are as committed, and yet nobody who asks for a part of the scan gets them."""
    scan = add_scan(database, [write_scan(tmp_path / "scan.las", grid_points())]).scan
    DeltaTable(f"{database.url}/lidar_points").update(updates={"tile": "'E009999_N99999'"})
    assert [p.where for p in verify(database).problems if "in another tile" in p.what] == [
        f"scan {scan.scan_id}"
    ]


def test_sql_sees_scans(database: Database, tmp_path: Path) -> None:
    Database.create(database.url)
    with SqlSession(database.snapshot(), database) as session:
        assert list(session.query("select count(*) from lidar_points").rows) == [(0,)]
    scan = add_scan(database, [write_scan(tmp_path / "a.laz", grid_points())]).scan
    with SqlSession(database.snapshot(), database) as session:
        rows = list(session.query("select scan_id, name, points, epsg from lidar").rows)
        assert rows == [(scan.scan_id, "a.laz", 3000, 32632)]
        by_level = session.query(
            "select level, count(*) from lidar_points where scan_id = "
            f"'{scan.scan_id}' group by level order by level"
        )
        assert [count for _, count in by_level.rows] == list(scan.level_points)


def test_command_line(database: Database, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_scan(tmp_path / "stadium.laz", grid_points(), classification=np.full(3000, 2))
    picture = tmp_path / "plan.png"
    assert main(["lidar", "add", database.url, str(path), "--picture", str(picture), "--licence", "CC0"]) == 0
    out = capsys.readouterr().out
    for part in (
        "added",
        "3,000 points",
        "EPSG:32632",
        "metre of 1 m",
        "2 ground 3,000",
        "datum       unknown",
    ):
        assert part in out
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert main(["lidar", "add", database.url, str(path)]) == 0
    assert "was there already" in capsys.readouterr().out
    assert main(["lidar", "list", database.url]) == 0
    assert "stadium.laz" in capsys.readouterr().out
    assert main(["lidar", "list", database.url, "--json"]) == 0
    assert '"licence": "CC0"' in capsys.readouterr().out
    assert main(["verify", database.url]) == 0
    assert "1 scans" in capsys.readouterr().out
