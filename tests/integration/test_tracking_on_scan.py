"""Films on a scan: right by it alone, from a coarse first pose; lost where it shows nothing of them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.features.extractor import extract
from featuredb.geometry.rigid3 import Rigid3
from featuredb.lidar.load import load_cloud
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import list_scans
from featuredb.video.writer import VideoWriter
from ingest.register.frame_registration import FramePrior
from ingest.track.finders import MapOverScanFinder
from ingest.track.scan_ground import ScanFinder, ScanGround
from reloc.localiser import Localiser
from reloc.tracking.ground import Finder, Keyframe, TrackedFrame, Unmatched
from reloc.tracking.map_ground import MapFinder, MapGround
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.files import read_trajectory_csv
from reloc.tracking.trajectory.values import point_of
from tests.support.hill_photos import CAMERA, FRAME, _render
from tests.support.hill_scan import EPSG, write_hill_scan
from tests.support.hill_walk import anchored_database
from tests.support.made_once import made_once
from tests.support.planar_map import field_texture, view

pytest.importorskip("laspy")

_OPTIONS = TrackOptions(keyframe_every=6, answer_after=4, lost_answer_after=6, catch_up=6, min_matches=20)
_FRAMES, _CUT = 40, range(20, 24)
_EAST_M = -24.0  # where the survey of the map and the scan overlap


def pose_at(frame: int) -> Rigid3:
    """Half a metre and a degree a frame."""
    return view(_EAST_M + 0.4 * frame, -3.0 + 0.1 * frame, 46.0, tilt_deg=8.0, heading_deg=10.0 + 0.7 * frame)


def coarse(pose: Rigid3, off_m: float = 2.0, off_deg: float = 2.0) -> FramePrior:
    centre = pose.center + np.array([off_m, -off_m, off_m]) / np.sqrt(3.0)
    turn = Rigid3.exp(np.array([0.0, 0.0, np.radians(off_deg), 0.0, 0.0, 0.0])).rotation
    rotation = turn @ pose.rotation
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ centre),
        sigma_horizontal_m=3.0,
        sigma_vertical_m=3.0,
        sigma_heading_deg=3.0,
        sigma_tilt_deg=3.0,
    )


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a survey in the west, and a scan that reaches further east."""
    folder = tmp_path_factory.mktemp("scanned")
    shutil.copytree(made_once("anchored-hills", anchored_database, tmp_path_factory) / "db", folder / "db")
    scan = write_hill_scan(folder / "hills.laz")
    assert main(["lidar", "add", str(folder / "db"), str(scan), "--height-datum", "ellipsoidal"]) == 0
    return folder / "db"


@pytest.fixture(scope="module")
def cloud(database: Path) -> PointCloud:
    return load_cloud(Database.open(database), FRAME)


@pytest.fixture(scope="module")
def film() -> list[np.ndarray]:
    texture, other = field_texture(1), field_texture(9)
    return [_render(other if i in _CUT else texture, pose_at(i), i) for i in range(_FRAMES)]


def tracked(finder: Finder, film: list[np.ndarray]) -> list[TrackedFrame]:
    with Tracker(finder, CAMERA, _OPTIONS) as tracker:
        return [tracker.track(gray, i / 30.0) for i, gray in enumerate(film)]


def check(frames: list[TrackedFrame], local_from_hills: Rigid3, metres: float, degrees: float) -> None:
    for frame in frames:
        if frame.cam_from_local is None:
            continue
        true = pose_at(frame.index)
        assert np.linalg.norm(frame.cam_from_local.center - local_from_hills.act(true.center)) < metres
        assert (frame.cam_from_local @ local_from_hills).angle_to_deg(true) < degrees


@pytest.fixture(scope="module")
def on_scan(cloud: PointCloud, film: list[np.ndarray]) -> list[TrackedFrame]:
    return tracked(ScanFinder(cloud, "hills", EPSG, coarse(pose_at(0))), film)


