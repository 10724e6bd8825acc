"""A whole small world on disk: files, truth, EXIF, the same bytes again, features that match truthfully."""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image

from featuredb.cli import simworld as command
from featuredb.errors import InvalidValueError
from featuredb.geo.utm import utm_from_geodetic
from featuredb.simworld.camera.photograph import render_depth
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.negatives import NEGATIVE_KINDS
from featuredb.simworld.world import TrueImage, World, WorldOptions, open_world, town_of, write_world

OPTIONS = WorldOptions(
    seed=5,
    town_size_m=(155.0, 150.0),
    flight=FlightOptions(lines=2, per_line=2, oblique=1, width=640, gps_error="none"),
    queries=2,
    query_width=480,
    street=4,
    street_width=400,
    negatives_per_kind=1,
    workers=1,
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return write_world(tmp_path_factory.mktemp("world"), OPTIONS)


def test_everything_is_there(world: World) -> None:
    assert len(world.images("drone")) == 5
    assert len(world.images("queries")) == 2
    assert len(world.images("street")) == 4
    assert len(world.negatives()) == len(NEGATIVE_KINDS)
    for image in world.truth.images.values():
        with Image.open(world.folder / image.name) as photo:
            assert photo.size == (image.camera.width, image.camera.height)
            photo.load()
    for path in world.negatives():
        with Image.open(path) as photo:
            assert photo.size == (480, 360)


def test_exif_gives_the_true_position_when_the_receiver_does(world: World) -> None:
    """EXIF -> degrees -> UTM against the truth's UTM, which came from the local frame."""
    for image in world.truth.group("drone") + world.truth.group("queries"):
        with Image.open(world.folder / image.name) as photo:
            gps = photo.getexif().get_ifd(ExifTags.IFD.GPSInfo)
            details = photo.getexif().get_ifd(ExifTags.IFD.Exif)
        degrees = [
            sum(float(v) / 60**i for i, v in enumerate(gps[key]))
            for key in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude)
        ]
        utm = utm_from_geodetic((*degrees, float(gps[ExifTags.GPS.GPSAltitude])), world.truth.epsg)
        np.testing.assert_allclose(utm, image.utm, atol=0.001)
        assert image.gps_error_m is not None
        np.testing.assert_allclose(image.gps_error_m, 0.0, atol=1e-9)
        assert details[ExifTags.Base.OffsetTimeOriginal] == "+00:00"
        from_35mm = float(details[ExifTags.Base.FocalLengthIn35mmFilm]) / 36.0 * image.camera.width
        assert from_35mm == pytest.approx(image.camera.focal_px, rel=0.05)


def test_truth_reads_back_as_it_was_written(world: World) -> None:
    frame = town_of(OPTIONS).frame
    for image in open_world(world.folder).truth.images.values():
        again = world.truth.images[image.name]
        np.testing.assert_array_equal(image.utm, again.utm)
        assert image.camera == again.camera
        np.testing.assert_allclose(
            frame.enu_from_utm(image.utm, world.truth.epsg), image.cam_from_local.center, atol=1e-5
        )


@pytest.mark.slow
@pytest.mark.evaluation
def test_the_same_options_give_the_same_bytes_from_any_number_of_processes(
    world: World, tmp_path: Path
) -> None:
    again = write_world(tmp_path, replace(OPTIONS, workers=2))
    files = sorted(p.relative_to(world.folder) for p in world.folder.rglob("*.*"))
    assert files == sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*.*"))
    assert len(files) == 5 + 2 + 4 + len(NEGATIVE_KINDS) + 1
    for file in files:
        assert (world.folder / file).read_bytes() == (again.folder / file).read_bytes(), file


def matches(first: Path, second: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ratio-tested SIFT matches as pixels of both photos, top-left pixel centre at (0.5, 0.5)."""
    sift = cv2.SIFT.create(4000, contrastThreshold=0.02, enable_precise_upscale=True)
    found = [sift.detectAndCompute(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE), None) for p in (first, second)]
    pairs = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    good = [a for a, b in pairs if a.distance < 0.8 * b.distance]
    pixels = [np.array([k.pt for k in keypoints]) + 0.5 for keypoints, _ in found]
    return pixels[0][[m.queryIdx for m in good]], pixels[1][[m.trainIdx for m in good]]


def transferred(
    pixels: NDArray[np.float64], a: TrueImage, b: TrueImage
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where pixels of photo a lie in photo b by the true depth, and which of them stand on smooth ground."""
    depth = render_depth(town_of(OPTIONS), a.camera, a.cam_from_local).depth
    column, row = np.floor(pixels).astype(int).T
    z = depth[row, column].astype(float)
    rays = np.column_stack([a.camera.unproject(pixels), np.ones(len(pixels))])
    points = a.cam_from_local.inverse().act(rays * z[:, None])
    padded = np.pad(depth, 2, mode="edge")
    around = np.stack([padded[row + 2 + i, column + 2 + j] for i in (-2, 0, 2) for j in (-2, 0, 2)])
    return b.camera.project(b.cam_from_local.act(points)), np.ptp(around, axis=0) < 0.25


def test_features_match_where_truth_says_and_not_everywhere(world: World) -> None:
    """Colour, depth, pose and lens agree to a fraction of a pixel; some matches are wrong, as in life."""
    a, b = world.truth.group("drone")[:2]
    first, second = matches(world.folder / a.name, world.folder / b.name)
    assert len(first) > 500
    expected, smooth = transferred(first, a, b)
    error = np.linalg.norm(expected - second, axis=1)
    assert 0.70 < (error < 2.0).mean() < 0.99
    right = smooth & (error < 2.0)
    assert right.sum() > 200
    # No shift: half a pixel lost between rendering and the convention would show here.
    np.testing.assert_allclose(np.median((expected - second)[right], axis=0), 0.0, atol=0.05)
    assert np.median(error[right]) < 0.35


def test_a_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="simulated world"):
        open_world(tmp_path)
    (tmp_path / "truth.json").write_text('{"version": 99}')
    with pytest.raises(InvalidValueError, match="version 1"):
        open_world(tmp_path)


def test_the_command_writes_a_world(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parser = argparse.ArgumentParser()
    command.register(parser.add_subparsers())
    args = parser.parse_args(
        ["simworld", str(tmp_path / "w"), "--seed", "7", "--gps-error", "none", "--workers", "1"]
    )
    assert (args.size, args.seed, args.gps_error) == ("short", 7, "none")
    tiny = replace(
        OPTIONS,
        flight=replace(OPTIONS.flight, lines=1, per_line=1, oblique=0, width=160),
        queries=1,
        street=0,
    )
    monkeypatch.setattr(
        WorldOptions,
        "short",
        classmethod(lambda cls, seed: replace(tiny, seed=seed, negatives_per_kind=0)),
    )
    args.run(args)
    written = open_world(tmp_path / "w")
    assert written.truth.seed == 7
    assert len(written.images("drone")) == 1
    assert "1 survey photos, 1 queries" in " ".join(capsys.readouterr().out.split())
