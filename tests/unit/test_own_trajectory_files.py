"""Tracks in the frame of a map without a place: nothing in them can be taken for a place on Earth."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.maps.unplaced_map import OwnFrame
from featuredb.store import Database
from ingest.track.finders import FilmGround, finder_for
from reloc.localise.result import OwnPose
from reloc.tracking.ground import TrackedFrame
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.options import TrackOptions
from reloc.tracking.track_video import _words
from reloc.tracking.trajectory.files import (
    CSV_COLUMNS,
    exit_code,
    format_of,
    read_trajectory_csv,
    write_outputs,
    write_trajectory,
)
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint, point_of
from tests.support.maps import random_unplaced_map
from tests.support.planar_map import view

_POSE = OwnPose(
    map_id="film-0",
    frame=OwnFrame(metric=False, upright=False),
    cam_from_map=view(1.0, 2.0, 3.0, tilt_deg=20.0, heading_deg=40.0),
    covariance=np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.04, 0.09]),
)
_TRACK = Trajectory(
    source="film.mp4",
    points=(
        TrajectoryPoint(index=0, time_s=0.0, state="relocalised", in_map=_POSE, inliers=40),
        TrajectoryPoint(index=1, time_s=0.04, state="lost", detail="LOST"),
        TrajectoryPoint(index=2, time_s=0.08, state="relocalised", in_map=_POSE, inliers=41),
    ),
)
_ON_EARTH = {"easting", "northing", "height", "latitude", "longitude", "epsg", "heading_deg", "lat", "lon"}


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    made = Database.create(str(tmp_path_factory.mktemp("own") / "db"))
    fingerprint = TrackOptions().localise.extractor.fingerprint
    made.commit_maps([replace(random_unplaced_map(), extractor_fingerprint=fingerprint)])
    return made


def test_the_table_has_the_pose_under_names_of_its_own(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t.csv", _TRACK)
    with (tmp_path / "t.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert not set(rows[0]) & (_ON_EARTH | {c for c in CSV_COLUMNS if c.startswith(("q", "cov_"))})
    assert [float(rows[0][f"own_{a}"]) for a in "xyz"] == pytest.approx([1.0, 2.0, 3.0])
    turn = matrix_from_quaternion(np.array([float(rows[0][f"own_q{a}"]) for a in "xyzw"]))
    np.testing.assert_allclose(turn, _POSE.cam_from_map.rotation, atol=1e-7)
    assert (rows[0]["own_unit"], rows[0]["unplaced_map"]) == ("map_unit", "film-0")
    assert float(rows[0]["own_cov_z_z"]) == pytest.approx(0.09)
    assert (rows[1]["own_x"], rows[1]["detail"]) == ("", "LOST")
    with pytest.raises(InvalidValueError, match="expected a track on Earth"):
        read_trajectory_csv(tmp_path / "t.csv")


def test_a_track_without_a_place_counts_as_found_and_says_so(tmp_path: Path) -> None:
    written = write_outputs([tmp_path / "t.csv"], _TRACK)
    assert exit_code(written, _TRACK) == 0
    assert exit_code(written, _TRACK, stopped=True) == 130
    assert exit_code(written, _TRACK, lost="the session ended: NO_SERVER") == 2
    assert _TRACK.times_found() == [(0.0, 0.0), (0.08, 0.08)]
    assert "no place on Earth" in _words(_TRACK.points[0])[1]


@pytest.mark.parametrize("suffix", [".tum", ".geojson", ".kml", ".json"])
def test_formats_of_places_on_earth_refuse(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="needs places on Earth, and map film-0 has none"):
        format_of(tmp_path / f"t{suffix}", "film-0")
    with pytest.raises(InvalidValueError, match="needs places on Earth"):
        write_trajectory(tmp_path / f"t{suffix}", _TRACK)


def test_a_frame_on_a_map_without_a_place_has_a_pose_in_it(database: Database) -> None:
    unplaced = random_unplaced_map()
    finder = finder_for(database, FilmGround(maps=(unplaced.map_id,)), None, TrackOptions())
    assert isinstance(finder, MapFinder)
    (ground,) = finder.grounds
    frame = TrackedFrame(
        index=0,
        time_s=0.0,
        state="tracking",
        camera=Camera.from_focal(640, 480, 600.0, "SIMPLE_RADIAL"),
        ground=ground,
        cam_from_local=_POSE.cam_from_map,
        covariance=_POSE.covariance,
        rows=np.array([0, 1]),
    )
    point = point_of(frame)
    assert point.pose is None
    assert point.in_map is not None
    assert point.in_map.map_id == unplaced.map_id
    np.testing.assert_array_equal(point.in_map.cam_from_map.center, _POSE.cam_from_map.center)
    np.testing.assert_array_equal(point.in_map.covariance, _POSE.covariance)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--out", "t.kml"], "needs places on Earth"),
        (["--out", "t.csv", "--prior", "49,8,30"], "--prior is a"),
    ],
)
def test_what_needs_a_place_is_refused_before_the_film_is_opened(
    database: Database, asked: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["track", database.url, "no film", "--map", random_unplaced_map().map_id, *asked])
    assert (code, said in capsys.readouterr().err) == (2, True)


def test_what_a_film_is_followed_by_is_one_of_three() -> None:
    with pytest.raises(InvalidValueError, match="by: expected one of map, scan, both, found 'maps'"):
        FilmGround(by="maps")  # type: ignore[arg-type]
