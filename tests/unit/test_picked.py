"""Picks as a person would make them, and photos without positions."""

import io

import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from tools.photo_files import without_position
from tools.picked import Scan, picks, visible
from tools.unplaced_brighton import summed

_CAMERA = Camera(model="PINHOLE", width=600, height=400, params=(500.0, 500.0, 300.0, 200.0))
_ORIGIN = np.array([500_000.0, 5_000_000.0, 100.0])
_DOWN = Rigid3(rotation=np.diag([1.0, -1.0, -1.0]), translation=np.array([0.0, 0.0, 50.0]))


def scan() -> Scan:
    """A level square of 80 m, a roof 20 m over a part of it; UTM is local, moved."""
    side = np.linspace(-40.0, 40.0, 161)
    ground = np.stack([*np.meshgrid(side, side), np.zeros((161, 161))], axis=-1).reshape(-1, 3)
    roof = ground[(np.abs(ground[:, :2]) < 8.0).all(axis=1)] + [0.0, 0.0, 20.0]
    local = np.concatenate([ground, roof])
    return Scan(utm=local + _ORIGIN, local=local)


def test_picks_lie_in_all_parts_on_what_is_seen() -> None:
    here = scan()
    rows, pixels = visible(here, _CAMERA, _DOWN)
    # A roof of 8 m at 30 m hides the ground as far as 8 * 50 / 30 m.
    under = (np.abs(here.local[rows, :2]) < 12.5).all(axis=1) & (here.local[rows, 2] < 1.0)
    assert not under.any()
    np.testing.assert_allclose(pixels, _CAMERA.project(_DOWN.act(here.local[rows])))
    exact, utm = picks(here, _CAMERA, _DOWN, np.random.default_rng(1), 0.0)
    np.testing.assert_allclose(_CAMERA.project(_DOWN.act(utm - _ORIGIN)), exact)
    assert {(int(x * 3 / 600), int(y * 2 / 400)) for x, y in exact} == {
        (c, r) for c in range(3) for r in (0, 1)
    }
    noisy, _ = picks(here, _CAMERA, _DOWN, np.random.default_rng(1), 3.0)
    assert 0.5 < np.linalg.norm(noisy - exact, axis=1).mean() < 12.0


def test_a_photo_loses_its_position_and_nothing_else() -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8))
    exif = picture.getexif()
    exif[ExifTags.Base.Model] = "FC300S"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = 3.6
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] = (46.0, 50.0, 1.5)
    file = io.BytesIO()
    picture.save(file, "JPEG", exif=exif, xmp=b"<x:xmpmeta GpsLatitude='46.8'/>")
    assert b"GpsLatitude" in file.getvalue()
    bare = without_position(file.getvalue())
    assert b"GpsLatitude" not in bare
    with Image.open(io.BytesIO(bare)) as left, Image.open(io.BytesIO(file.getvalue())) as before:
        assert not left.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        assert left.getexif()[ExifTags.Base.Model] == "FC300S"
        assert left.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] == pytest.approx(3.6)
        np.testing.assert_array_equal(np.asarray(left), np.asarray(before))


def draw(median_m: float, answered: int = 4) -> dict[str, float]:
    return {"asked": 4, "answered": answered, "median_m": median_m, "median_deg": 0.1}


@pytest.mark.parametrize(
    ("draws", "refused", "wrong"),
    [
        ([draw(0.1)] * 18, 2, 0),
        ([draw(0.1)] * 19 + [draw(3.0)], 0, 1),
        ([draw(0.1)] * 19 + [draw(0.1, answered=3)], 0, 1),
    ],
)
def test_draws_are_counted(draws: list[dict[str, float]], refused: int, wrong: int) -> None:
    figures = summed(draws, 20)
    assert (figures["placed"], figures["refused"], figures["wrong"]) == (len(draws), refused, wrong)
    assert figures["worst_m"] == max(one["median_m"] for one in draws)
