"""Trajectories as files: what other programs read is what was written."""

import csv
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.files import CSV_COLUMNS, format_of, write_trajectory
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from schemas import load_schema
from tests.support.planar_map import view

_EPSG = 32632
_FRAME = LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=160.0)
_START = datetime(2026, 5, 1, 10, 0, tzinfo=UTC)


def _camera(k: int) -> Rigid3:
    return view(3.0 * k, -2.0 * k, 50.0 + k, tilt_deg=20.0, heading_deg=40.0 + 5.0 * k)


def _pose(k: int) -> EarthPose:
    pose = _camera(k)
    grid = _FRAME.grid_from_enu(pose.center, _EPSG)
    return EarthPose(
        epsg=_EPSG,
        utm=_FRAME.utm_from_enu(pose.center, _EPSG),
        height_datum="ellipsoidal",
        cam_from_utm_xyzw=quaternion_from_matrix(pose.rotation @ grid.T),
        geopose=geopose_from_camera(pose, _FRAME),
        covariance=np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.04, 0.09]),
        map_id="m",
    )


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """Six frames, the third lost."""
    points = [
        TrajectoryPoint(index=k, time_s=k / 25.0, state="lost", detail='LOST: "3" of 9, landmarks')
        if k == 2
        else TrajectoryPoint(
            index=k, time_s=k / 25.0, state="tracking" if k else "relocalised", pose=_pose(k), inliers=40 + k
        )
        for k in range(6)
    ]
    return Trajectory(source="a & b.mp4", points=tuple(points), start=_START)


def _written(folder: Path, name: str, trajectory: Trajectory) -> str:
    write_trajectory(folder / name, trajectory)
    assert [f.name for f in folder.iterdir()] == [name]
    return (folder / name).read_text(encoding="utf-8")


def test_csv_has_every_frame(trajectory: Trajectory, tmp_path: Path) -> None:
    rows = list(csv.DictReader(_written(tmp_path, "t.csv", trajectory).splitlines()))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert [r["state"] for r in rows] == ["relocalised", "tracking", "lost", *["tracking"] * 3]
    assert rows[2]["easting"] == ""
    assert rows[2]["detail"] == 'LOST: "3" of 9, landmarks'
    for k in (0, 1, 3, 4, 5):
        pose = _pose(k)
        utm = [float(rows[k][name]) for name in ("easting", "northing", "height")]
        np.testing.assert_allclose(utm, pose.utm, atol=1e-4)
        turn = [float(rows[k][name]) for name in ("qx", "qy", "qz", "qw")]
        np.testing.assert_allclose(turn, pose.cam_from_utm_xyzw, atol=1e-8)
        heading, pitch, _ = pose.geopose.heading_pitch_roll_deg
        assert float(rows[k]["heading_deg"]) == pytest.approx(heading, abs=1e-4)
        assert float(rows[k]["pitch_deg"]) == pytest.approx(pitch, abs=1e-4)
        assert float(rows[k]["cov_n_n"]) == pytest.approx(0.04)
        assert float(rows[k]["cov_e_n"]) == 0.0


def test_tum_is_the_camera_in_the_world(trajectory: Trajectory, tmp_path: Path) -> None:
    lines = _written(tmp_path, "t.tum", trajectory).splitlines()
    assert lines[0].startswith("# EPSG:32632, heights ellipsoidal")
    rows = np.array([[float(v) for v in line.split()] for line in lines[1:]])
    assert rows.shape == (5, 8)
    for row, k in zip(rows, (0, 1, 3, 4, 5), strict=True):
        assert row[0] == pytest.approx(k / 25.0, abs=1e-6)
        # A point ahead of the camera: what TUM says of it, and what the pose says.
        pose = _camera(k)
        ahead = pose.inverse().act(np.array([[0.0, 0.0, 10.0]]))[0]
        world = matrix_from_quaternion(row[4:]) @ [0.0, 0.0, 10.0] + row[1:4]
        np.testing.assert_allclose(world, _FRAME.utm_from_enu(ahead, _EPSG), atol=0.02)  # scale of the grid


def test_tum_has_one_grid(trajectory: Trajectory, tmp_path: Path) -> None:
    last = trajectory.points[-1]
    assert last.pose is not None
    other = replace(last, pose=replace(last.pose, epsg=32633))
    crossing = replace(trajectory, points=(*trajectory.points[:-1], other))
    with pytest.raises(InvalidValueError, match="crosses from EPSG:32632 to EPSG:32633"):
        write_trajectory(tmp_path / "t.tum", crossing)
    assert not list(tmp_path.iterdir())


