"""Colours from ortho images: all kinds of files, other reference systems, gaps, and a real scan."""

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.transform import Affine

from featuredb.errors import GeodesyError, ScanFileError
from featuredb.geo.crs.scan import scan_crs
from featuredb.geo.crs.utm_transform import utm_transform
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.ortho_image import OrthoImage, open_ortho
from featuredb.lidar.ortho import colour_by_ortho
from tests.support.geotiff import write_geotiff

EPSG = 32632
WEST, NORTH, PIXEL = 679_900.0, 5_334_500.0, 0.2
SIZE = 300  # pixels, 60 m
FINE = 100.0  # pixels per spacing, none averaged: colours can be compared one to one


def picture(dtype: type = np.uint8, bands: int = 3, top: float = 250.0) -> NDArray[np.generic]:
    """Ramps: red grows to the east, green to the south; other bands are constant."""
    ramp = np.linspace(10, top, SIZE)
    image = np.zeros((SIZE, SIZE, bands))
    image[..., 0] = ramp[None]
    if bands > 1:
        image[..., 1] = ramp[:, None]
        image[..., 2:] = 0.4 * top
    return np.round(image).astype(dtype)


def points(n: int = 4000, inset: float = 1.0) -> FloatArray:
    rng = np.random.default_rng(3)
    xy = rng.uniform([WEST + inset, NORTH - 60 + inset], [WEST + 60 - inset, NORTH - inset], (n, 2))
    return np.column_stack([xy, np.full(n, 560.0)])


def expected_red(utm: FloatArray, top: float = 250.0) -> FloatArray:
    """The ramp as a function of the place, not of pixels."""
    return 10 + (top - 10) * ((utm[:, 0] - WEST) / PIXEL - 0.5) / (SIZE - 1)


def expected_green(utm: FloatArray, top: float = 250.0) -> FloatArray:
    return 10 + (top - 10) * ((NORTH - utm[:, 1]) / PIXEL - 0.5) / (SIZE - 1)


def write(path: Path, image: NDArray[np.generic], **more: object) -> Path:
    write_geotiff(path, image, epsg=EPSG, west=WEST, north=NORTH, pixel_m=PIXEL, **more)  # type: ignore[arg-type]
    return path


