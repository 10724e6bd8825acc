"""`featuredb anchor --near`: a map without a place is found on the scan, or said not to be there."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.lidar.add import add_scan
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import moved_image
from featuredb.maps.unplaced_map import NoPlace, OwnFrame, OwnPoints, UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from ingest.register.anchor import frames
from ingest.register.anchor.files import PhotoFiles
from ingest.register.anchor.start import first_place
from ingest.register.anchor.start.from_above import FoundPlace
from tests.support.hill_map import hill_map
from tests.support.hill_photos import FRAME, hill_photos
from tests.support.hill_scan import write_hill_scan
from tests.support.remembered import remembered

# The map's own frame is upside down, turned and of another size.
OWN_FROM_LOCAL = Sim3(scale=0.4, rotation=so3_exp([3.0, 0.5, -1.0]), translation=np.array([7.0, -5.0, 2.0]))
_AWAY_M = (40.0, -30.0, 0.0)  # of the point that is named from the middle of the hills


def without_place(placed: FeatureMap) -> UnplacedMap:
    return UnplacedMap(
        map_id="adrift",
        name=placed.name,
        frame=OwnFrame(metric=False, upright=False),
        cameras=placed.cameras,
        camera_keys=placed.camera_keys,
        images=tuple(moved_image(image, OWN_FROM_LOCAL) for image in placed.images),
        points=OwnPoints(
            xyz=OWN_FROM_LOCAL.act(placed.points_local()),
            **placed.points.columns(np.arange(len(placed.points))),
        ),
        observations=placed.observations,
        no_place=NoPlace(reason_code="TOO_FEW", reason="no photo has GPS"),
        extractor_fingerprint=placed.extractor_fingerprint,
    )


def words(made: Path, tmp_path: Path, texture: int, *, laser: bool = False) -> list[str]:
    """The command, on a database with the map and the scan of a field of that texture."""
    placed = Database.open(made / "db").snapshot()
    database = Database.create(tmp_path / "db")
    database.commit_map(without_place(placed.load_map(placed.maps()[0].map_id)))
    scan = write_hill_scan(tmp_path / "scan.laz", texture_seed=texture, half_side_m=35.0, laser=laser)
    add_scan(database, [scan])
    near = FRAME.geodetic_from_enu(_AWAY_M)
    return [
        *("anchor", str(tmp_path / "db"), "adrift", "--photos", str(made / "photos"), "--quiet", "--auto"),
        *("--out", str(tmp_path / "out"), f"--near={near[0]:.6f},{near[1]:.6f},150"),
    ]


@pytest.fixture(scope="module", autouse=True)
def _found_once() -> Iterator[None]:
    """Two tests begin with the same map on the same scan; two frames that agree are enough."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ingest.anchoring.FRAMES", 2)
        patch.setattr(first_place, "found_from_above", remembered(first_place.found_from_above))
        patch.setattr(frames, "register_frame", remembered(frames.register_frame))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hill_map(tmp_path_factory)


def _is_where_it_was_made(tmp_path: Path) -> None:
    placed = Database.open(tmp_path / "db").snapshot().load_map("adrift")
    truth = {photo.name: photo.cam_from_local for photo in hill_photos()}
    frame_from_map = FRAME.enu_from(placed.frame)
    for image in placed.images:
        pose = image.cam_from_local @ frame_from_map.inverse()
        assert np.linalg.norm(pose.center - truth[image.name].center) < 0.3
        assert pose.angle_to_deg(truth[image.name]) < 0.3


def test_the_map_is_found_and_placed(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(made, tmp_path, texture=1)) == 0
    assert "found near" in capsys.readouterr().out
    _is_where_it_was_made(tmp_path)


def test_where_its_picture_from_above_agrees_photos_are_registered(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Intensities that share no features with photos."""
    snapshot = Database.open(made / "db").snapshot()
    frame = snapshot.load_map(snapshot.maps()[0].map_id).frame
    off = Sim3(
        scale=1.02, rotation=so3_exp(np.radians([1.0, -0.5, 1.5])), translation=np.array([1.5, -1.0, 1])
    )

    def about_there(_: UnplacedMap, cloud: PointCloud, photos: PhotoFiles) -> FoundPlace:
        assert len(photos.paths) == len(hill_photos())
        right = Sim3.from_rigid3(cloud.frame.enu_from(frame)) @ off @ OWN_FROM_LOCAL.inverse()
        spread = np.diag(np.square([0.02, 0.03, 0.03, 0.03, 5.0, 5.0, 5.0]))
        words = "its photos agree with the scan's intensity by 9.5 deviations"
        return FoundPlace(local_from_own=right, covariance=spread, evidence=9.5, sure=False, words=words)

    monkeypatch.setattr(first_place, "found_from_above", lambda *_: None)
    monkeypatch.setattr(first_place, "found_by_ortho", about_there)
    assert main(words(made, tmp_path, texture=1, laser=True)) == 0
    assert "agree with the scan's intensity by 9.5 deviations; if no photo" in capsys.readouterr().out
    _is_where_it_was_made(tmp_path)


def test_on_the_scan_of_another_field_it_is_not_found(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(first_place, "found_by_ortho", lambda *_: None)
    assert main(words(made, tmp_path, texture=7)) == 2
    said = capsys.readouterr().err
    assert "map adrift is not found within 150 m" in said
    assert "--page, --picks FILE, --pose FILE" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("near", ["46.8", "46.8,200", "46.8,12.3,-5", "46.8,12.3,5000", "here"])
def test_what_is_no_circle_is_told(near: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anchor", "db", "adrift", "--photos", ".", f"--near={near}"]) == 2
    assert "expected LAT,LON or LAT,LON,RADIUS_M" in capsys.readouterr().err


def test_poses_proposed_from_another_point_are_not_confirmed(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are in the frame of the point that was named."""
    *proposing, near = [word for word in words(made, tmp_path, texture=1) if word != "--auto"]
    assert main([*proposing, near]) == 0
    name = hill_photos()[4].name
    lat, lon, radius = near.removeprefix("--near=").split(",")
    assert main([*proposing, f"--near={float(lat) + 1e-4:.6f},{lon},{radius}", "--confirm", name]) == 2
    assert "by the very words that were printed" in capsys.readouterr().err


def test_a_map_that_has_a_place_is_not_looked_for(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(made / "db", tmp_path / "db", ignore=shutil.ignore_patterns("_work"))
    add_scan(Database.open(tmp_path / "db"), [write_hill_scan(tmp_path / "scan.laz")])
    (placed, *_) = Database.open(tmp_path / "db").snapshot().maps()
    command = ["anchor", str(tmp_path / "db"), placed.map_id, "--photos", str(made / "photos")]
    assert main([*command, "--near=46.8,12.3"]) == 2
    assert "has one. If that is wrong" in capsys.readouterr().err