def test_geojson_has_stretches_and_frames(trajectory: Trajectory, tmp_path: Path) -> None:
    document = json.loads(_written(tmp_path, "t.geojson", trajectory))
    lines = [f for f in document["features"] if f["geometry"]["type"] == "LineString"]
    places = [f for f in document["features"] if f["geometry"]["type"] == "Point"]
    assert [len(line["geometry"]["coordinates"]) for line in lines] == [2, 3]
    assert [p["properties"]["frame"] for p in places] == [0, 1, 3, 4, 5]
    longitude, latitude, height = places[3]["geometry"]["coordinates"]
    np.testing.assert_allclose(
        [latitude, longitude], _FRAME.geodetic_from_enu(_camera(4).center)[:2], atol=1e-9
    )
    assert height == pytest.approx(_pose(4).utm[2], abs=1e-3)
    assert places[0]["properties"]["sigma_enu_m"] == [0.1, 0.2, 0.3]


def test_kml_is_xml_with_a_line_a_stretch(trajectory: Trajectory, tmp_path: Path) -> None:
    root = ET.fromstring(_written(tmp_path, "t.kml", trajectory))
    space = {"k": "http://www.opengis.net/kml/2.2"}
    assert root.findtext("k:Document/k:name", namespaces=space) == "a & b.mp4"
    lines = [e.text or "" for e in root.iterfind(".//k:coordinates", space)]
    assert [len(line.split()) for line in lines] == [2, 3]


def test_the_geopose_series_is_one(trajectory: Trajectory, tmp_path: Path) -> None:
    document = json.loads(_written(tmp_path, "t.json", trajectory))
    jsonschema.Draft202012Validator(load_schema("geopose/irregular_series")).validate(document)
    series = document["innerFrameAndTimeSeries"]
    assert document["header"]["poseCount"] == len(series) == 5
    assert series[1]["validTime"] - series[0]["validTime"] == 40
    assert series[0]["validTime"] == round(1000 * _START.timestamp())
    outer = dict(part.split("=") for part in document["outerFrame"]["parameters"].split("&"))
    frame = LocalFrame(
        latitude_deg=float(outer["latitude"]),
        longitude_deg=float(outer["longitude"]),
        height_m=float(outer["height"]),
    )
    for entry, k in zip(series, (0, 1, 3, 4, 5), strict=True):
        place, turn = (
            np.array([float(v) for v in numbers.split(",")])
            for numbers in re.findall(r"\[([^\]]*)\]", entry["frame"]["parameters"])
        )
        own = frame.enu_from(_FRAME)
        np.testing.assert_allclose(place, own.act(_camera(k).center), atol=2e-3)
        forward = own.rotation @ _camera(k).rotation.T @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(matrix_from_quaternion(turn)[:, 0], forward, atol=1e-7)


@pytest.mark.parametrize("kind", ["tum", "kml", "json"])
def test_heights_of_two_datums_are_not_mixed(kind: str, trajectory: Trajectory, tmp_path: Path) -> None:
    last = trajectory.points[-1]
    assert last.pose is not None
    other = replace(last, pose=replace(last.pose, height_datum="egm96"))
    mixed = replace(trajectory, points=(*trajectory.points[:-1], other))
    with pytest.raises(InvalidValueError, match="heights egm96 to ellipsoidal"):
        write_trajectory(tmp_path / f"t.{kind}", mixed)
    for fine in ("csv", "geojson"):
        write_trajectory(tmp_path / f"t.{fine}", mixed)
        assert "egm96" in (tmp_path / f"t.{fine}").read_text()


@pytest.mark.parametrize("name", ["t.txt", "t", "t.gpx"])
def test_other_formats_are_refused_before_anything_is_done(
    name: str, trajectory: Trajectory, tmp_path: Path
) -> None:
    with pytest.raises(InvalidValueError, match=r"expected a name that ends in \.csv, \.tum"):
        format_of(tmp_path / name)
    with pytest.raises(InvalidValueError, match="expected a name"):
        write_trajectory(tmp_path / name, trajectory)
    assert not list(tmp_path.iterdir())


def test_a_track_without_poses_is_a_table_of_reasons_and_nothing_else(
    trajectory: Trajectory, tmp_path: Path
) -> None:
    lost = replace(trajectory, points=(trajectory.points[2],))
    for name in ("t.tum", "t.geojson", "t.kml", "t.json"):
        with pytest.raises(InvalidValueError, match=r"no frame has a pose.*\(LOST"):
            write_trajectory(tmp_path / name, lost)
    assert not list(tmp_path.iterdir())
    assert _written(tmp_path, "t.csv", lost).count("\n") == 2