@pytest.mark.evaluation
def test_a_scan_alone_gives_right_poses_and_nothing_of_elsewhere(on_scan: list[TrackedFrame]) -> None:
    states = [frame.state for frame in on_scan]
    assert states[:7] == ["lost"] * 6 + ["relocalised"]
    assert states[7:20] == ["tracking"] * 13
    assert states[20:24] == ["lost"] * 4
    found = states.index("relocalised", 20)
    assert states[found + 1 :] == ["tracking"] * (_FRAMES - found - 1)
    check(on_scan, Rigid3.identity(), 0.3, 0.4)


@pytest.mark.evaluation
def test_poses_on_a_scan_have_its_zone_and_their_errors_are_claimed(on_scan: list[TrackedFrame]) -> None:
    normalised = []
    for frame in on_scan:
        point = point_of(frame)
        if point.pose is None:
            continue
        assert (point.pose.epsg, point.pose.height_datum, point.pose.map_id) == (EPSG, "ellipsoidal", "hills")
        true = FRAME.utm_from_enu(pose_at(frame.index).center, EPSG)
        off = point.pose.utm - true
        normalised.append(off @ np.linalg.solve(point.pose.covariance[3:, 3:], off))
        # What a keyframe's landmarks share is claimed, not only what their pixels scatter by.
        assert frame.covariance is not None
        assert np.trace(point.pose.covariance[3:, 3:]) > 2.0 * np.trace(frame.covariance[3:, 3:])
    assert np.mean(normalised) < 3.0 * 3.0


def test_a_scan_is_not_searched_without_a_pose_or_a_lens(cloud: PointCloud, film: list[np.ndarray]) -> None:
    without = tracked(ScanFinder(cloud, "hills", EPSG, None), film[:8])
    assert {f.state for f in without} == {"lost"}
    assert without[-1].detail.startswith("NO_POSE")
    with Tracker(ScanFinder(cloud, "hills", EPSG, coarse(pose_at(0))), None, _OPTIONS) as tracker:
        found = [tracker.track(gray, i / 30.0) for i, gray in enumerate(film[:8])]
    assert found[-1].detail.startswith("NO_CAMERA")


def test_a_keyframe_far_from_its_pose_is_not_believed(cloud: PointCloud, film: list[np.ndarray]) -> None:
    finder = ScanFinder(cloud, "hills", EPSG, coarse(pose_at(0)))
    right = finder.ground.match(film[0], CAMERA, pose_at(0), _OPTIONS)
    assert isinstance(right, Keyframe)
    off = pose_at(0)
    beside = Rigid3(rotation=off.rotation, translation=off.translation + np.array([12.0, 0.0, 0.0]))
    wrong = finder.ground.match(film[0], CAMERA, beside, _OPTIONS)
    assert isinstance(wrong, Unmatched)
    elsewhere = finder.ground.match(film[20], CAMERA, pose_at(20), _OPTIONS)
    assert isinstance(elsewhere, Unmatched)
    away = Rigid3(rotation=off.rotation, translation=off.translation + np.array([900.0, 0.0, 0.0]))
    nothing = finder.ground.match(film[0], CAMERA, away, _OPTIONS)
    assert isinstance(nothing, Unmatched)
    assert nothing.reason == "NO_SCAN"


