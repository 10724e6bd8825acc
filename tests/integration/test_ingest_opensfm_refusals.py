"""OpenSfM folders that are refused, and the command that reads them."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import IngestError
from featuredb.export.formats.opensfm import write_map
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.models_in.model_map import ModelOptions, map_of_model
from ingest.models_in.opensfm_folder import read_opensfm
from tests.support import planar_map as field
from tests.support.command_line import only_command
from tests.support.field_photos import with_photos
from tests.support.opensfm_folder import ROWS, TINY, tracks, write_tiny


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("photos")


@pytest.fixture(scope="module")
def field_map(photos: Path) -> FeatureMap:
    return with_photos(field.planar_map(map_id="field"), photos)


def changed(*keys: str, value: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        if value is None:
            del document[keys[-1]]
        else:
            document[keys[-1]] = value

    return change


class TestRefusals:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (changed("cameras", value=None), "cameras: Field required"),
            (changed("points", value={}), "points: .*at least 1 item"),
            (changed("shots", value=[]), "shots: Input should be an object, found"),
            (
                changed("shots", "a.jpg", "camera", value="gone"),
                r"shots: expected cameras of .*found \['gone'\]",
            ),
            (changed("shots", "a.jpg", "rotation", value=None), "shots: a.jpg: rotation: Field required"),
            (changed("shots", "a.jpg", "translation", value=[0, 0]), "translation: 2: Field required"),
            (
                changed("shots", "a.jpg", "translation", value=[0, 0, float("nan")]),
                "shots: a.jpg: translation: 2: .*finite number, found nan",
            ),
            (changed("shots", "a.jpg", "gps_dop", value=-1.0), "standard deviations > 0"),
            (
                changed("points", "7", "coordinates", value=["1", 2, 3]),
                "points: 7: coordinates: 0: .*valid number, found '1'",
            ),
            (changed("points", "7", "color", value=None), "points: 7: color: Field required"),
            (changed("reference_lla", "latitude", value=98.0), "latitude in"),
            (
                changed("cameras", "v2 x y 1000 800 perspective 0.9", "focal", value=5.0),
                "belongs to another reconstruction",
            ),
        ],
    )
    def test_reconstructions(self, tmp_path: Path, change: Callable[[Any], None], message: str) -> None:
        document = json.loads(json.dumps(TINY))
        change(document)
        (write_tiny(tmp_path) / "reconstruction.json").write_text(json.dumps([document]))
        with pytest.raises(IngestError, match=message):
            read_opensfm(tmp_path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [("{", "Invalid JSON"), ("{}", "valid array"), ("[]", "a list of recon"), ("[1]", "an object"),
         ("[" * 200_000, "Invalid JSON"), ("[" + "9" * 10_000 + "]", "Invalid JSON")],
    )  # fmt: skip
    def test_files_that_are_no_reconstruction(self, tmp_path: Path, text: str, message: str) -> None:
        (write_tiny(tmp_path) / "reconstruction.json").write_text(text)
        with pytest.raises(IngestError, match=message):
            read_opensfm(tmp_path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "in the first line, found ''"),
            (tracks(ROWS).split("\n", 1)[1], "in the first line, found 'a.jpg"),
            (tracks(ROWS, 7), "in the first line"),
            (tracks(ROWS)[:-3], "#7: Expected 9 columns, got 8.*cut off"),
            (tracks(ROWS[:2]), "found none or one of 2 of them"),
            (tracks([("a.jpg", "-7", "3", "0.09", "0", "0.004")]), "found none or one of 2 of them"),
            (tracks([("a.jpg", "7", "3", "nan", "0", "0.004")]), "line 2: expected x and y within"),
            (tracks([("a.jpg", "7", "3", "590", "400", "4")]), "line 2: expected x and y within"),
            (tracks([("a.jpg", "7", "3", "0.09", "0", "0")]), "a scale in"),
            (tracks([("a.jpg", "7", "3", "x", "0", "0.01")]), "invalid value 'x'"),
            (tracks([(i, t, f, str(-float(x)), y, s) for i, t, f, x, y, s in ROWS]), "far from there"),
            ("\0" * 100_000, "in the first line"),
            (tracks(ROWS) + "x" * 100_000, "#8: Expected 9 columns, got 1"),
        ],
    )
    def test_tracks(self, tmp_path: Path, text: str, message: str) -> None:
        (write_tiny(tmp_path) / "tracks.csv").write_text(text)
        with pytest.raises(IngestError, match=message):
            read_opensfm(tmp_path)

    def test_tracks_that_are_missing_or_no_text(self, tmp_path: Path) -> None:
        (write_tiny(tmp_path) / "tracks.csv").write_bytes(b"\xff\xfe")
        with pytest.raises(IngestError, match="in the first line"):
            read_opensfm(tmp_path)
        (tmp_path / "tracks.csv").unlink()
        with pytest.raises(IngestError, match="cannot be read"):
            read_opensfm(tmp_path)

    def test_two_references_that_differ(self, tmp_path: Path) -> None:
        write_tiny(tmp_path)
        (tmp_path / "reference_lla.json").write_text(json.dumps(TINY["reference_lla"]))
        assert read_opensfm(tmp_path).reference is not None
        other = TINY["reference_lla"] | {"longitude": 11.1}
        (tmp_path / "reference_lla.json").write_text(json.dumps(other))
        with pytest.raises(IngestError, match="expected the reference of"):
            read_opensfm(tmp_path)

    def test_what_is_missing_is_named(self, tmp_path: Path, field_map: FeatureMap, photos: Path) -> None:
        folder = tmp_path / "field"
        write_map(folder, field_map)
        options = ModelOptions(photos=photos)
        with pytest.raises(IngestError, match="expected --photos FOLDER to make them of"):
            map_of_model(folder, ModelOptions())
        with pytest.raises(IngestError, match="OpenSfM keeps none that can be compared"):
            map_of_model(folder, replace(options, descriptors="stored"))
        with pytest.raises(IngestError, match="expected a COLMAP model"):
            map_of_model(folder, replace(options, colmap_database=tmp_path / "x.db"))
        (tmp_path / "few").mkdir()
        with pytest.raises(IngestError, match=r"0.png: expected this photo to make descriptors of"):
            map_of_model(folder, replace(options, photos=tmp_path / "few"))
        (folder / "georeference.json").unlink()
        with pytest.raises(IngestError, match=r"0.png: expected this photo of the model in --photos"):
            map_of_model(folder, ModelOptions(photos=tmp_path / "few"))

    def test_coordinates_that_are_not_in_the_references_frame(
        self, tmp_path: Path, field_map: FeatureMap, photos: Path
    ) -> None:
        """As in UTM: everything is 5,000 km north of the reference."""
        folder = tmp_path / "field"
        write_map(folder, field_map)
        path = folder / "reconstruction.json"
        (document,) = json.loads(path.read_text())
        for point in document["points"].values():
            point["coordinates"][1] += 5e6
        for name, image in zip(document["shots"], field_map.images, strict=True):
            pose = image.cam_from_local
            moved = -pose.rotation @ (pose.center + np.array([0.0, 5e6, 0.0]))
            document["shots"][name]["translation"] = moved.tolist()
        path.write_text(json.dumps([document]))
        with pytest.raises(IngestError, match="within 100 km of the model's reference, found one at 5000 km"):
            map_of_model(folder, ModelOptions(photos=photos, sigma_m=(0.1, 0.1)))


class TestCommand:
    @pytest.fixture(autouse=True)
    def _only_this(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        with only_command(monkeypatch, "ingest", "ingest.cli.ingest:register"):
            yield

    def test_a_project_with_its_images(
        self, tmp_path: Path, photos: Path, field_map: FeatureMap, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """As OpenDroneMap lays it out; photos are found in images/."""
        (tmp_path / "odm").mkdir()
        write_map(tmp_path / "odm" / "opensfm", field_map)
        (tmp_path / "odm" / "opensfm" / "georeference.json").unlink()
        (tmp_path / "odm" / "images").symlink_to(photos)
        argv = ["ingest", "model", str(tmp_path / "db"), str(tmp_path / "odm"), "--sigma", "0.05,0.1"]
        assert main(argv) == 0
        said = capsys.readouterr().out
        assert "committed, 9 photos" in said
        assert "EPSG:32632, placed by gcp" in said
        (summary,) = Database.open(tmp_path / "db").snapshot().maps()
        assert summary.points == len(field_map.points)

    def test_nothing_is_written_of_what_is_refused(
        self, tmp_path: Path, photos: Path, field_map: FeatureMap, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_map(tmp_path / "field", field_map)
        (tmp_path / "field" / "tracks.csv").write_text("cut off")
        argv = ["ingest", "model", str(tmp_path / "db"), str(tmp_path / "field"), "--photos", str(photos)]
        assert main(argv) == 2
        assert "tracks.csv: expected OPENSFM_TRACKS_VERSION_v1" in capsys.readouterr().err
        assert not (tmp_path / "db").exists()
