"""COLMAP models become maps: our own exports, COLMAP's own features, and every way to say where they lie."""

import json
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from featuredb.cli.main import main
from featuredb.errors import IngestError
from featuredb.export.formats.colmap import write_map
from featuredb.features.exif.write import gps_directory
from featuredb.features.extractor import ExtractorOptions, describe_at, extract
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from ingest.models_in.model_map import ModelOptions, map_of_model
from ingest.models_in.place import Stated
from reloc.localise.localise import localise
from reloc.localise.result import LocaliseRequest
from tests.support import planar_map as field
from tests.support.command_line import only_command
from tests.support.maps import without_place
from tests.support.scenes import indexed

ORIGIN = (field.EASTING, field.NORTHING, field.HEIGHT)
STATED = Stated(axes="enu", epsg=field.EPSG, origin=ORIGIN, sigma_m=(0.05, 0.1))


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    feature_map = field.planar_map(map_id="field")
    images = tuple(replace(i, owner="Ann", licence="CC-BY-4.0") for i in feature_map.images)
    return replace(feature_map, images=images, camera_keys=("maker|model",))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory, field_map: FeatureMap) -> Path:
    """Photos of the field as JPEGs with GPS, and what COLMAP alone makes of them, in the field's frame."""
    folder = tmp_path_factory.mktemp("foreign")
    photos = folder / "photos"
    photos.mkdir()
    texture = field.field_texture(1)
    for k, image in enumerate(field_map.images):
        exif = Image.Exif()
        exif[ExifTags.Base.Make.value], exif[ExifTags.Base.Model.value] = "Maker", "Model"
        place = field_map.frame.geodetic_from_enu(image.cam_from_local.center)
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps_directory((place[0], place[1], place[2])))
        pixels = Image.fromarray(field.render(texture, image.cam_from_local, seed=k)).convert("RGB")
        pixels.save(photos / f"{k}.jpg", quality=95, exif=exif)
    colmap_alone(folder, photos, field_map)
    return folder


def colmap_alone(folder: Path, photos: Path, feature_map: FeatureMap) -> None:
    """COLMAP's SIFT, matches and triangulation at known poses, into `folder`."""
    database = colmap_features(folder, photos)
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = 1
    pycolmap.match_exhaustive(str(database), matching_options=matching)
    opened = pycolmap.Database.open(str(database))
    posed = pycolmap.Reconstruction()
    posed.add_camera_with_trivial_rig(opened.read_camera(1))
    for k, image in enumerate(feature_map.images):
        stored = opened.read_image_with_name(f"{k}.jpg")
        pose = pycolmap.Rigid3d(np.ascontiguousarray(image.cam_from_local.matrix()[:3]))
        named = pycolmap.Image(name=stored.name, camera_id=1, image_id=stored.image_id)
        posed.add_image_with_trivial_frame(named, pose)
    opened.close()
    (folder / "sparse" / "0").mkdir(parents=True)
    made = pycolmap.triangulate_points(posed, str(database), str(photos), str(folder / "sparse" / "0"))
    made.write(str(folder / "sparse" / "0"))


