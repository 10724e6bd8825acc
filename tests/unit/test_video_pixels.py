"""Frames of films: upright, of full range, in true colours, made smaller without aliases."""

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from featuredb.errors import VideoError
from featuredb.features.shrink import fitted_size
from featuredb.video.film import VideoOptions
from featuredb.video.frames import open_video
from featuredb.video.pixels import PixelReader, clockwise_from_display_matrix
from tests.support.films import HEIGHT, WIDTH, film, read, shown, write_film

# ISO 14496-12: the matrix (a b u; c d v; x y w) shows the stored point (p, q) at (a p + c q, b p + d q).
# The one of an iPhone held upright takes x to y, that is down: the picture is turned clockwise.
MATRICES = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def _corner_film(path: Path) -> Path:
    """A white corner at the top left of the stored picture, and a small grey one at its top right."""
    marked = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    marked[:40, :40] = 255
    marked[:40, -40:] = 140
    return write_film(path, [marked] * 3)


def _with_matrix(path: Path, matrix: tuple[float, ...]) -> Path:
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version, times, id, duration, reserved, layer, group, volume
    identity = struct.unpack_from(">9i", data, at)
    assert identity == (0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    a, b, c, d = (round(value * 0x10000) for value in matrix)
    struct.pack_into(">9i", data, at, a, b, 0, c, d, 0, WIDTH << 16, HEIGHT << 16, 0x40000000)
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("rotation_deg", MATRICES)
def test_rotation_puts_the_corner_where_the_standard_says(tmp_path: Path, rotation_deg: int) -> None:
    a, b, c, d = MATRICES[rotation_deg]
    path = _with_matrix(_corner_film(tmp_path / "film.mp4"), MATRICES[rotation_deg])
    with open_video(path) as video:
        info, frame = video.info, next(iter(video))
    upright = (WIDTH, HEIGHT) if rotation_deg in (0, 180) else (HEIGHT, WIDTH)
    assert (info.width, info.height) == (info.frame_width, info.frame_height) == upright
    assert info.rotation_deg == rotation_deg
    for pixels in (frame.gray, frame.rgb()[:, :, 1]):
        assert pixels.shape == upright[::-1]
        for corner, value in (((-1.0, -1.0), 255), ((1.0, -1.0), 140)):  # about the centre, x right, y down
            p, q = corner
            x, y = a * p + c * q, b * p + d * q
            row, column = (5 if y < 0 else -6), (5 if x < 0 else -6)
            assert pixels[row, column] == pytest.approx(value, abs=6)
        assert (pixels > 200).sum() == pytest.approx(1600, rel=0.05)


def test_pyav_counts_rotation_counterclockwise(tmp_path: Path) -> None:
    path = write_film(tmp_path / "film.mkv", container="matroska", rotation_deg=90)
    with open_video(path) as video:
        assert video.info.rotation_deg == 270


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        ((0.7071, 0.7071, -0.7071, 0.7071), "by 45.0 degrees"),
        ((0.999, 0.035, -0.035, 0.999), "by 2.0 degrees"),
        ((1, 0, 0.5, 1), "degrees"),
        ((-1, 0, 0, 1), "mirrors"),
        ((0, 1, 1, 0), "mirrors"),
        ((1, 0, 2, 0), "shows no picture"),
    ],
)
def test_other_display_matrices_are_refused(tmp_path: Path, matrix: tuple[float, ...], said: str) -> None:
    path = _with_matrix(_corner_film(tmp_path / "film.mp4"), matrix)
    with pytest.raises(VideoError, match=rf"film\.mp4: .*{said}"):
        open_video(path)


def test_a_matrix_of_another_size_is_refused() -> None:
    with pytest.raises(VideoError, match="36 bytes, found 35"):
        clockwise_from_display_matrix(bytes(35), "film.mp4")


def test_rotated_films_are_made_smaller_upright(tmp_path: Path) -> None:
    path = _with_matrix(_corner_film(tmp_path / "film.mp4"), MATRICES[90])
    with open_video(path, VideoOptions(max_side_px=80)) as video:
        frame = next(iter(video))
    assert (video.info.width, video.info.height) == (120, 160)
    assert (video.info.frame_width, video.info.frame_height) == (60, 80)
    assert frame.gray.shape == (80, 60)
    assert frame.rgb().shape == (80, 60, 3)
    assert frame.gray[2, -3] == pytest.approx(255, abs=6)  # the top left went to the top right


PATCHES = np.array(
    [
        [255, 0, 0],
        [0, 255, 0],
        [0, 0, 255],
        [255, 255, 255],
        [0, 0, 0],
        [128, 128, 128],
        [200, 150, 40],
        [20, 90, 160],
    ],
    np.uint8,
)
BT601 = np.array([0.299, 0.587, 0.114])
BT709 = np.array([0.2126, 0.7152, 0.0722])


PIXEL_FORMATS = [
    *("yuv420p", "yuvj420p", "yuv422p", "nv12", "yuva420p", "yuyv422", "uyvy422"),  # eight bits
    *("yuv420p10le", "p010le", "yuv422p10le", "yuv444p12le", "gray10le"),
    *("gray", "rgb24", "bgr0", "gbrp"),
]


def _patches(side: int = 40) -> np.ndarray:
    return np.ascontiguousarray(PATCHES.reshape(2, 4, 3).repeat(side, 0).repeat(side, 1))


