"""kapture's reconstructions become maps: our own exports, one with a rig written by hand, and refusals."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import IngestError
from featuredb.export.formats.kapture import write_map
from featuredb.features.extractor import ExtractorOptions
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from ingest.models_in.kapture_folder import read_kapture
from ingest.models_in.model_map import ModelOptions, map_of_model
from ingest.models_in.place import Stated
from tests.integration.test_ingest_model import error_m, localised
from tests.integration.test_ingest_opensfm import gps_of
from tests.support import planar_map as field
from tests.support.command_line import only_command
from tests.support.field_photos import with_photos

ORIGIN = (field.EASTING, field.NORTHING, field.HEIGHT)
STATED = Stated(axes="enu", epsg=field.EPSG, origin=ORIGIN, sigma_m=(0.05, 0.1))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("photos")


@pytest.fixture(scope="module")
def field_map(photos: Path) -> FeatureMap:
    return with_photos(field.planar_map(map_id="field"), photos)


def test_an_export_comes_back(tmp_path: Path, field_map: FeatureMap) -> None:
    """Bit for bit, but for what is computed anew; without a photo."""
    write_map(tmp_path / "field", field_map)
    back = map_of_model(tmp_path / "field", ModelOptions())
    assert (back.epsg, back.height_datum, back.frame) == (field.EPSG, "ellipsoidal", field_map.frame)
    assert (back.status, back.placement.method, back.name) == ("active", "gcp", field_map.name)
    np.testing.assert_array_equal(back.placement.covariance, field_map.placement.covariance)
    assert back.extractor_fingerprint == field_map.extractor_fingerprint
    assert (back.cameras, back.camera_keys) == (field_map.cameras, field_map.camera_keys)
    for one, other in zip(back.images, field_map.images, strict=True):
        assert (one.name, one.sha256, one.owner, one.licence) == (
            other.name, other.sha256, other.owner, other.licence,
        )  # fmt: skip
        np.testing.assert_allclose(one.cam_from_local.matrix(), other.cam_from_local.matrix(), atol=1e-9)
    np.testing.assert_allclose(back.points.utm, field_map.points.utm, atol=1e-6)
    order = [
        np.lexsort((m.observations.xy[:, 0], m.observations.image_id, m.observations.point_index))
        for m in (back, field_map)
    ]
    for name in ("point_index", "image_id", "xy", "scale", "descriptors", "has_descriptor"):
        mine, theirs = (
            getattr(m.observations, name)[rows] for m, rows in zip((back, field_map), order, strict=True)
        )
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    assert np.linalg.norm(localised(back).center - localised(field_map).center) < 0.002
    assert map_of_model(tmp_path / "field", ModelOptions()).map_id == back.map_id


def test_without_its_place_a_person_or_the_receiver_gives_it(
    tmp_path: Path, field_map: FeatureMap, photos: Path
) -> None:
    """The receiver is 2 m beside the truth and says no dilution, so it has the accuracy of any GPS."""
    gps_map = replace(field_map, images=tuple(replace(i, gps=gps_of(field_map, i)) for i in field_map.images))
    write_map(tmp_path / "m", gps_map)
    (tmp_path / "m" / "georeference.json").unlink()
    stated = map_of_model(tmp_path / "m", ModelOptions(photos=photos, stated=STATED))
    assert error_m(localised(stated), stated, field_map) < 0.05
    assert stated.extractor_fingerprint == ExtractorOptions().fingerprint
    by_gps = map_of_model(tmp_path / "m", ModelOptions(photos=photos))
    assert by_gps.placement.method == "gps"
    assert error_m(localised(by_gps), by_gps, field_map) == pytest.approx(2.0, abs=0.05)
    assert by_gps.images[0].gps is not None
    assert by_gps.images[0].gps.sigma_horizontal_m == 4.0
    (tmp_path / "m" / "sensors" / "records_gnss.txt").unlink()
    assert isinstance(map_of_model(tmp_path / "m", ModelOptions(photos=photos)), UnplacedMap)


def test_descriptors_of_another_kind_are_made_anew_of_the_photos_beside_it(
    tmp_path: Path, field_map: FeatureMap, photos: Path
) -> None:
    write_map(tmp_path / "m", field_map)
    kind = tmp_path / "m" / "reconstruction" / "descriptors" / "sift" / "descriptors.txt"
    kind.write_text(kind.read_text().replace("uint8, 128", "float32, 128"))
    with pytest.raises(IngestError, match="expected --photos FOLDER to make them of"):
        map_of_model(tmp_path / "m", ModelOptions())
    (tmp_path / "m" / "sensors" / "records_data").symlink_to(photos)
    back = map_of_model(tmp_path / "m", ModelOptions())
    mine, theirs = back.observations, field_map.observations
    assert len(mine) == len(theirs)
    order = [np.lexsort((o.xy[:, 0], o.image_id, o.point_index)) for o in (mine, theirs)]
    same = (mine.descriptors[order[0]] == theirs.descriptors[order[1]]).all(axis=1)
    assert same.mean() > 0.9  # at the extractor's own keypoints they are its own, but for angles in radians
    assert error_m(localised(back), back, field_map) < 0.05


# Two cameras on a rig that stands at (10, 0, 0), turned by 90 degrees about z: world to rig is (x, y, z) ->
# (-y, x - 10, z). The right one is 1 m along the rig's x, so rig to right takes 1 off. Both look along z.
SENSORS, RECORDS = "sensors/sensors.txt", "sensors/records_camera.txt"
TRAJECTORIES = "sensors/trajectories.txt"
POINTS, SEEN = "reconstruction/points3d.txt", "reconstruction/observations.txt"
KEYPOINT_KIND = "reconstruction/keypoints/sift/keypoints.txt"
RIGHT = "reconstruction/keypoints/sift/b/r.jpg.kpt"
HAND = {
    SENSORS: "left, , camera, SIMPLE_PINHOLE, 1000, 800, 900, 500, 400\n"
    "spare, , camera, UNKNOWN_CAMERA, 1, 1\n"
    "right, , camera, RADIAL, 1000, 800, 900, 500, 400, 0.1, 0\n"
    "GPS_left, , gnss, EPSG:4326\nGPS_right, , gnss, EPSG:25832\n",
    "sensors/rigs.txt": "rig, left, 1, 0, 0, 0, 0, 0, 0\nrig, right, 1, 0, 0, 0, -1, 0, 0\n",
    TRAJECTORIES: "7, rig, 0.7071067811865476, 0, 0, 0.7071067811865476, 0, -10, 0\n"
    "8, rig, , , , , 0, 0, 0\n",
    RECORDS: "7, right, b/r.jpg\n7, left, a/l.jpg\n8, left, a/no pose.jpg\n",
    "sensors/records_gnss.txt": "7, GPS_left, 11.5, 48.25, 500, 0, 2\n7, GPS_right, 4e5, 5e6, 1, 0, 1\n",
    POINTS: "10, -1, 10\n11, 0, 20\n12, 3, 20\n",
    SEEN: "0, sift, a/l.jpg, 1, b/r.jpg, 0\n1, sift, a/l.jpg, 0, b/r.jpg, 1\n"
    "2, sift, a/l.jpg, 0, a/no pose.jpg, 99\n",
    KEYPOINT_KIND: "SIFT, float64, 4\n",
}
# Point 0 in the rig is (1, 0, 10): left sees it at x = 500 + 90, right at the middle. Point 1 is (0, 1, 20):
# left sees it at y = 400 + 45, right at (-1, 1, 20), with r^2 = 0.005 and so 45 * 1.0005 from the middle.
KEYPOINTS = {
    "a/l.jpg": [[500.0, 445.0, 2.0, 0.0], [590.0, 400.0, 3.0, np.pi / 2]],
    "b/r.jpg": [[500.0, 400.0, 1.5, 0.0], [500.0 - 45.0225, 400.0 + 45.0225, 1.0, -np.pi / 2]],
}


def write_hand(folder: Path) -> Path:
    for name, text in HAND.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("# kapture format: 1.1\n# columns\n\n" + text)
    for name, rows in KEYPOINTS.items():
        path = folder / "reconstruction" / "keypoints" / "sift" / f"{name}.kpt"
        path.parent.mkdir(parents=True)
        np.array(rows).tofile(path)
    return folder


def test_a_rig_by_hand(tmp_path: Path) -> None:
    read = read_kapture(write_hand(tmp_path))
    stored, model = read.stored, read.stored.model
    assert stored.names == ("a/l.jpg", "b/r.jpg")
    assert stored.camera_ids == (1, 3)
    np.testing.assert_allclose(model.centers(), [[10.0, 0.0, 0.0], [10.0, -1.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(model.xyz, [[10.0, -1.0, 10.0], [11.0, 0.0, 20.0]])
    assert (model.point_of.tolist(), model.photo_of.tolist()) == ([0, 0, 1, 1], [0, 1, 0, 1])
    assert model.keypoint_of.tolist() == [1, 0, 0, 1]
    for point, photo, keypoint in zip(model.point_of, model.photo_of, model.keypoint_of, strict=True):
        camera = model.cameras[int(model.camera_of[photo])]
        drawn = camera.project(model.cam_from_sfm[photo].act(model.xyz[point]))[0]
        np.testing.assert_allclose(drawn, stored.xy[photo][keypoint], atol=1e-9)
    assert stored.rgb.tolist() == [[128, 128, 128]] * 2
    assert read.gps[1] is None  # of another system
    assert read.gps[0] is not None
    assert (read.gps[0].latitude_deg, read.gps[0].longitude_deg) == (48.25, 11.5)
    assert not read.has_descriptors


@pytest.mark.slow  # compiles for a minute or two when it is first imported
def test_what_kaptures_own_package_writes(tmp_path: Path, field_map: FeatureMap) -> None:
    """Our export, read and written by it: padded columns, points of ten digits."""
    pytest.importorskip("kapture", reason="kapture's own package is not installed")
    kapture_csv: Any = pytest.importorskip("kapture.io.csv")
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    write_map(ours, field_map)
    kapture_csv.kapture_to_dir(str(theirs), kapture_csv.kapture_from_dir(str(ours)))
    for kind in ("keypoints", "descriptors"):
        for path in (ours / "reconstruction" / kind / "sift").glob("*.png.*"):
            shutil.copy(path, theirs / "reconstruction" / kind / "sift")
    shutil.copy(ours / "georeference.json", theirs)
    mine, back = (map_of_model(folder, ModelOptions()) for folder in (ours, theirs))
    assert back.cameras == mine.cameras
    np.testing.assert_allclose(back.points.utm, mine.points.utm, atol=1e-6)
    np.testing.assert_array_equal(back.observations.descriptors, mine.observations.descriptors)
    for one, other in zip(back.images, mine.images, strict=True):
        np.testing.assert_allclose(one.cam_from_local.matrix(), other.cam_from_local.matrix(), atol=1e-9)


def test_of_several_kinds_of_keypoints_sift_is_taken(tmp_path: Path) -> None:
    path = write_hand(tmp_path) / SEEN
    path.write_text(path.read_text() + "0, r2d2, a/l.jpg, 99, b/r.jpg, 99\n")
    folder = tmp_path / "reconstruction" / "keypoints" / "sift"
    assert all(path.is_relative_to(folder) for path in read_kapture(tmp_path).feature_files)


class TestRefusals:
    @pytest.mark.parametrize(
        ("file", "old", "new", "message"),
        [
            (SENSORS, "format: 1.1", "format: 1.0", "found '# kapture format: 1.0'; bring it"),
            (SENSORS, "SIMPLE_PINHOLE", "FOV", "found 'FOV'; undistort"),
            (SENSORS, "1000, 800, 900, 500, 400\n", "1000\n", "size in whole pixels"),
            (SENSORS, "900, 500, 400\n", "nan, 500, 400\n", "numbers, found 1000, 800, nan"),
            (SENSORS, "left, , camera", "left, , lidar", "expected a camera of"),
            (RECORDS, "7, right", "x, right", "expected a timestamp, found 'x'"),
            (RECORDS, "b/r.jpg", "../r.jpg", "a path below records_data"),
            (RECORDS, "b/r.jpg", "a/l.jpg", "every image once"),
            (RECORDS, "7, ", "9, ", "with a pose, found 3 images and 3 poses"),
            (TRAJECTORIES, "0.7071067811865476", "0", "expected a length > 0"),
            (TRAJECTORIES, ", -10, 0", "", "line 4: expected 9 values, found 7"),
            ("sensors/rigs.txt", "rig, right", "rig, rig", "found 'rig', a rig, in one"),
            ("sensors/records_gnss.txt", "48.25", "98.25", "latitude in"),
            (POINTS, "11, 0, 20", "11, 0", "expected at least 3 values, found 2"),
            (POINTS, "11, 0, 20", "11, 0, 20, 5, 5, 5", "expected points of X, Y, Z"),
            (POINTS, "12, 3, 20", "inf, 3, 20", "finite numbers, found inf"),
            (SEEN, "0, sift", "-1, sift", "a number from 0 to 2, found '-1'"),
            (SEEN, "2, sift", "3, sift", "a number from 0 to 2, found '3'"),
            (SEEN, "b/r.jpg, 1", "b/r.jpg, 2", "from 0 to 1, found '2'"),
            (SEEN, "b/r.jpg, 1", "b/r.jpg", "pairs of image and keypoint, found 3"),
            (SEEN, "b/r.jpg, 1", "c.jpg, 1", "an image of records_camera.txt"),
            (SEEN, "sift", "../x", "expected the name of a folder"),
            (SEEN, "1, sift", "1, r2d2-sift", "expected observations of one kind"),
            (SEEN, ", b/r.jpg", ", a/no pose.jpg", "points that two images see, found none"),
            (KEYPOINT_KIND, "float64, 4", "float64, 3", "found 3 values: these are no SIFT"),
            (KEYPOINT_KIND, "float64, 4", "int8, 4", "found 'int8'"),
            (KEYPOINT_KIND, "float64, 4", "float64, 6", "rows of 48 bytes, found 64"),
        ],
    )
    def test_broken_files(self, tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
        path = write_hand(tmp_path) / file
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(IngestError, match=message):
            read_kapture(tmp_path)

    @pytest.mark.parametrize("name", [SENSORS, RECORDS, TRAJECTORIES, POINTS, SEEN, KEYPOINT_KIND, RIGHT])
    def test_files_that_are_missing(self, tmp_path: Path, name: str) -> None:
        (write_hand(tmp_path) / name).unlink()
        with pytest.raises(IngestError, match="cannot be read"):
            read_kapture(tmp_path)

    def test_archives_and_features_that_are_cut_off(self, tmp_path: Path) -> None:
        kind = write_hand(tmp_path) / "reconstruction" / "keypoints" / "sift"
        (kind / "keypoints.tar").write_bytes(b"")
        with pytest.raises(IngestError, match="unpack the archive"):
            read_kapture(tmp_path)
        (kind / "keypoints.tar").unlink()
        (kind / "a" / "l.jpg.kpt").write_bytes(b"x" * 65)
        with pytest.raises(IngestError, match="rows of 32 bytes, found 65 bytes: the file is cut off"):
            read_kapture(tmp_path)
        np.full((2, 4), np.nan).tofile(kind / "a" / "l.jpg.kpt")
        with pytest.raises(IngestError, match="expected finite numbers"):
            read_kapture(tmp_path)

    def test_descriptors_that_do_not_belong(self, tmp_path: Path, field_map: FeatureMap) -> None:
        write_map(tmp_path, field_map)
        path = tmp_path / "reconstruction" / "descriptors" / "sift" / "0.png.desc"
        path.write_bytes(path.read_bytes()[:-128])
        with pytest.raises(IngestError, match=r"0.png.desc: expected descriptors of \d+ keypoints"):
            map_of_model(tmp_path, ModelOptions())
        path.write_bytes(np.full((np.fromfile(path, np.uint8).size + 128), 90, np.uint8).tobytes())
        with pytest.raises(IngestError, match="expected RootSIFT"):
            map_of_model(tmp_path, ModelOptions())
        with pytest.raises(IngestError, match=r"found one of kapture in .*; leave it out"):
            map_of_model(tmp_path, ModelOptions(colmap_database=tmp_path / "x.db"))
        with pytest.raises(IngestError, match=r"--reconstruction: expected OpenSfM's"):
            map_of_model(tmp_path, ModelOptions(reconstruction=0))


class TestCommand:
    @pytest.fixture(autouse=True)
    def _only_this(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        with only_command(monkeypatch, "ingest", "ingest.cli.ingest:register"):
            yield

    def test_commits_once(
        self, tmp_path: Path, field_map: FeatureMap, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_map(tmp_path / "field", field_map)
        argv = ["ingest", "model", str(tmp_path / "db"), str(tmp_path / "field")]
        assert main(argv) == 0
        assert "committed, 9 photos" in capsys.readouterr().out
        assert main(argv) == 0
        assert "there already" in capsys.readouterr().out
        (summary,) = Database.open(tmp_path / "db").snapshot().maps()
        assert summary.points == len(field_map.points)
        document = json.loads((tmp_path / "field" / "georeference.json").read_text())
        assert document["map"]["id"] == "field"

    def test_an_accuracy_needs_a_place(
        self, tmp_path: Path, field_map: FeatureMap, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_map(tmp_path / "field", field_map)
        argv = ["ingest", "model", str(tmp_path / "db"), str(tmp_path / "field"), "--sigma", "0.1"]
        assert main(argv) == 2
        assert "found no --epsg and no --origin, and no reference" in capsys.readouterr().err
        assert not (tmp_path / "db").exists()