def colmap_features(folder: Path, photos: Path) -> Path:
    """COLMAP's SIFT, into the database in `folder`."""
    database = folder / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = 1
    extraction.sift.max_num_features = 2000
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = "600,600,320,240"
    pycolmap.extract_features(
        str(database),
        str(photos),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    return database


def with_descriptors_of_length_one(database: Path) -> None:
    """RootSIFT, the root of each part of the sum, to what COLMAP's `L2` writes of the same histograms."""
    with closing(sqlite3.connect(database)) as opened, opened:
        for image, data in opened.execute("SELECT image_id, data FROM descriptors").fetchall():
            histograms = np.frombuffer(data, np.uint8).reshape(-1, 128).astype(np.float64) ** 2
            parts = histograms / np.linalg.norm(histograms, axis=1, keepdims=True)
            stored = np.clip(np.round(512.0 * parts), 0, 255).astype(np.uint8)
            opened.execute("UPDATE descriptors SET data = ? WHERE image_id = ?", (stored.tobytes(), image))


def localised(feature_map: FeatureMap) -> Rigid3:
    """Pose of a new photo in `feature_map`'s own frame; its truth is `TRUTH` in that of the field."""
    photo = field.render(field.field_texture(1), TRUTH, seed=91)
    result = localise(photo, LocaliseRequest(camera=field.CAMERA), [indexed(feature_map)])
    assert result.pose is not None, result.detail
    return result.pose.cam_from_local @ result.pose.frame.enu_from(feature_map.frame)


TRUTH = field.view(3.0, 5.0, 42.0, 8.0, 30.0)


def error_m(pose: Rigid3, imported: FeatureMap, truth_map: FeatureMap) -> float:
    """How far a pose in the imported map's frame is from TRUTH."""
    there = truth_map.frame.enu_from(imported.frame).act(pose.center)
    return float(np.linalg.norm(there - TRUTH.center))


@pytest.mark.parametrize("text", [False, True])
def test_an_export_comes_back(tmp_path: Path, field_map: FeatureMap, text: bool) -> None:
    write_map(tmp_path / "field", field_map, text=text)
    back = map_of_model(tmp_path / "field", ModelOptions())
    assert (back.epsg, back.height_datum, back.frame) == (field.EPSG, "ellipsoidal", field_map.frame)
    assert (back.status, back.placement.method, back.name) == ("active", "gcp", field_map.name)
    np.testing.assert_array_equal(back.placement.covariance, field_map.placement.covariance)
    assert back.extractor_fingerprint == field_map.extractor_fingerprint
    assert back.cameras == field_map.cameras
    assert back.camera_keys == field_map.camera_keys
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


def test_a_map_without_a_place_comes_back_without_one(
    tmp_path: Path, field_map: FeatureMap, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unplaced = without_place(field_map)
    write_map(tmp_path / "field", unplaced)
    with only_command(monkeypatch, "ingest", "ingest.cli.ingest:register"):
        assert main(["ingest", "model", str(tmp_path / "db"), str(tmp_path / "field")]) == 0
    assert "committed, without a place, 9 photos" in capsys.readouterr().out
    (summary,) = Database.open(tmp_path / "db").snapshot().unplaced_maps()
    back = Database.open(tmp_path / "db").snapshot().load_unplaced(summary.map_id)
    assert (back.no_place.reason_code, back.name) == ("TOO_FEW", field_map.name)
    assert "featuredb grow DB" in back.no_place.ways[-1]
    assert isinstance(back, UnplacedMap)
    seen, was = back.observations, unplaced.observations
    assert (len(back.points), len(seen)) == (len(unplaced.points), len(was))
    pixels = back.cameras[0].project(back.images[0].cam_from_local.act(back.points.xyz[seen.point_index]))
    mine = seen.image_id == back.images[0].image_id
    assert np.abs(pixels[mine] - seen.xy[mine]).max() < 5.0  # the same model, of whatever size


def test_a_map_that_maps_had_placed_comes_in_quarantine(tmp_path: Path, field_map: FeatureMap) -> None:
    placed = replace(field_map.placement, method="map")
    write_map(tmp_path / "a", replace(field_map, placement=placed, parents=("gone",), generation=1))
    back = map_of_model(tmp_path / "a", ModelOptions())
    assert (back.status, back.parents, back.placement.method) == ("quarantined", (), "map")


def test_keypoints_without_descriptors_stay_without(tmp_path: Path, field_map: FeatureMap) -> None:
    seen = field_map.observations
    kept = np.arange(len(seen)) % 3 != 0
    thinned = replace(
        seen, has_descriptor=kept, descriptors=np.where(kept[:, None], seen.descriptors, np.uint8(0))
    )
    write_map(tmp_path / "a", replace(field_map, observations=thinned))
    back = map_of_model(tmp_path / "a", ModelOptions())
    assert len(back.observations) == len(seen)
    assert int(back.observations.has_descriptor.sum()) == int(kept.sum())


@pytest.mark.parametrize("descriptors", ["stored", "photos"])
def test_colmaps_own_features_answer_our_queries(
    foreign: Path, field_map: FeatureMap, descriptors: Any
) -> None:
    """A map of nothing but COLMAP's keypoints: this system's localiser finds the truth to 5 cm in it."""
    options = ModelOptions(photos=foreign / "photos", stated=STATED, descriptors=descriptors)
    made = map_of_model(foreign, options)
    assert made.extractor_fingerprint == ExtractorOptions().fingerprint
    assert len(made.points) > 300
    assert error_m(localised(made), made, field_map) < 0.05
    assert np.abs(made.points.utm[:, 2] - field.HEIGHT).max() < 0.5
    assert made.height_datum == "unknown"
    for image, original in zip(made.images, field_map.images, strict=True):
        there = field_map.frame.enu_from(made.frame).act(image.cam_from_local.center)
        np.testing.assert_allclose(there, original.cam_from_local.center, atol=1e-6)


def test_the_photos_gps_places_a_model_of_any_scale(
    tmp_path: Path, foreign: Path, field_map: FeatureMap
) -> None:
    """Turned, moved and scaled, as a model is that knows of no place; the geotags here are exact."""
    moved(
        foreign, tmp_path / "m", pycolmap.Sim3d(0.03, pycolmap.Rotation3d([0.2, 0.5, 0.1]), [5.0, 6.0, 7.0])
    )
    made = map_of_model(tmp_path / "m", ModelOptions(photos=foreign / "photos"))
    assert made.placement.method == "gps"
    assert made.placement.local_from_sfm.scale == pytest.approx(1 / 0.03, rel=1e-3)
    assert error_m(localised(made), made, field_map) < 0.05


def test_utm_and_geocentric_coordinates(tmp_path: Path, foreign: Path, field_map: FeatureMap) -> None:
    frame = field_map.frame
    ecef = frame.ecef_from_enu()
    moved(
        foreign, tmp_path / "ecef", pycolmap.Sim3d(1.0, pycolmap.Rotation3d(ecef.rotation), ecef.translation)
    )
    stated = Stated(axes="ecef", epsg=field.EPSG, origin=(0.0, 0.0, 0.0), sigma_m=(0.1, 0.1))
    made = map_of_model(tmp_path / "ecef", ModelOptions(photos=foreign / "photos", stated=stated))
    assert error_m(localised(made), made, field_map) < 0.05

    grid = frame.grid_from_enu((0.0, 0.0, 0.0), field.EPSG)
    shift = np.array([300.0, -200.0, 0.0])
    moved(foreign, tmp_path / "utm", pycolmap.Sim3d(0.9996, pycolmap.Rotation3d(grid), shift))
    stated = Stated(axes="utm", epsg=field.EPSG, origin=tuple(np.array(ORIGIN) - shift), sigma_m=(0.1, 0.1))  # type: ignore[arg-type]
    made = map_of_model(tmp_path / "utm", ModelOptions(photos=foreign / "photos", stated=stated))
    assert error_m(localised(made), made, field_map) < 0.1
    assert np.abs(made.points.utm[:, 2] - field.HEIGHT).max() < 0.5


def moved(source: Path, target: Path, target_from_source: Any) -> None:
    """A copy of the model in other coordinates."""
    model = pycolmap.Reconstruction(str(source / "sparse" / "0"))
    model.transform(target_from_source)
    (target / "sparse").mkdir(parents=True)
    model.write(str(target / "sparse"))
    shutil.copy(source / "database.db", target / "database.db")


def test_our_descriptors_at_our_keypoints_are_those_of_the_extractor() -> None:
    """A keypoint's diameter leads back to its octave and layer."""
    photo = field.render(field.field_texture(1), TRUTH, seed=1)
    found = extract(photo)
    assert len(found) > 1000
    again = describe_at(photo, found.xy, found.scale, found.angle)
    difference = np.linalg.norm(again.astype(float) - found.descriptors, axis=1)
    assert np.median(difference) == 0.0  # places are rounded once more
    assert difference.max() < 40.0


class TestRefusals:
    def test_descriptors_that_are_no_rootsift(
        self, tmp_path: Path, foreign: Path, field_map: FeatureMap
    ) -> None:
        # Where keypoints are, and so the model, is the same for every normalisation of their descriptors.
        shutil.copytree(foreign, tmp_path, dirs_exist_ok=True)
        with_descriptors_of_length_one(tmp_path / "database.db")
        options = ModelOptions(photos=foreign / "photos", stated=STATED)
        with pytest.raises(IngestError, match="expected RootSIFT"):
            map_of_model(tmp_path, options)
        anew = map_of_model(tmp_path, replace(options, descriptors="photos"))
        assert error_m(localised(anew), anew, field_map) < 0.05

    def test_what_is_missing_is_named(self, tmp_path: Path, foreign: Path) -> None:
        options = ModelOptions(photos=foreign / "photos", stated=STATED)
        with pytest.raises(IngestError, match="expected a COLMAP model"):
            map_of_model(tmp_path, options)
        with pytest.raises(IngestError, match="expected this photo of the model in --photos"):
            map_of_model(foreign, replace(options, photos=None))
        with pytest.raises(IngestError, match="expected COLMAP's database"):
            map_of_model(foreign, replace(options, colmap_database=tmp_path / "none.db"))
        with pytest.raises(IngestError, match="to make them of, found none"):
            map_of_model(foreign, replace(options, photos=None, descriptors="photos"))
        shutil.copytree(foreign / "sparse", tmp_path / "sparse")
        (tmp_path / "sparse" / "0" / "points3D.bin").write_bytes(b"\x01\0\0")
        with pytest.raises(IngestError, match="break off after 0 records"):
            map_of_model(tmp_path, options)

    def test_a_database_of_another_model(self, tmp_path: Path, foreign: Path, field_map: FeatureMap) -> None:
        write_map(tmp_path / "field", field_map)
        with pytest.raises(IngestError, match=r"expected this image|disagree"):
            map_of_model(tmp_path / "field", ModelOptions(colmap_database=foreign / "database.db"))

    def test_coordinates_that_are_not_what_is_said(self, foreign: Path) -> None:
        options = ModelOptions(photos=foreign / "photos")
        with pytest.raises(IngestError, match="Earth's centre"):
            map_of_model(foreign, replace(options, stated=replace(STATED, axes="ecef")))

    def test_a_broken_georeference(self, tmp_path: Path, field_map: FeatureMap) -> None:
        write_map(tmp_path / "a", field_map)
        with pytest.raises(IngestError, match="says that heights are ellipsoidal"):
            map_of_model(tmp_path / "a", ModelOptions(height_datum="egm96"))
        path = tmp_path / "a" / "georeference.json"
        document = json.loads(path.read_text())
        image = document["images"][0]
        for change, message in (
            ({"format": "other"}, "expected the format"),
            ({"placement": {}}, "broken or incomplete"),
            ({"images": [{"name": "0.png"}]}, "expected images with name, original_name and sha256"),
            ({"images": [image | {"gps": {"latitude_deg": "x"}}]}, "0.png: broken time or position"),
            ({"images": [image | {"capture_time": "noon"}]}, "0.png: broken time or position"),
        ):
            path.write_text(json.dumps(document | change))
            with pytest.raises(IngestError, match=message):
                map_of_model(tmp_path / "a", ModelOptions())
        path.write_text("not json")
        with pytest.raises(IngestError, match="expected JSON"):
            map_of_model(tmp_path / "a", ModelOptions())


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
        said = capsys.readouterr().out
        assert "committed, 9 photos" in said
        assert "EPSG:32632, placed by gcp" in said
        assert main(argv) == 0
        assert "there already" in capsys.readouterr().out
        (summary,) = Database.open(tmp_path / "db").snapshot().maps()
        assert summary.points == len(field_map.points)

    @pytest.mark.parametrize(
        ("argv", "message"),
        [
            (("--epsg", "32632"), "found no --origin and no --sigma"),
            (("--epsg", "32632", "--origin", "1,2"), "expected easting,northing,height"),
            (("--epsg", "4326", "--origin", "4e5,5e6,0", "--sigma", "0.1"), "UTM zone"),
            (("--axes", "ecef", "--origin", "1,2,3", "--epsg", "32632"), "leave it out"),
            (("--sigma", "-1"), "expected"),
            (("--height-datum", "sea"), "height datum: expected one of"),
        ],
    )
    def test_bad_arguments(
        self,
        tmp_path: Path,
        foreign: Path,
        capsys: pytest.CaptureFixture[str],
        argv: tuple[str, ...],
        message: str,
    ) -> None:
        photos = ("--photos", str(foreign / "photos"))
        assert main(["ingest", "model", str(tmp_path / "db"), str(foreign), *photos, *argv]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "db").exists()
