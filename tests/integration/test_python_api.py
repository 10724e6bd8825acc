"""`featuredb.open` as a notebook uses it: photos in every form, one index, tables, pictures, refusals."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import featuredb
import reloc.localise.candidates
from featuredb.cli.main import main
from featuredb.errors import (
    DatabaseNotFoundError,
    ExportError,
    ImageError,
    IngestError,
    InvalidValueError,
    MapNotFoundError,
    MissingExtraError,
    StoreError,
    VideoError,
)
from featuredb.extras import require
from tests.integration.test_localise import POSE, moved
from tests.support import planar_map as field
from tests.support.planar_map import CAMERA, EASTING, EPSG, NORTHING, field_texture, render


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("api")
    db = featuredb.open(folder / "maps.db", create=True)
    db.store.commit_map(field.planar_map(map_id="field"))
    return folder / "maps.db"


@pytest.fixture(scope="module")
def pixels() -> NDArray[np.uint8]:
    return render(field_texture(1), POSE, seed=99)


@pytest.fixture(scope="module")
def photo(url: Path, pixels: NDArray[np.uint8]) -> Path:
    cv2.imwrite(str(url.parent / "photo.png"), pixels)
    return url.parent / "photo.png"


def test_a_photo_is_a_path_bytes_or_pixels(url: Path, photo: Path, pixels: NDArray[np.uint8]) -> None:
    db = featuredb.open(url)
    grey_as_colour = np.repeat(pixels[:, :, None], 3, axis=2)
    answers = [
        db.localise(image, camera=CAMERA)
        for image in (photo, str(photo), photo.read_bytes(), pixels, grey_as_colour)
    ]
    places = np.array([answer.utm for answer in answers])
    assert np.abs(places - [EASTING + POSE.center[0], NORTHING + POSE.center[1], places[0, 2]]).max() < 0.1
    assert np.abs(places - places[0]).max() < 0.01
    first = answers[0]
    assert first.localised
    assert first.reply.utm is not None
    assert first.reply.utm.epsg == EPSG
    assert first.covariance is not None
    assert first.covariance.shape == (6, 6)
    assert first.heading_pitch_roll_deg is not None
    assert first.heading_pitch_roll_deg[1] == pytest.approx(-82.0, abs=0.1)  # tilted by 8 degrees
    assert first.overlay().shape == (480, 640, 3)
    assert db.localise(photo, camera=CAMERA, maps="field").localised
    for wrong, said in (
        (pixels.astype(float), "uint8"),
        (np.zeros((2, 2, 4), np.uint8), "uint8"),
        (None, "expected a path, bytes, or pixels"),
        ("nix.jpg", r"nix\.jpg cannot be read"),
        (photo.parent, "not a regular file"),
    ):
        with pytest.raises(ImageError, match=said):
            db.localise(wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match=r"lat: .* less than or equal to 90, found 95"):
        db.localise(photo, prior=(95.0, 0.0, 10.0))


def test_colours_are_red_first(url: Path, pixels: NDArray[np.uint8]) -> None:
    red = np.zeros((*pixels.shape, 3), dtype=np.uint8)
    red[:, :, 0] = pixels
    answer = featuredb.open(url).localise(red, camera=CAMERA)
    stored = cv2.imdecode(np.frombuffer(answer.photo, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.array_equal(stored, red)


def test_the_index_is_kept_until_the_database_changes(
    url: Path, photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built: list[str] = []
    build = reloc.localiser.segment_of
    monkeypatch.setattr(reloc.localiser, "segment_of", lambda m: built.append(m.map_id) or build(m))
    db = featuredb.open(url)
    for _ in range(3):
        assert db.localise(photo).localised
    assert built == ["field"]
    db.store.commit_map(moved(field.planar_map(5), "elsewhere", 9000.0))
    assert db.localise(photo).localised
    assert built == ["field", "elsewhere"]
    assert featuredb.open(url).localise(photo).localised
    assert built == ["field", "elsewhere"], "a new start lays out nothing"
    db.store.retire("elsewhere", "a test")
    assert {m.map_id for m in db.maps} == {"field"}


def test_a_notebook_sees_the_photo(url: Path, photo: Path) -> None:
    db = featuredb.open(url)
    shown = db.localise(photo, camera=CAMERA)._repr_html_()
    assert "localised in maps.db" in shown
    assert 'src="data:image/jpeg;base64,' in shown
    lost = db.localise(np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8))
    assert not lost.localised
    assert lost.utm is None
    assert lost.covariance is None
    assert "<img" not in lost._repr_html_()
    assert "field" in db.maps._repr_html_()
    assert len(db.maps) == 1
    assert db.maps[0].map_id == "field"


def test_the_command_line_says_the_same(url: Path, photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["localise", str(url), str(photo)]) == 0
    command = capsys.readouterr().out.splitlines()
    python = str(featuredb.open(url).localise(photo)).splitlines()
    assert command[:-1] == python[:-1]  # the last line is the time
    assert main(["maps", str(url)]) == 0
    assert capsys.readouterr().out == str(featuredb.open(url).maps)


def test_sql_gives_tables(url: Path) -> None:
    db = featuredb.open(url)
    found = db.sql("select map_id, images from maps where status = 'active'")
    assert found.arrow().to_pylist() == [{"map_id": "field", "images": 9}]
    assert list(found.df()["images"]) == [9]
    assert len(found) == 1
    assert "<td>field</td>" in found._repr_html_()
    with pytest.raises(StoreError, match="read-only"):
        db.sql("drop table maps")


def test_export_writes_what_the_command_does(url: Path, tmp_path: Path) -> None:
    db = featuredb.open(url)
    done = db.export(tmp_path / "points.ply", "ply")
    assert done.written.maps == 1
    assert "points.ply: ply, 1 maps" in done._repr_html_()
    assert (tmp_path / "points.ply").exists()
    with pytest.raises(ExportError, match="expected one of dataset"):
        db.export(tmp_path / "x", "shapefile")
    with pytest.raises(ExportError, match="--format colmap"):
        db.export(tmp_path / "x", "ply", text=True)


def test_what_cannot_be_done_is_said_in_one_sentence(url: Path, tmp_path: Path) -> None:
    with pytest.raises(DatabaseNotFoundError):
        featuredb.open(tmp_path / "nothing.db")
    db = featuredb.open(url)
    with pytest.raises(IngestError):
        db.ingest(tmp_path, quiet=True)
    with pytest.raises(InvalidValueError, match="found none"):
        db.align("field")
    with pytest.raises(InvalidValueError, match="found control_points and by_maps"):
        db.align("field", control_points="gcp.txt", by_maps=True)
    gcp = tmp_path / "gcp.txt"
    gcp.write_text("EPSG:32632\n" + "".join(f"{i} {i} {i} {i} {i} 0.png\n" for i in range(4)))
    with pytest.raises(MapNotFoundError):
        db.align("no map", control_points=gcp)
    with pytest.raises(MapNotFoundError):
        db.align("no map", by_maps=True)
    for create in (False, True):
        with pytest.raises(InvalidValueError, match=r"expected a folder or an address .* found None"):
            featuredb.open(None, create=create)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="expected a path, found 5"):
        db.ingest(5)  # type: ignore[arg-type]
    with pytest.raises(ImageError, match="cannot be read: embedded null byte"):
        db.localise("a\0b")
    with pytest.raises(StoreError, match="found None"):
        db.sql(None)  # type: ignore[arg-type]
    with pytest.raises(ExportError, match="found bogus"):
        db.export(tmp_path / "x", "ply", bogus=1)
    with pytest.raises(VideoError, match=r"nix\.mp4"):
        db.track("nix.mp4", out=str(tmp_path / "track.csv"))
    assert db.grow(quiet=True).report.photos == ()
    with pytest.raises(MissingExtraError, match=r"featuredb\[notebook\]"):
        require("notebook", "df()", "no_such_package")


def test_unknown_and_lonely_choices_of_an_ingest_are_refused_before_any_work(url: Path) -> None:
    db = featuredb.open(url)
    with pytest.raises(InvalidValueError, match="found gcp_file"):
        db.ingest(url.parent, gcp_file="gcp_list.txt")  # type: ignore[call-arg]
    with pytest.raises(InvalidValueError, match="gcp_crs: expected gcp beside it"):
        db.ingest(url.parent, gcp_crs="EPSG:32632")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda db: featuredb.open("a\0b"), r"expected a folder or an address in an object store, found 'a"),
        (lambda db: db.ingest("a\0b"), r"expected a path, found 'a"),
        (lambda db: db.ingest("photos", workers="a"), "ingest: workers: expected a whole number, found 'a'"),
        (lambda db: db.ingest("photos", gps_sigma=5), "ingest: gps_sigma: expected two numbers in metres"),
        (lambda db: db.ingest("photos", exclude=5), "ingest: exclude: expected globs"),
        (lambda db: db.align("field", photos="photos", near=5), "expected LAT,LON .*, found '5'"),
        (lambda db: db.align(5, by_maps=True), "align: map_id: expected the id of a map, found 5"),
        (lambda db: db.track("f.mp4", prior=(47.0, 8.0, 5.0)), r"track: prior: expected .*\.GeoPrior, found"),
        (lambda db: db.grow(5), r"grow: options: expected .*\.GrowingOptions, found 5"),
        (lambda db: db.export("x.ply", "ply", selection=5), r"expected .*\.Selection, found 5"),
    ],
)
def test_arguments_of_a_wrong_kind_are_refused_at_the_entrance(
    url: Path, wrong: Callable[[featuredb.FeatureDatabase], object], said: str
) -> None:
    with pytest.raises(InvalidValueError, match=said):
        wrong(featuredb.open(url))


@pytest.mark.parametrize("prior", [(47.0, 8.0), (47.0, 8.0, "near")])
def test_a_prior_that_is_none_says_what_one_is(url: Path, photo: Path, prior: tuple[float, ...]) -> None:
    with pytest.raises(InvalidValueError, match="latitude, longitude and metres"):
        featuredb.open(url).localise(photo, prior=prior)  # type: ignore[arg-type]
