"""HEIC and AVIF: pixels unturned as in a JPEG, the file's word over EXIF's, limits first."""

import io
import struct
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.errors import ImageError
from featuredb.features.decode import DecodeLimits, decode_gray, decode_rgb, probe
from featuredb.features.exif.read import read_exif

pillow_heif = pytest.importorskip("pillow_heif")
pillow_heif.register_heif_opener()

SIZE = (208, 144)


def _scene(size: tuple[int, int] = SIZE) -> Image.Image:
    coarse = np.random.default_rng(7).integers(0, 256, (9, 13, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize(size, Image.Resampling.BICUBIC)


def _encode(image: Image.Image, kind: str = "HEIF", **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, quality=90, **options)
    return buffer.getvalue()


def _told() -> Image.Exif:
    exif = Image.Exif()
    exif.update({271: "Maker", 272: "Phone 9", 274: 1})
    exif.get_ifd(ExifTags.IFD.Exif).update({36867: "2026:05:06 07:08:09", 41989: 26})
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(
        {1: "N", 2: (46.0, 50.0, 33.0), 3: "W", 4: (91.0, 59.0, 40.0), 5: b"\0", 6: 198.0}
    )
    return exif


def _turned(scene: Image.Image, kind: str, orientation: int) -> bytes:
    """The encoders write the orientation as boxes: irot, then imir."""
    scene.getexif()[274] = orientation
    return _encode(scene, kind, **({"exif": scene.getexif()} if kind == "AVIF" else {}))


def _refusal(data: bytes, limits: DecodeLimits | None = None) -> ImageError:
    with pytest.raises(ImageError) as caught:
        decode_gray(data, limits or DecodeLimits())
    return caught.value


@pytest.mark.parametrize("kind", ["HEIF", "AVIF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_keeps_the_sensor_s_pixels(kind: str, orientation: int) -> None:
    scene = _scene()
    data = _turned(scene, kind, orientation)
    header = probe(data)
    assert (header.format, header.width, header.height) == (kind.replace("HEIF", "HEIC"), *SIZE)
    assert read_exif(data).orientation == orientation
    assert np.abs(decode_rgb(data).astype(float) - np.asarray(scene)).mean() < 4
    assert np.abs(decode_gray(data).astype(float) - np.asarray(scene.convert("L"))).mean() < 4


def test_mirrored_first_then_turned() -> None:
    scene = _scene()
    data = _turned(scene, "HEIF", 5)
    used = data.index(b"ipma") + 15
    assert data[used + data[used - 1] - 2 : used + data[used - 1]] == b"\x85\x86"
    other = bytearray(data)
    other[used + data[used - 1] - 2 : used + data[used - 1]] = b"\x86\x85"
    stored = decode_rgb(bytes(other)).astype(float)
    assert np.abs(stored - np.asarray(scene)).mean() < 4
    assert read_exif(bytes(other)).orientation == 7


@pytest.mark.parametrize("kind", ["HEIF", "AVIF"])
def test_exif_says_the_same_as_in_a_jpeg_but_does_not_turn(kind: str) -> None:
    exif = _told()
    expected = replace(read_exif(_encode(_scene(), "JPEG", exif=exif)), resaved=False)
    assert expected.latitude_deg == pytest.approx(46.8425, abs=1e-4)
    assert expected.focal_px is not None
    data = _encode(_scene(), kind, exif=exif)
    assert read_exif(data) == expected


def test_a_tag_alone_does_not_turn() -> None:
    exif = _told()
    exif[274] = 6  # and no box irot
    data = _encode(_scene(), exif=exif)
    assert read_exif(data).orientation == 1
    assert decode_gray(data).shape == SIZE[::-1]


def test_what_phones_write() -> None:
    plain = np.asarray(_scene()).astype(float)
    deep = io.BytesIO()
    pillow_heif.from_bytes("RGB;16", SIZE, (np.asarray(_scene()).astype(np.uint16) * 257).tobytes()).save(
        deep
    )
    assert deep.getvalue()[8:12] == b"heix"  # 10 bit
    with_more = _encode(
        _scene(), save_all=True, append_images=[Image.new("RGB", (320, 240))], thumbnails=[64]
    )
    for data in (deep.getvalue(), with_more, _encode(_scene().convert("RGBA")), with_more + b"SEFT appended"):
        assert np.abs(decode_rgb(data).astype(float) - plain).mean() < 5
    grey = decode_rgb(_encode(_scene().convert("L")))
    assert np.abs(grey[:, :, 1].astype(float) - np.asarray(_scene().convert("L"))).mean() < 4
    deep_grey = io.BytesIO()
    levels = np.asarray(_scene().convert("L"))
    pillow_heif.from_bytes("I;16", SIZE, (levels.astype(np.uint16) * 257).tobytes()).save(deep_grey)
    for found in (decode_gray(deep_grey.getvalue()), decode_rgb(deep_grey.getvalue())[:, :, 2]):
        assert found.dtype == np.uint8
        assert np.abs(found.astype(float) - levels).mean() < 4
    tiled = decode_rgb(_encode(_scene((600, 440)), tile_size=256))
    assert np.abs(tiled.astype(float) - np.asarray(_scene((600, 440)))).mean() < 4
    odd = decode_rgb(_encode(_scene((201, 143))))  # cut to its size by the box clap
    assert np.abs(odd.astype(float) - np.asarray(_scene((201, 143)))).mean() < 4


def test_the_primary_picture_counts() -> None:
    file = pillow_heif.from_pillow(Image.new("RGB", (320, 240)))
    file.add_from_pillow(_scene())
    buffer = io.BytesIO()
    file.save(buffer, primary_index=1)
    assert np.abs(decode_rgb(buffer.getvalue()).astype(float) - np.asarray(_scene())).mean() < 5


def test_limits_fire_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    data = _encode(_scene())
    monkeypatch.setattr(pillow_heif, "open_heif", lambda *_, **__: pytest.fail("decoded"))
    for file in (data, _encode(_scene(), "AVIF")):
        assert _refusal(file, DecodeLimits(max_bytes=len(file) - 1)).code == "too_large"
        assert _refusal(file, DecodeLimits(max_pixels=SIZE[0] * SIZE[1] - 1)).code == "too_large"
        assert _refusal(file, DecodeLimits(min_side_px=SIZE[1] + 1)).code == "too_small"


def test_no_more_pixels_come_out_than_the_header_says() -> None:
    for kind, word in (("HEIF", "Security limit"), ("AVIF", "")):
        data = _encode(_scene((600, 440)), kind)
        at = data.index(b"ispe") + 8
        small = data[:at] + struct.pack(">II", 128, 96) + data[at + 8 :]
        if word:
            assert word in str(_refusal(small))
        else:  # libavif makes it as small
            assert decode_gray(small).shape == (96, 128)


@pytest.mark.parametrize("kind", ["HEIF", "AVIF"])
def test_half_a_file_is_truncated(kind: str) -> None:
    data = _encode(_scene(), kind, exif=_told())
    for share in (0.05, 0.5, 0.99):
        assert _refusal(data[: int(share * len(data))]).code == "truncated"


def test_boxes_that_lie_cost_nothing() -> None:
    data = _encode(_scene())
    assert _refusal(data.replace(b"ftypheic", b"ftyphevc")).code == "unsupported"  # a sequence
    assert _refusal(data.replace(b"ispe", b"free")).code == "broken"
    laid_over = data.replace(b"\0\0hvc1\0", b"\0\0iovl\0", 1)
    assert "b'iovl' is not supported" in str(_refusal(laid_over))
    cut = _encode(_scene((201, 143)))
    at = cut.index(b"clap") + 4
    small = cut[:at] + struct.pack(">II", 70, 1) + cut[at + 8 :]  # decoded whole, whatever is cut from it
    assert _refusal(small).code == "unsupported"
    at = data.index(b"iloc")
    assert (
        _refusal(data[: at + 8] + b"\0\0\xff\xff" + data[at + 12 :]).code == "broken"
    )  # items without length
    # A number of one byte, which no standard has, would make a table of millions of places of a small file.
    assert "numbers of no size" in str(_refusal(data[: at + 8] + b"\x41" + data[at + 9 :]))
    huge = data[:28] + struct.pack(">I", 1 << 30) + data[32:]
    assert _refusal(huge).code == "broken"  # a description of a gigabyte


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    data = _encode(_scene())
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    refusal = _refusal(data)
    assert refusal.code == "unsupported"
    assert str(refusal) == (
        "A HEIC photo needs the package pillow_heif, which is not installed: pip install 'featuredb[heic]'"
    )
    assert decode_gray(_encode(_scene(), "AVIF")).shape == SIZE[::-1]  # needs none
