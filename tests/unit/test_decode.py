"""Decoding: one grey rule, pixels as stored, and a reason for everything that is not a complete photo."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from featuredb.errors import ImageError
from featuredb.features.decode import DecodeLimits, decode_gray, decode_rgb, probe

SIZE = (200, 144)  # (w, h); neither is a multiple of 16 in both, so padding blocks exist


def _scene(mode: str = "RGB") -> Image.Image:
    rng = np.random.default_rng(7)
    coarse = rng.integers(0, 256, (9, 13, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize(SIZE, Image.Resampling.BICUBIC).convert(mode)


def _encode(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def _code(data: bytes, limits: DecodeLimits | None = None) -> str:
    with pytest.raises(ImageError) as caught:
        decode_gray(data, limits or DecodeLimits())
    assert len(str(caught.value)) > 15  # a sentence, not a bare code
    return caught.value.code


@pytest.mark.parametrize(
    ("mode", "kind", "options"),
    [
        ("RGB", "PNG", {}),
        ("L", "PNG", {}),
        ("RGBA", "PNG", {}),
        ("P", "PNG", {}),
        ("1", "PNG", {}),
        ("RGB", "JPEG", {"quality": 95, "subsampling": 0}),
        ("RGB", "JPEG", {"quality": 95, "progressive": True}),
        ("L", "JPEG", {"quality": 95}),
        ("CMYK", "JPEG", {"quality": 95}),
        ("RGB", "TIFF", {}),
        ("RGB", "TIFF", {"compression": "tiff_lzw"}),
        ("L", "TIFF", {}),
        ("RGB", "WEBP", {"lossless": True}),
        ("RGB", "WEBP", {"quality": 95}),
        ("RGB", "BMP", {}),
    ],
)
def test_every_kind_agrees_with_pillow(mode: str, kind: str, options: dict[str, object]) -> None:
    data = _encode(_scene(mode), kind, **options)
    expected = Image.open(io.BytesIO(data)).convert("RGB")
    header = probe(data)
    assert (header.format, header.width, header.height) == (kind, *SIZE)
    gray, rgb = decode_gray(data).astype(float), decode_rgb(data).astype(float)
    # Two decoders may differ by chroma upsampling and rounding, not by channel order or inversion.
    assert np.abs(gray - np.asarray(expected.convert("L"), dtype=float)).mean() < 2.5
    assert np.abs(rgb - np.asarray(expected, dtype=float)).mean() < 3.0


def test_sixteen_bits_keep_the_upper_eight() -> None:
    pixels = (np.asarray(_scene("L")).astype(np.uint16) << 8) | 0x55
    for extension in (".png", ".tiff"):
        data = cv2.imencode(extension, pixels)[1].tobytes()
        np.testing.assert_allclose(decode_gray(data), np.asarray(_scene("L")), atol=1)


def test_twelve_bits_in_sixteen_are_no_dark_picture() -> None:
    pixels = np.asarray(_scene()).astype(np.uint16) << 4
    for extension in (".png", ".tiff"):
        data = cv2.imencode(extension, pixels[:, :, ::-1])[1].tobytes()
        np.testing.assert_allclose(decode_rgb(data), np.asarray(_scene()), atol=1)
        np.testing.assert_allclose(decode_gray(data), np.asarray(_scene("L")), atol=2)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_orientation_is_not_applied(orientation: int) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    data = _encode(_scene("L"), "JPEG", quality=95, exif=exif)
    assert decode_gray(data).shape == (SIZE[1], SIZE[0])
    np.testing.assert_array_equal(decode_gray(data), decode_gray(_encode(_scene("L"), "JPEG", quality=95)))


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 4}])
def test_a_jpeg_cut_anywhere_is_refused(options: dict[str, object]) -> None:
    data = _encode(_scene(), "JPEG", quality=90, **options)
    assert decode_gray(data).shape == (SIZE[1], SIZE[0])
    for length in range(2, len(data)):
        with pytest.raises(ImageError) as caught:
            probe(data[:length])
        assert caught.value.code == "truncated", length


@pytest.mark.parametrize("kind", ["PNG", "WEBP", "TIFF", "BMP"])
def test_other_kinds_cut_anywhere_are_refused(kind: str) -> None:
    data = _encode(_scene(), kind)
    for length in range(40, len(data), 97):
        assert _code(data[:length]) in ("truncated", "broken"), length


@pytest.mark.parametrize("part", [0.2, 0.5, 0.8])
def test_a_cut_jpeg_with_an_end_marker_behind_is_refused(part: float) -> None:
    data = _encode(_scene(), "JPEG", quality=95)
    start = data.index(b"\xff\xda")
    cut = start + int(part * (len(data) - start))
    assert _code(data[:cut].rstrip(b"\xff") + b"\xff\xd9") == "truncated"


@pytest.mark.parametrize(
    ("side_px", "by"), [(SIZE[0] + 1, 1), (SIZE[0] // 2 + 1, 1), (SIZE[0] // 2, 2), (64, 2)]
)
@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_a_large_jpeg_is_decoded_smaller(side_px: int, by: int, options: dict[str, object]) -> None:
    data = _encode(_scene(), "JPEG", quality=95, **options)
    whole, small = decode_gray(data), decode_gray(data, header=probe(data), side_px=side_px)
    assert small.shape == (-(-SIZE[1] // by), -(-SIZE[0] // by))
    cut = whole[: SIZE[1] // by * by, : SIZE[0] // by * by].astype(float)
    mean = cut.reshape(SIZE[1] // by, by, SIZE[0] // by, by).mean((1, 3))
    assert np.abs(small[: mean.shape[0], : mean.shape[1]] - mean).mean() < 2.0


@pytest.mark.parametrize("by", [2, 4, 8])
def test_a_smaller_picture_of_odd_sides_has_whole_blocks_in_its_pixels(by: int) -> None:
    """The last ones reach beyond the picture: it is not stretched to them."""
    picture = np.zeros((8 * 37 + 3, 8 * 61 + 5), np.uint8)
    picture[:, 8 * 50 :] = 255
    data = _encode(Image.fromarray(picture), "JPEG", quality=95)
    small = decode_gray(data, side_px=picture.shape[1] // by)
    assert small.shape == tuple(-(-side // by) for side in picture.shape)
    assert small[:, 8 * 50 // by - 1].max() < 40
    assert small[:, 8 * 50 // by].min() > 215


def test_what_is_no_jpeg_is_decoded_whole() -> None:
    assert decode_gray(_encode(_scene(), "PNG"), side_px=32).shape == (SIZE[1], SIZE[0])


@pytest.mark.parametrize("part", [0.2, 0.5, 0.8])
def test_a_cut_jpeg_is_refused_when_decoded_smaller(part: float) -> None:
    data = _encode(_scene(), "JPEG", quality=95)
    start = data.index(b"\xff\xda")
    data = data[: start + int(part * (len(data) - start))].rstrip(b"\xff") + b"\xff\xd9"
    with pytest.raises(ImageError) as caught:
        decode_gray(data, side_px=SIZE[0] // 2)
    assert caught.value.code == "truncated"


@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_a_picture_that_really_is_the_fill_grey_passes(options: dict[str, object]) -> None:
    image = Image.new("L", SIZE, 128)
    assert (decode_gray(_encode(image, "JPEG", quality=90, **options)) == 128).all()


def test_trailing_data_is_allowed() -> None:
    data = _encode(_scene(), "JPEG")
    assert probe(data + b"\0" * 999 + data[:300]).end == len(data)


def test_first_picture_of_a_multi_picture_jpeg() -> None:
    data = _encode(_scene(), "MPO", save_all=True, append_images=[Image.new("RGB", SIZE)])
    np.testing.assert_allclose(decode_rgb(data).mean((0, 1)), np.asarray(_scene()).mean((0, 1)), atol=2)


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "not_an_image"),
        (b"\0" * 5000, "not_an_image"),
        (b"%PDF-1.7 hello", "not_an_image"),
        (b"GIF89a" + b"\0" * 100, "unsupported"),
        (b"\0\0\0\x18ftypheic" + b"\0" * 100, "broken"),
        (b"\0\0\0\x18ftypmp42" + b"\0" * 100, "unsupported"),
        (b"\xff\xd8", "truncated"),
        (b"\xff\xd8\xff\xd9", "broken"),
        (b"\xff\xd8hello", "broken"),
    ],
)
def test_what_is_not_a_photo_has_its_reason(data: bytes, code: str) -> None:
    assert _code(data) == code


def test_animations_are_refused() -> None:
    frames = [_scene(), _scene().rotate(90)]
    for kind in ("PNG", "WEBP"):
        assert _code(_encode(frames[0], kind, save_all=True, append_images=frames[1:])) == "unsupported"


def test_limits_fire_before_decoding() -> None:
    data = _encode(_scene(), "PNG")
    assert _code(data, DecodeLimits(max_bytes=len(data) - 1)) == "too_large"
    assert _code(data, DecodeLimits(max_pixels=SIZE[0] * SIZE[1] - 1)) == "too_large"
    assert _code(data, DecodeLimits(max_side_px=SIZE[0] - 1)) == "too_large"
    assert _code(data, DecodeLimits(min_side_px=SIZE[1] + 1)) == "too_small"
    exact = DecodeLimits(
        max_bytes=len(data), max_pixels=SIZE[0] * SIZE[1], max_side_px=SIZE[0], min_side_px=SIZE[1]
    )
    assert decode_gray(data, exact).shape == (SIZE[1], SIZE[0])


def test_a_flipped_bit_in_a_png_is_found() -> None:
    data = bytearray(_encode(_scene(), "PNG"))
    data[len(data) // 2] ^= 4
    assert _code(bytes(data)) == "broken"


def test_a_bomb_is_refused_by_its_header() -> None:
    small = _encode(Image.new("1", (8, 8)), "PNG")
    header = b"IHDR" + struct.pack(">II", 40_000, 40_000) + small[24:29]
    bomb = small[:12] + header + struct.pack(">I", zlib.crc32(header)) + small[33:]
    assert Image.open(io.BytesIO(small)).size == (8, 8)
    assert _code(bomb) == "too_large"
