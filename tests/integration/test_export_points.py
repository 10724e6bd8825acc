"""LAS, LAZ and PLY: every point to the millimetre, with its map, its colour and its reference system."""

import csv
import os
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS

from featuredb.cli.main import main
from featuredb.errors import ExportError, InvalidValueError
from featuredb.export.formats.las import write_las_files
from featuredb.export.formats.ply import ROW, write_ply_files
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.geo.crs.scan import scan_crs
from featuredb.lidar.formats.las_stream import LasStream, offset_and_step
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from tests.support.command_line import only_command
from tests.support.maps import random_map

DAY = date(2026, 5, 1)


def some_maps() -> list[FeatureMap]:
    """Two of one zone and datum, one of another datum, one of another zone on the southern hemisphere."""
    first, second, third, fourth = (random_map(k, points=50 + k) for k in range(4))
    south = fourth.points.utm.copy()
    south[:, 1] += 10_000_000 - 2 * south[:, 1].mean()
    return [
        first,
        second,
        replace(third, height_datum="ellipsoidal"),
        replace(fourth, epsg=32733, height_datum="egm96", points=replace(fourth.points, utm=south)),
    ]


@pytest.fixture
def job(tmp_path: Path) -> ExportJob:
    database = Database.create(tmp_path / "maps.db")
    for feature_map in some_maps():
        database.commit_map(feature_map)
    return ExportJob(
        database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / "out"
    )