def _centres(pixels: np.ndarray, side: int = 40) -> np.ndarray:
    return pixels[side // 2 :: side, side // 2 :: side].reshape(8, -1)


@pytest.mark.parametrize(
    ("pixel_format", "colours", "weights"),
    [
        ("yuv420p", {"colorspace": 5, "color_range": 1}, BT601),
        ("yuv420p", {"colorspace": 1, "color_range": 1}, BT709),
        ("yuv420p", {"colorspace": 1, "color_range": 2}, BT709),
        ("yuv444p", {"colorspace": 5, "color_range": 2}, BT601),
        ("yuv420p10le", {"colorspace": 1, "color_range": 1}, BT709),
        ("yuv420p", {}, BT601),
    ],
)
def test_grey_and_colours_are_of_full_range(
    tmp_path: Path, pixel_format: str, colours: dict[str, int], weights: np.ndarray
) -> None:
    path = write_film(
        tmp_path / "film.mp4",
        [_patches()] * 2,
        pixel_format=pixel_format,
        colours=colours,
        options={"crf": "1"},
    )
    frame = read(path)[0]
    np.testing.assert_allclose(_centres(frame.rgb()), PATCHES, atol=4)
    np.testing.assert_allclose(_centres(frame.gray)[:, 0], PATCHES @ weights, atol=3)
    assert frame.gray.min() <= 1
    assert frame.gray.max() >= 254


@pytest.mark.parametrize("colour_range", [1, 2])
@pytest.mark.parametrize(
    "pixel_format",
    PIXEL_FORMATS,
)
def test_a_ramp_survives_every_pixel_format(pixel_format: str, colour_range: int) -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (32, 1))
    rgb = np.repeat(ramp[:, :, None], 3, axis=2)
    stored = av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(
        format=pixel_format, dst_color_range=colour_range, threads=1
    )
    full = PixelReader(width=256, height=32, clockwise_deg=0)
    gray = full.gray(stored)
    assert gray.flags.owndata  # and is no view of the decoder's picture
    np.testing.assert_allclose(gray.astype(int), ramp, atol=2)
    np.testing.assert_allclose(full.rgb(stored).astype(int), rgb, atol=3)
    half = PixelReader(width=128, height=16, clockwise_deg=0)
    means = ramp.reshape(16, 2, 128, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half.gray(stored)[:, 2:-2], means[:, 2:-2], atol=2)
    np.testing.assert_allclose(half.rgb(stored)[:, 2:-2, 1], means[:, 2:-2], atol=4)


@pytest.mark.parametrize("pixel_format", PIXEL_FORMATS)
def test_a_colour_space_that_nobody_knows_is_taken_for_unnamed(pixel_format: str) -> None:
    """Cameras write 3, "reserved", and a flipped bit anything; libav's scaler refuses both."""
    stored = av.VideoFrame.from_ndarray(_patches(), "rgb24").reformat(format=pixel_format, threads=1)
    reader = PixelReader(width=80, height=40, clockwise_deg=0)
    expected = reader.gray(stored), reader.rgb(stored)
    for colour_space in (3, 8, 14):
        stored.colorspace = colour_space
        np.testing.assert_array_equal(reader.gray(stored), expected[0])
        np.testing.assert_array_equal(reader.rgb(stored), expected[1])


def test_an_hd_film_without_a_named_matrix_is_taken_for_bt709(tmp_path: Path) -> None:
    colours = {"colorspace": 1, "color_range": 1}
    path = write_film(tmp_path / "film.mkv", [_patches(360)], container="matroska", colours=colours)
    with open_video(path) as video:
        named = next(iter(video)).rgb()
    # MPEG-4 part 2 in AVI cannot name it.
    old = write_film(
        tmp_path / "film.avi", [_patches(360)], codec="mpeg4", options={"b": "90M"}, colours=colours
    )
    with open_video(old) as video:
        unnamed = next(iter(video)).rgb()
    np.testing.assert_allclose(_centres(named, 360), PATCHES, atol=4)
    np.testing.assert_allclose(_centres(unnamed, 360), PATCHES, atol=8)


@pytest.mark.parametrize(
    ("codec", "pixel_format"), [("libx264", "yuv420p"), ("libx264", "yuv420p10le"), ("ffv1", "bgr0")]
)
@pytest.mark.parametrize("max_side_px", [80, 107, 159, 160, 400])
def test_smaller_pictures_are_averages_of_areas(
    tmp_path: Path, codec: str, pixel_format: str, max_side_px: int
) -> None:
    path = write_film(tmp_path / "film.mkv", container="matroska", codec=codec, pixel_format=pixel_format)
    full = read(path)[7]
    with open_video(path, VideoOptions(max_side_px=max_side_px)) as video:
        size = (video.info.frame_width, video.info.frame_height)
        small = list(video)[7]
    assert size == fitted_size(WIDTH, HEIGHT, max_side_px)
    assert small.gray.shape == size[::-1]
    assert small.rgb().shape == (*size[::-1], 3)
    area = cv2.resize(full.gray, size, interpolation=cv2.INTER_AREA)
    difference = np.abs(area.astype(int) - small.gray)
    assert difference.mean() < 1.2
    assert np.percentile(difference, 99) < 8
    assert np.abs(small.rgb()[:, :, 1].astype(int) - small.gray).mean() < 2.5  # the pictures are grey


def test_pixels_belong_to_the_caller(tmp_path: Path) -> None:
    """Grey is no view of the decoder's memory, and colours can be had after the film is closed."""
    for kind in ("mp4", "jpeg.avi"):  # limited and full range
        frames = read(film(tmp_path, kind))
        assert all(frame.gray.flags.c_contiguous and frame.gray.flags.owndata for frame in frames)
        assert not frames[0].gray.flags.writeable
        assert [shown(frame.gray) for frame in frames] == list(range(30))
        assert [shown(frame.rgb()[:, :, 0]) for frame in frames] == list(range(30))
        frames[3].rgb()[:] = 0
        assert frames[3].rgb().any()
