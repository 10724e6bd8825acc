"""Trajectories come back from their CSV; tables that are none are refused with the line."""

import csv
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from reloc.tracking.trajectory.files import read_trajectory_csv, write_trajectory
from reloc.tracking.trajectory.values import Trajectory
from tests.support.planar_map import planar_map
from tests.support.viewer import track_over


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return track_over(planar_map(1))


@pytest.fixture
def path(trajectory: Trajectory, tmp_path: Path) -> Path:
    write_trajectory(tmp_path / "t.csv", trajectory)
    return tmp_path / "t.csv"


def test_what_was_written_is_read(trajectory: Trajectory, path: Path) -> None:
    read = read_trajectory_csv(path)
    assert read.source == "t.csv"
    for a, b in zip(read.points, trajectory.points, strict=True):
        assert (a.index, a.state, a.inliers, a.detail) == (b.index, b.state, b.inliers, b.detail)
        assert a.time_s == pytest.approx(b.time_s, abs=1e-6)
        assert (a.pose is None) == (b.pose is None)
        if a.pose is None or b.pose is None:
            continue
        assert (a.pose.epsg, a.pose.height_datum, a.pose.map_id) == (b.pose.epsg, "ellipsoidal", "field")
        np.testing.assert_allclose(a.pose.utm, b.pose.utm, atol=1e-4)
        np.testing.assert_allclose(a.pose.cam_from_utm_xyzw, b.pose.cam_from_utm_xyzw, atol=1e-8)
        np.testing.assert_allclose(a.pose.covariance, b.pose.covariance, rtol=1e-6)
        # The GeoPose is computed anew from UTM; the file's own columns were made of the true one.
        np.testing.assert_allclose(a.pose.geopose.quaternion_xyzw, b.pose.geopose.quaternion_xyzw, atol=1e-7)
        assert a.pose.geopose.latitude_deg == pytest.approx(b.pose.geopose.latitude_deg, abs=1e-8)


def test_no_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"none\.csv: cannot be read"):
        read_trajectory_csv(tmp_path / "none.csv")


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "\x00\x01\x02", '"' * 5])
def test_another_table_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidValueError, match=r"t\.csv"):
        read_trajectory_csv(tmp_path / "t.csv")


def test_a_film_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(bytes(range(256)) * 10)
    with pytest.raises(InvalidValueError, match="expected a table"):
        read_trajectory_csv(tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("state", "found"),
        ("time_s", "nan"),
        ("time_s", ""),
        ("frame", "x"),
        ("northing", "x"),
        ("easting", "inf"),
        ("epsg", "4326"),
        ("qw", "7"),
        ("cov_e_e", "x"),
    ],
)
def test_a_broken_row_is_named(path: Path, column: str, value: str) -> None:
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    rows[2][column] = value
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(InvalidValueError, match="line 4"):
        read_trajectory_csv(path)


def test_a_cut_file_is_refused(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: len(text) - len(text.splitlines()[-1]) // 2], encoding="utf-8")
    with pytest.raises(InvalidValueError, match="line 12"):
        read_trajectory_csv(path)


def test_a_table_without_frames_is_refused(path: Path) -> None:
    path.write_text(path.read_text(encoding="utf-8").splitlines()[0] + "\n", encoding="utf-8")
    with pytest.raises(InvalidValueError, match="a row for each frame"):
        read_trajectory_csv(path)
