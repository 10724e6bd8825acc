"""OpenSfM's reconstructions become maps: our own exports, one written by hand, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import IngestError
from featuredb.export.formats.opensfm import write_map
from featuredb.features.extractor import ExtractorOptions
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.maps.unplaced_map import UnplacedMap
from ingest.models_in.model_map import ModelOptions, map_of_model
from ingest.models_in.opensfm_folder import read_opensfm
from ingest.models_in.stored import ModelSource
from tests.integration.test_ingest_model import error_m, localised
from tests.support import planar_map as field
from tests.support.field_photos import with_photos
from tests.support.opensfm_folder import ROWS, TINY, tracks, write_tiny


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("photos")


@pytest.fixture(scope="module")
def field_map(photos: Path) -> FeatureMap:
    return with_photos(field.planar_map(map_id="field"), photos)


def same_geometry(back: FeatureMap, feature_map: FeatureMap) -> None:
    """Poses to 1e-9 m in the same frame, points to 1e-6 m, keypoints to 1e-6 px, in the same order."""
    for one, other in zip(back.images, feature_map.images, strict=True):
        assert (one.name, one.sha256) == (other.name, other.sha256)
        to_there = feature_map.frame.enu_from(back.frame)
        np.testing.assert_allclose(
            (one.cam_from_local @ to_there.inverse()).matrix(), other.cam_from_local.matrix(), atol=1e-9
        )
    np.testing.assert_allclose(back.points.utm, feature_map.points.utm, atol=1e-6)
    np.testing.assert_array_equal(back.points.rgb, feature_map.points.rgb)
    theirs, mine = feature_map.observations, back.observations
    order = [np.lexsort((o.xy[:, 0], o.image_id, o.point_index)) for o in (mine, theirs)]
    for name, atol in (("point_index", 0), ("image_id", 0), ("xy", 1e-6), ("scale", 1e-5)):
        np.testing.assert_allclose(
            getattr(mine, name)[order[0]], getattr(theirs, name)[order[1]], rtol=0, atol=atol, err_msg=name
        )


def test_an_export_comes_back(tmp_path: Path, field_map: FeatureMap, photos: Path) -> None:
    """With place, owners and licences by georeference.json; descriptors are those of the photos."""
    write_map(tmp_path / "field", field_map)
    options = ModelOptions(photos=photos)
    back = map_of_model(tmp_path / "field", options)
    assert (back.epsg, back.height_datum, back.frame) == (field.EPSG, "ellipsoidal", field_map.frame)
    assert (back.status, back.placement.method, back.name) == ("active", "gcp", field_map.name)
    np.testing.assert_array_equal(back.placement.covariance, field_map.placement.covariance)
    assert back.extractor_fingerprint == ExtractorOptions().fingerprint
    assert back.camera_keys == field_map.camera_keys
    assert {(i.owner, i.licence) for i in back.images} == {("Ann", "CC-BY-4.0")}
    same_geometry(back, field_map)
    pixels = np.array([[0.3, -0.2, 1.0], [0.0, 0.1, 1.0]])
    np.testing.assert_allclose(
        back.cameras[0].project(pixels), field_map.cameras[0].project(pixels), atol=1e-9
    )
    assert np.linalg.norm(localised(back).center - localised(field_map).center) < 0.01
    assert map_of_model(tmp_path / "field", options).map_id == back.map_id


def test_its_own_reference_with_an_accuracy_that_a_person_states(
    tmp_path: Path, field_map: FeatureMap, photos: Path
) -> None:
    write_map(tmp_path / "field", field_map)
    (tmp_path / "field" / "georeference.json").unlink()
    back = map_of_model(tmp_path / "field", ModelOptions(photos=photos, sigma_m=(0.05, 0.1)))
    assert (back.frame, back.epsg, back.placement.method) == (field_map.frame, field.EPSG, "gcp")
    np.testing.assert_allclose(np.diag(back.placement.covariance)[4:], [0.0025, 0.0025, 0.01])
    same_geometry(back, field_map)
    other = map_of_model(tmp_path / "field", ModelOptions(photos=photos, sigma_m=(0.1, 0.1)))
    assert other.map_id != back.map_id


def test_the_shots_gps_places_it_by_the_ordinary_gates(
    tmp_path: Path, field_map: FeatureMap, photos: Path
) -> None:
    """The photos' files have none; the shots say what their photos had said: 2 m beside the truth, to 4 m."""
    gps_map = replace(field_map, images=tuple(replace(i, gps=gps_of(field_map, i)) for i in field_map.images))
    folder = tmp_path / "opensfm"
    write_map(folder, gps_map)
    (folder / "georeference.json").unlink()
    back = map_of_model(tmp_path, ModelOptions(photos=photos))
    assert back.placement.method == "gps"
    assert back.placement.local_from_sfm.scale == pytest.approx(1.0, abs=1e-6)
    assert error_m(localised(back), back, field_map) == pytest.approx(2.0, abs=0.05)
    assert np.sqrt(back.placement.covariance[4, 4]) > 0.5
    assert back.images[0].gps is not None
    assert back.images[0].gps.sigma_horizontal_m == 4.0