EXPECTED = {"epsg32632_unknown": (0, 1), "epsg32632_ellipsoidal": (2,), "epsg32733_egm96": (3,)}


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_laspy_reads_every_point_to_the_millimetre(job: ExportJob, ending: str) -> None:
    done = write_las_files(job, compressed=ending == "laz")
    assert (done.maps, done.points) == (4, 50 + 51 + 52 + 53)
    maps = some_maps()
    assert sorted(f.stem for f in job.out.glob(f"*.{ending}")) == sorted(EXPECTED)
    for name, members in EXPECTED.items():
        las = laspy.read(job.out / f"{name}.{ending}")
        wanted = [maps[k] for k in members]
        utm = np.concatenate([m.points.utm for m in wanted])
        assert np.abs(las.xyz - utm).max() <= 0.0001
        rgb = np.column_stack([las.red, las.green, las.blue])
        np.testing.assert_array_equal(rgb // 257, np.concatenate([m.points.rgb for m in wanted]))
        np.testing.assert_array_equal(
            las.map_index, np.repeat(members, [len(maps[k].points) for k in members])
        )
        np.testing.assert_array_equal(
            las.track_length, np.concatenate([m.points.track_length for m in wanted])
        )
        np.testing.assert_array_equal(las.error_px, np.concatenate([m.points.error_px for m in wanted]))
        crs = las.header.parse_crs()
        assert crs is not None
        epsg, datum = int(name[4:9]), name.split("_")[1]
        plane = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
        assert plane.equals(CRS.from_epsg(epsg), ignore_axis_order=True)
        # PROJ makes of a height above the ellipsoid a third axis, of the others a system of their own.
        assert crs.is_compound == (datum == "egm96")
        assert len(crs.axis_info) == (2 if datum == "unknown" else 3)
        if crs.is_compound:
            assert crs.sub_crs_list[1].equals(CRS.from_epsg(5773))
        assert scan_crs(wkt=crs.to_wkt()).height_datum == datum


def test_sigma_is_that_of_the_worst_direction(tmp_path: Path) -> None:
    """A covariance of known axes: 0.3 m along a slanted line, 0.1 m across it."""
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    matrix = 0.01 * np.eye(3) + (0.09 - 0.01) * np.outer(axis, axis)
    upper = matrix[np.triu_indices(3)].astype(np.float32)
    feature_map = random_map(0)
    points = replace(feature_map.points, covariance=np.tile(upper, (60, 1)))
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(replace(feature_map, points=points))
    write_las_files(
        ExportJob(
            database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / "out"
        ),
        compressed=False,
    )
    las = laspy.read(tmp_path / "out" / "epsg32632_unknown.las")
    np.testing.assert_allclose(las.sigma_m, 0.3, rtol=1e-5)


def test_ply_has_the_very_coordinates(job: ExportJob) -> None:
    write_ply_files(job)
    maps = some_maps()
    assert sorted(f.stem for f in job.out.glob("*.ply")) == sorted(EXPECTED)
    assert not list(job.out.glob("*.body"))
    for name, members in EXPECTED.items():
        head, body = (job.out / f"{name}.ply").read_bytes().split(b"end_header\n", 1)
        rows = np.frombuffer(body, dtype=ROW)
        lines = head.decode().splitlines()
        assert f"element vertex {len(rows)}" in lines
        assert [line.split()[2] for line in lines if line.startswith("property")] == list(ROW.names or ())
        utm = np.concatenate([maps[k].points.utm for k in members])
        np.testing.assert_array_equal(np.column_stack([rows["x"], rows["y"], rows["z"]]), utm)
        assert set(rows["map_index"].tolist()) == set(members)
        crs = CRS.from_wkt((job.out / f"{name}.wkt").read_text())
        plane = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
        assert plane.equals(CRS.from_epsg(int(name[4:9])), ignore_axis_order=True)


@pytest.mark.parametrize("write", [lambda job: write_las_files(job, compressed=True), write_ply_files])
def test_tables_name_every_map_and_photo_and_bytes_repeat(job: ExportJob, write: object) -> None:
    assert callable(write)
    write(job)
    write(replace(job, out=job.out.with_name("again")))
    files = sorted(f.name for f in job.out.iterdir())
    assert files == sorted(f.name for f in job.out.with_name("again").iterdir())
    for name in files:
        assert (job.out / name).read_bytes() == (job.out.with_name("again") / name).read_bytes(), name
    with (job.out / "maps.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["map_index"], r["map_id"], r["height_datum"]) for r in rows] == [
        ("0", "map-0", "unknown"),
        ("1", "map-1", "unknown"),
        ("2", "map-2", "ellipsoidal"),
        ("3", "map-3", "egm96"),
    ]
    with (job.out / "attribution.csv").open(encoding="utf-8", newline="") as file:
        photos = [(r["map_id"], r["image"], r["owner"], r["licence"]) for r in csv.DictReader(file)]
    assert photos == [(m.map_id, i.name, "A. Pilot", "CC-BY-4.0") for m in some_maps() for i in m.images]


def test_a_box_that_las_cannot_hold_is_refused() -> None:
    low, high = np.array([2e5, 0.0, 0.0]), np.array([8e5, 9e6, 100.0])
    with pytest.raises(InvalidValueError, match="LAS can hold to the millimetre"):
        offset_and_step(low, high)


def test_maps_hundreds_of_kilometres_apart_keep_the_millimetre(tmp_path: Path) -> None:
    low, high = np.array([2e5, 1e6, 0.0]), np.array([8e5, 4e6, 100.0])
    xyz = np.array([low + 0.1234, high - 0.4321])
    wkt = CRS.from_epsg(32632).to_wkt("WKT1_GDAL")
    offset, step_m = offset_and_step(low, high)
    with LasStream(tmp_path / "a.laz", wkt, offset=offset, step_m=step_m, day=DAY) as stream:
        stream.write(xyz, {}, np.zeros((2, 3), np.uint8))
    assert np.abs(laspy.read(tmp_path / "a.laz").xyz - xyz).max() <= 0.001


def test_maps_without_points_are_said_to_be_so(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(random_map(0, points=0))
    job = ExportJob(
        database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / "out"
    )
    with pytest.raises(ExportError, match="found none with any"):
        write_ply_files(job)
    assert not job.out.exists()


_KILLED = """
import os, signal, sys
from pathlib import Path
from featuredb.export.job import ExportJob
from featuredb.export.formats.las import write_las_files
from featuredb.export.selection import Selection
from featuredb.store import Database
database = Database.open(sys.argv[1])
write_las_files(ExportJob(database=database, snapshot=database.snapshot(), selection=Selection(),
    out=Path(sys.argv[2]), told=lambda done, total: os.kill(os.getpid(), signal.SIGKILL)), compressed=True)
"""


def test_a_kill_in_the_middle_leaves_nothing(job: ExportJob, tmp_path: Path) -> None:
    died = subprocess.run(
        [sys.executable, "-c", _KILLED, str(tmp_path / "maps.db"), str(job.out)],
        capture_output=True, text=True, timeout=120, check=False, env=os.environ,
    )  # fmt: skip
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert not job.out.exists()


def test_the_command_writes_them(
    job: ExportJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with only_command(monkeypatch, "export", "featuredb.cli.export:register"):
        for ending in ("las", "laz", "ply"):
            argv = ["export", str(tmp_path / "maps.db"), str(tmp_path / ending), "--format", ending]
            assert main(argv) == 0, capsys.readouterr().err
            assert len(list((tmp_path / ending).glob(f"*.{ending}"))) == 3
            assert main([*argv[:2], str(tmp_path / "no"), *argv[3:], "--text"]) == 2
            assert f"--text: expected --format colmap beside it, found {ending}" in capsys.readouterr().err