def test_the_scan_goes_on_where_the_map_ends(database: Path, film: list[np.ndarray]) -> None:
    maps = MapFinder(Localiser.open(Database.open(database)).areas)
    frame = maps.grounds[0].frame
    cloud = load_cloud(Database.open(database), frame)

    finder = MapOverScanFinder(maps, ScanFinder(cloud, "hills", EPSG, None))
    found = tracked(finder, film[:20])
    check(found, frame.enu_from(FRAME), 0.3, 0.4)
    assert [f.state for f in found[6:]] == ["relocalised", *["tracking"] * 13]
    by_map = [f for f in found if f.rows is not None and (f.rows >= 0).any()]
    assert by_map, "the map has found the film"
    # A loss would be looked for on the scan from the last keyframe, and not from where the film began.
    last = finder._scan.ground.last
    assert last is not None
    centers = [frame.enu_from(FRAME).act(pose_at(i).center) for i in range(20)]
    assert np.linalg.norm(centers - last.center, axis=1).argmin() >= 6

    class Forgets:
        """A map that knows nothing of keyframes."""

        def __init__(self, ground: MapGround) -> None:
            self._ground = ground

        def __getattr__(self, name: str) -> object:
            return getattr(self._ground, name)

        def match(self, *_: object) -> Unmatched:
            return Unmatched(reason="TOO_FEW_MATCHES", detail="nothing")

    finder = MapOverScanFinder(maps, ScanFinder(cloud, "hills", EPSG, None))
    finder._ground = type(finder._ground)(maps=Forgets(maps.grounds[0]), scan=finder._scan.ground)  # type: ignore[arg-type]
    found = tracked(finder, film[:20])
    check(found, frame.enu_from(FRAME), 0.3, 0.4)
    assert [f.state for f in found[6:]] == ["relocalised", *["tracking"] * 13]
    assert found[-1].rows is not None
    assert (found[-1].rows < 0).mean() > 0.5
    pose = point_of(found[-1]).pose
    assert pose is not None
    assert pose.map_id == "hills"


def test_the_command_follows_a_film_by_a_scan(
    database: Path, film: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "film.mp4"
    with VideoWriter(path, width=CAMERA.width, height=CAMERA.height, fps=30.0) as writer:
        for gray in film[:20]:
            writer.write(gray)
    utm = FRAME.utm_from_enu(pose_at(0).center + np.array([1.0, -1.0, 1.0]), EPSG)
    axis = pose_at(0).rotation
    east, north, up = axis[2]
    top = -axis[1]
    pose = {
        "easting": utm[0],
        "northing": utm[1],
        "height": utm[2],
        "look_at": [float(v) for v in utm + 40.0 * np.array([east, north, up])],
        "yaw_deg": float(np.degrees(np.arctan2(top[0], top[1]))),
        "sigma_horizontal_m": 4.0,
        "sigma_vertical_m": 4.0,
    }
    (tmp_path / "pose.json").write_text(json.dumps(pose))
    lens = f"{CAMERA.model},{CAMERA.width},{CAMERA.height},{','.join(map(str, CAMERA.params))}"
    words = ["track", str(database), str(path), "--out", str(tmp_path / "t.csv")]
    assert main([*words, "--by", "scan", "--camera", lens, "--pose", str(tmp_path / "pose.json")]) == 0
    points = read_trajectory_csv(tmp_path / "t.csv").points
    assert len(points) == 20
    assert all(p.pose is not None for p in points)
    for p in points:
        assert p.pose is not None
        assert np.linalg.norm(p.pose.utm - FRAME.utm_from_enu(pose_at(p.index).center, EPSG)) < 0.5
    (scan,) = list_scans(Database.open(database))
    assert {p.pose.map_id for p in points if p.pose is not None} == {scan.scan_id}
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--by", "scan"], "give --camera and --pose"),
        (["--by", "scan", "--map", "hills"], "leave out --map or --by scan"),
        (["--pose", "pose.json"], "are for --by scan and --by both"),
        (["--by", "both", "--scan", "none"], "no scan none"),
        (["--by", "both", "--pose", "missing.json"], "cannot be read as JSON"),
    ],
)
def test_what_contradicts_itself_is_told(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    assert main(["track", str(database), "film.mp4", "--out", str(tmp_path / "t.csv"), *words]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "t.csv").exists()


def test_fixture_is_what_it_says(film: list[np.ndarray], cloud: PointCloud) -> None:
    """Frames have features, and the scan reaches further east than the film."""
    assert len(extract(film[0], _OPTIONS.localise.extractor)) > 200
    assert cloud.xyz[:, 0].max() > pose_at(_FRAMES).center[0]
    assert isinstance(ScanFinder(cloud, "hills", EPSG, None).ground, ScanGround)