def gps_of(feature_map: FeatureMap, image: Any) -> GeoPrior:
    beside = image.cam_from_local.center + np.array([2.0, 0.0, 0.0])
    latitude, longitude, height = feature_map.frame.geodetic_from_enu(beside)
    return GeoPrior(
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        sigma_horizontal_m=4.0,
        sigma_vertical_m=10.0,
    )


def test_no_accuracy_is_made_up(tmp_path: Path, field_map: FeatureMap, photos: Path) -> None:
    """A reference alone, without GPS of photos or shots, places nothing; the map is kept without a place."""
    write_map(tmp_path / "field", field_map)
    (tmp_path / "field" / "georeference.json").unlink()
    made = map_of_model(tmp_path / "field", ModelOptions(photos=photos))
    assert isinstance(made, UnplacedMap)
    assert made.no_place.reason_code == "TOO_FEW"
    assert "--epsg, --origin and --sigma" in made.no_place.ways[0]


def diameters(read: ModelSource) -> list[NDArray[np.float32]]:
    """Of each image's keypoints, pixels."""
    with read.open_keypoints() as keypoints:
        return [keypoints(k, False).scale for k in range(len(read.stored.names))]


@pytest.mark.parametrize("version", [1, 2])
def test_a_reconstruction_by_hand(tmp_path: Path, version: int) -> None:
    read = read_opensfm(write_tiny(tmp_path, version=version))
    stored = read.stored
    assert stored.names == ("a.jpg", "b.jpg")
    np.testing.assert_allclose(stored.xy[0], [[590.0, 400.0], [500.0, 310.0]], atol=1e-9)
    np.testing.assert_allclose(stored.xy[1], [[635.0, 400.0], [590.0, 490.0]], atol=1e-9)
    np.testing.assert_allclose(np.concatenate(diameters(read)), [4.0, 2.0, 3.0, 8.0], rtol=1e-6)
    model = stored.model
    np.testing.assert_allclose(model.centers(), [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(model.xyz, [[1.0, 0.0, 10.0], [0.0, -2.0, 20.0]])
    assert model.point_of.tolist() == [0, 0, 1, 1]
    assert model.photo_of.tolist() == [0, 1, 0, 1]
    assert model.keypoint_of.tolist() == [0, 1, 1, 0]
    assert stored.rgb.tolist() == [[255, 128, 0], [1, 2, 3]]
    assert read.reference is not None
    assert (read.reference.latitude_deg, read.reference.height_m) == (48.0, 500.0)
    assert read.gps[1] is None
    assert read.gps[0] is not None
    assert (read.gps[0].sigma_horizontal_m, read.gps[0].sigma_vertical_m) == (5.0, 12.5)
    # Half a metre east, along the parallel of 48 degrees north, 500 m above the ellipsoid.
    degrees = np.degrees(
        0.5 / ((6378137.0 / np.sqrt(1 - 0.00669437999014 * 0.5522642316) + 500) * 0.66913060636)
    )
    assert read.gps[0].longitude_deg - 11.0 == pytest.approx(degrees, rel=1e-6)


def test_a_camera_that_no_shot_has_may_be_any(tmp_path: Path) -> None:
    cameras = {"before": {"projection_type": "spherical", "width": 2, "height": 1}} | TINY["cameras"]
    (write_tiny(tmp_path) / "reconstruction.json").write_text(json.dumps([TINY | {"cameras": cameras}]))
    stored = read_opensfm(tmp_path).stored
    assert stored.camera_ids == (2,)
    assert [camera.width for camera in stored.model.cameras] == [1000]
    assert stored.model.camera_of.tolist() == [0, 0]


def test_what_opensfm_leaves_out_by_its_residual_is_left_out(tmp_path: Path) -> None:
    """Of three that see point 7 one is 20 px beside it."""
    rows = [*ROWS, ("unseen.jpg", "7", "5", "0.11", "0.0", "0.004")]
    (write_tiny(tmp_path) / "tracks.csv").write_text(tracks(rows))
    assert read_opensfm(tmp_path).stored.names == ("a.jpg", "b.jpg")


def test_opendronemaps_projected_coordinates_are_not_taken(tmp_path: Path) -> None:
    write_tiny(tmp_path, "reconstruction.topocentric.json")
    (tmp_path / "reconstruction.json").write_text("[]")
    np.testing.assert_array_equal(read_opensfm(tmp_path).stored.model.xyz[0], [1.0, 0.0, 10.0])


@pytest.mark.parametrize(
    ("config", "factor"),
    [
        ("feature_type: HAHOG", 2.0),
        ("processes: 1", 2.0),
        ("feature_type: SIFT", 1.0),
        ("feature_type: dspsift", 2.0),
    ],
)
def test_sizes_are_those_of_the_detector(tmp_path: Path, config: str, factor: float) -> None:
    """HAHOG, the default, and OpenDroneMap's say a standard deviation, SIFT a diameter."""
    (write_tiny(tmp_path) / "config.yaml").write_text(f"# settings\n{config}\n")
    np.testing.assert_allclose(diameters(read_opensfm(tmp_path))[0], [4.0 * factor, 2.0 * factor], rtol=1e-6)


def test_one_of_several_is_chosen(tmp_path: Path) -> None:
    other = TINY | {"points": TINY["points"] | {"7": {"coordinates": [1.0, 0.0, 10.001], "color": [0, 0, 0]}}}
    (write_tiny(tmp_path) / "reconstruction.json").write_text(json.dumps([TINY, other]))
    with pytest.raises(
        IngestError, match=r"found 2 of \[3, 3\] shots; choose one by --reconstruction 0 to 1"
    ):
        read_opensfm(tmp_path)
    assert read_opensfm(tmp_path, 1).stored.model.xyz[0, 2] == 10.001
    with pytest.raises(IngestError, match="expected one of the 2"):
        read_opensfm(tmp_path, 2)


def test_one_that_is_not_chosen_may_be_broken(tmp_path: Path) -> None:
    broken = TINY | {"points": {}}
    (write_tiny(tmp_path) / "reconstruction.json").write_text(json.dumps([TINY, broken]))
    assert len(read_opensfm(tmp_path, 0).stored.model.xyz) == len(TINY["points"])
    with pytest.raises(IngestError, match=r"found 2 of \[3, 3\] shots"):
        read_opensfm(tmp_path)
    with pytest.raises(IngestError, match="points"):
        read_opensfm(tmp_path, 1)