def colours(
    utm: NDArray[np.float64], epsg: int, own: NDArray[np.uint8] | None, ortho: OrthoImage
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Of an image that is not averaged; points are as dense as they are over their area in plan."""
    spacing_m = float(np.sqrt(np.prod(np.ptp(utm[:, :2], axis=0)) / len(utm)))
    black = np.zeros((len(utm), 3), np.uint8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("featuredb.lidar.ortho._PIXELS_PER_SPACING", FINE)
        return colour_by_ortho(utm, epsg, black if own is None else own, ortho, spacing_m)


def test_colours_come_from_the_right_pixels(tmp_path: Path) -> None:
    utm = points()
    ortho = open_ortho(write(tmp_path / "o.tif", picture()))
    rgb, coloured = colours(utm, EPSG, None, ortho)
    assert coloured.all()
    np.testing.assert_allclose(rgb[:, 0], expected_red(utm), atol=1.0)
    np.testing.assert_allclose(rgb[:, 1], expected_green(utm), atol=1.0)
    assert (rgb[:, 2] == 100).all()


def test_under_a_roof_a_tree_and_at_walls_points_keep_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    ground = points(40_000)
    roof = ground[(np.abs(ground[:, :2] - [WEST + 20, NORTH - 30]) < 6).all(axis=1)]
    roof = roof + np.array([0.05, 0.05, 5.0])
    crown = ground[np.hypot(*(ground[:, :2] - [WEST + 45, NORTH - 30]).T) < 4] + np.array([0.03, 0.0, 4.0])
    wall = np.column_stack(
        [rng.uniform(WEST + 15, WEST + 25, 500), np.full(500, NORTH - 36.02), rng.uniform(560.5, 564, 500)]
    )
    utm = np.concatenate([ground, roof, crown, wall])
    own = np.tile(np.array([1, 2, 3], np.uint8), (len(utm), 1))
    ortho = open_ortho(write(tmp_path / "o.tif", picture()))
    rgb, coloured = colours(utm, EPSG, own, ortho)
    parts = np.split(np.arange(len(utm)), np.cumsum([len(ground), len(roof), len(crown)]))
    under = (np.abs(ground[:, :2] - [WEST + 20, NORTH - 30]) < 5.8).all(axis=1)
    under |= np.hypot(*(ground[:, :2] - [WEST + 45, NORTH - 30]).T) < 3.8
    assert coloured[parts[0]][under].mean() < 0.01
    assert coloured[parts[1]].mean() > 0.99
    assert coloured[parts[2]].mean() > 0.99
    assert coloured[parts[3]].mean() < 0.06  # the points are scattered anyhow, and leave gaps
    # Off the roof's and the crown's edges everything is coloured.
    far = (np.abs(ground[:, :2] - [WEST + 20, NORTH - 30]) > 6.8).any(axis=1)
    far &= np.hypot(*(ground[:, :2] - [WEST + 45, NORTH - 30]).T) > 5
    assert coloured[parts[0]][far].all()
    np.testing.assert_array_equal(rgb[~coloured], own[~coloured])
    np.testing.assert_allclose(rgb[coloured, 0], expected_red(utm[coloured]), atol=1.0)


@pytest.mark.parametrize("epsg", [3857, 4326, 25832, 31468, 32633])
def test_images_in_other_systems(tmp_path: Path, epsg: int) -> None:
    """A ramp drawn in the image's own system, looked up from UTM, against pyproj's registry transform."""
    utm = points(500)
    to_image = Transformer.from_crs(EPSG, epsg, always_xy=True)
    x, y = to_image.transform(utm[:, 0], utm[:, 1])
    step_x, step_y = np.ptp(x) / 200, np.ptp(y) / 200
    west, north = x.min() - 5 * step_x, y.max() + 5 * step_y
    image = np.zeros((210, 210, 3), np.uint8)
    image[..., 0], image[..., 1] = np.arange(210)[None], np.arange(210)[:, None]
    path = tmp_path / "o.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=210, height=210, count=3, dtype="uint8", crs=f"EPSG:{epsg}",
        transform=Affine(step_x, 0.0, west, 0.0, -step_y, north),
    ) as file:  # fmt: skip
        file.write(np.moveaxis(image, -1, 0))
    rgb, coloured = colours(utm, EPSG, None, open_ortho(path))
    assert coloured.all()
    # Datum shifts of a metre or two (DHDN) may differ by operation; else it is one grey value, 0.3 m.
    tolerance = 5.0 if epsg == 31468 else 1.0
    np.testing.assert_allclose(rgb[:, 0], (x - west) / step_x - 0.5, atol=tolerance)
    np.testing.assert_allclose(rgb[:, 1], (north - y) / step_y - 0.5, atol=tolerance)


def test_smaller_images_and_gaps_leave_points_alone(tmp_path: Path) -> None:
    utm = points() + np.array([25.0, 0.0, 0.0])  # the image ends 25 m before the scan does
    image = picture().copy()
    image[100:140] = 0
    ortho = open_ortho(write(tmp_path / "o.tif", image, nodata=0))
    own = np.full((len(utm), 3), 7, np.uint8)
    rgb, coloured = colours(utm, EPSG, own, ortho)
    row, column = (NORTH - utm[:, 1]) / PIXEL, (utm[:, 0] - WEST) / PIXEL
    gap = (row >= 100) & (row < 140)
    np.testing.assert_array_equal(coloured, (column < SIZE) & ~gap)
    np.testing.assert_array_equal(rgb[~coloured], own[~coloured])
    # Nothing of the gap's black shines into its neighbours.
    np.testing.assert_allclose(rgb[coloured, 1], expected_green(utm[coloured]), atol=1.5)
    elsewhere = colours(utm + np.array([5000.0, 0, 0]), EPSG, own, ortho)
    assert not elsewhere[1].any()
    np.testing.assert_array_equal(elsewhere[0], own)


def _grey(path: Path) -> None:
    write(path, picture(bands=1))


def _alpha(path: Path) -> None:
    image = np.concatenate([picture(), np.full((SIZE, SIZE, 1), 255, np.uint8)], axis=-1)
    image[:, :100, 3] = 0
    write(path, image)
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [rasterio.enums.ColorInterp[n] for n in ("red", "green", "blue", "alpha")]


def _infrared(path: Path) -> None:
    write(path, np.concatenate([picture(), np.full((SIZE, SIZE, 1), 3, np.uint8)], axis=-1))


def _wide(path: Path) -> None:
    write(path, picture(np.uint16, top=4000.0))


def _palette(path: Path) -> None:
    write(path, picture(bands=1))
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {i: (i, 255 - i, 9, 255) for i in range(256)})


@pytest.mark.parametrize("make", [_grey, _alpha, _infrared, _wide, _palette])
def test_one_four_and_sixteen_bit_images(tmp_path: Path, make: Callable[[Path], None]) -> None:
    utm = points()
    path = tmp_path / "o.tif"
    make(path)
    rgb, coloured = colours(utm, EPSG, None, open_ortho(path))
    red = expected_red(utm)
    if make is _grey:
        assert coloured.all()
        assert (rgb == rgb[:, :1]).all()
    if make is _alpha:
        np.testing.assert_array_equal(coloured, utm[:, 0] >= WEST + 100 * PIXEL)
    if make is _palette:
        np.testing.assert_allclose(rgb[:, 1], 255.0 - rgb[:, 0])
        assert (rgb[:, 2] == 9).all()
        np.testing.assert_allclose(rgb[:, 0], np.round(red), atol=1.0)
        return
    if make is _wide:  # half a percent at either end is cut off; green's ramp has the same values
        wide = expected_red(utm, top=4000.0)
        low, high = np.percentile(picture(np.uint16, top=4000.0), (0.5, 99.5))
        red = np.clip((wide - low) / (high - low) * 255, 0, 255)
    np.testing.assert_allclose(rgb[coloured, 0], red[coloured], atol=1.5)


def test_fine_images_are_averaged_to_the_scan(tmp_path: Path) -> None:
    """A chequerboard of single pixels, far finer than the points are apart, becomes grey."""
    board = np.zeros((SIZE, SIZE, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 200
    ortho = open_ortho(write(tmp_path / "o.tif", board))
    utm = points(900)  # two metres apart
    rgb, _ = colour_by_ortho(utm, EPSG, np.zeros((900, 3), np.uint8), ortho, 2.0)
    assert rgb.mean() == pytest.approx(100, abs=4)
    assert rgb.std() < 15
    sharp, _ = colours(utm, EPSG, None, ortho)
    assert sharp.std() > 2 * rgb.std() + 15


def test_large_images_are_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    utm = points()
    ortho = open_ortho(write(tmp_path / "o.tif", picture()))
    whole = colours(utm, EPSG, None, ortho)
    monkeypatch.setattr("featuredb.lidar.formats.ortho_image._MAX_READ_PX", 5000)
    parts = colours(utm, EPSG, None, ortho)
    np.testing.assert_array_equal(parts[1], whole[1])
    np.testing.assert_allclose(parts[0].astype(int), whole[0], atol=1)


def test_unusable_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.tif").write_text("no image")
    with pytest.raises(ScanFileError, match="GDAL reads"):
        open_ortho(tmp_path / "text.tif")
    with pytest.raises(ScanFileError, match="GDAL reads"):
        open_ortho(tmp_path / "absent.tif")
    bare = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "crs.tif", "w", transform=Affine(1, 0, 5, 0, -1, 5), **bare) as file:
        file.write(np.ones((1, 4, 4), np.uint8))
    with pytest.raises(ScanFileError, match="no reference system"):
        open_ortho(tmp_path / "crs.tif")
    assert open_ortho(tmp_path / "crs.tif", crs="EPSG:32632").width == 4
    hole = {**bare, "dtype": "uint16", "nodata": 0, "crs": "EPSG:32632"}
    with rasterio.open(tmp_path / "hole.tif", "w", transform=Affine(1, 0, 5, 0, -1, 5), **hole) as file:
        file.write(np.zeros((1, 4, 4), np.uint16))
    with pytest.raises(ScanFileError, match="no data"):
        open_ortho(tmp_path / "hole.tif")
    ortho = open_ortho(write(tmp_path / "o.tif", picture()), crs="not a system")
    with pytest.raises(GeodesyError, match="not readable"):
        colours(points(10), EPSG, None, ortho)
    good = open_ortho(tmp_path / "o.tif")
    broken = (tmp_path / "o.tif").read_bytes()
    (tmp_path / "o.tif").write_bytes(broken[: len(broken) // 3])
    with pytest.raises(ScanFileError, match=r"cannot be read|GDAL reads"):
        colours(points(), EPSG, None, good)


@pytest.mark.real_data
def test_a_real_scan_takes_the_colours_that_it_was_given(shared_data: Path) -> None:
    """The scan's own colours come from this image by a plain lookup: what is seen from above must agree."""
    las = laspy.read(shared_data / "autzen" / "stadium.laz")
    wkt = next(v.string for v in las.header.vlrs if hasattr(v, "string") and "PROJ" in v.string)
    to_utm = utm_transform(scan_crs(wkt=wkt), las.header.mins, las.header.maxs)
    part = np.flatnonzero((las.x < las.header.mins[0] + 500) & (las.y < las.header.mins[1] + 500))
    utm = to_utm.apply(np.asarray(las.xyz)[part])
    own = np.stack([las.red, las.green, las.blue], axis=1)[part].astype(np.uint8)
    ortho = open_ortho(shared_data / "autzen" / "stadium_ortho.tif")
    rgb, coloured = colours(utm, to_utm.epsg, None, ortho)
    difference = np.abs(rgb.astype(int) - own)[coloured].mean(axis=1)
    print(
        f"{len(utm)} points, {coloured.mean():.1%} coloured; difference from the file's colours: median "
        f"{np.median(difference):.2f}, 95 % below {np.percentile(difference, 95):.2f} of 255"
    )
    assert 0.85 < coloured.mean() < 0.99
    assert np.median(difference) < 2.0
    assert np.percentile(difference, 95) < 10.0
