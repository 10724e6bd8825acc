"""Rasters on disk, read by windows: ortho images, and heights (DSM, DEM).

Of an ortho image: where it lies, what its bands mean, colours at its pixels. A cell with a height is a
point, so that a place without a scan has a ground as well.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import file_sha256
from featuredb.errors import ScanFileError
from featuredb.extras import require
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.las import LONGEST_COORDINATE, UNCLASSIFIED, RawPoints, ScanFile, measured

Affine = tuple[float, float, float, float, float, float]

_OVERVIEW_PX = 1024  # side of the reduced image from which the range of values is taken
# Of values wider than 8 bits, which become 0 and 255: glints and gaps are left out.
_RANGE_PERCENT = (0.5, 99.5)
_MAX_READ_PX = 40_000_000  # pixels read at a time, 160 MB with mask


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthoImage:
    """An ortho image on disk.

    Attributes:
        path: the file.
        wkt: its reference system.
        pixel_from_xy: a, b, c, d, e, f with column = a x + b y + c, row = d x + e y + f; the top-left pixel
            covers [0, 1) in both.
        width, height: pixels.
        bands: numbers, from 1, of red, green, blue; one number three times where it is grey.
        palette: (256, 3) colours of a picture with a colour table, row by row, or None.
        low, high: values that become 0 and 255.
    """

    path: Path
    wkt: str
    pixel_from_xy: Affine
    width: int
    height: int
    bands: tuple[int, int, int]
    palette: tuple[tuple[int, int, int], ...] | None
    low: float
    high: float


def open_ortho(path: Path, crs: str | None = None) -> OrthoImage:
    """Read what there is to know of an ortho image, but for its pixels.

    Args:
        crs: its reference system where the file has none, or a wrong one.

    Raises:
        ScanFileError: not an image that can be read, or without a place on Earth.
        MissingExtraError: the packages of the extra `lidar` are not installed.
    """
    with opened_raster(path) as file:
        if crs is None and not file.crs:
            raise ScanFileError(
                f"{path}: the image names no reference system; "
                "assign it, e.g. by gdal_edit.py -a_srs EPSG:25832"
            )
        bands, palette = _bands(file)
        low, high = _range(file, bands, palette)
        a, b, c, d, e, f = (float(v) for v in tuple(~file.transform)[:6])
        return OrthoImage(
            path=Path(path),
            wkt=crs or file.crs.to_wkt(),
            pixel_from_xy=(a, b, c, d, e, f),
            width=file.width,
            height=file.height,
            bands=bands,
            palette=palette,
            low=low,
            high=high,
        )


def sample_ortho(
    ortho: OrthoImage, pixel: FloatArray, shrink: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (n, 3) at pixel coordinates (n, 2), averaged over `shrink` pixels, and where there are any."""
    rgb, valid = np.zeros((len(pixel), 3), np.uint8), np.zeros(len(pixel), dtype=bool)
    parts = [np.arange(len(pixel))] if len(pixel) else []
    with opened_raster(ortho.path) as file:
        while parts:
            rows = parts.pop()
            low = np.floor(pixel[rows].min(axis=0) - 2 * shrink).clip(0).astype(int)
            limit = [ortho.width, ortho.height]
            high = np.minimum(np.ceil(pixel[rows].max(axis=0) + 2 * shrink).astype(int), limit)
            size = high - low
            if size.prod() / shrink**2 > _MAX_READ_PX and len(rows) > 1:
                longest = int(np.argmax(size))
                left = pixel[rows, longest] < low[longest] + 0.5 * size[longest]
                parts += [part for part in (rows[left], rows[~left]) if len(part)]
                continue
            rgb[rows], valid[rows] = _sample_window(file, ortho, pixel[rows], low, size, shrink)
    return rgb, valid


def _sample_window(
    file: Any,
    ortho: OrthoImage,
    pixel: FloatArray,
    low: NDArray[np.int64],
    size: NDArray[np.int64],
    shrink: float,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The same from one window of the file, which starts at pixel `low` and is `size` wide and high."""
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    width, height = np.maximum(1, np.round(size / shrink)).astype(int).tolist()
    window = Window(int(low[0]), int(low[1]), int(size[0]), int(size[1]))
    method = Resampling.average if shrink > 1 and ortho.palette is None else Resampling.nearest
    values = file.read(
        list(dict.fromkeys(ortho.bands)), window=window, out_shape=(height, width), resampling=method
    )
    known = file.dataset_mask(window=window, out_shape=(height, width), resampling=Resampling.nearest) > 0
    picture = _as_bytes(values, ortho)
    if len(picture.shape) == 3 and values.dtype.kind == "f":
        known &= np.isfinite(values).all(axis=0)
    at = ((pixel - low) * [width / size[0], height / size[1]]).astype(np.float32)
    column, row = (
        np.floor(at[:, k]).astype(np.int64).clip(0, limit - 1) for k, limit in ((0, width), (1, height))
    )
    nearest = picture[row, column]
    smooth, whole = (
        np.concatenate([_bilinear(image, part) for part in np.array_split(at, len(at) // 30_000 + 1)])
        for image in (picture, known.astype(np.uint8) * 255)
    )
    # Beside a gap the gap's black would shine through.
    return np.where((whole == 255)[:, None], smooth, nearest), known[row, column]


def _as_bytes(values: NDArray[np.generic], ortho: OrthoImage) -> NDArray[np.uint8]:
    """The image (h, w, 3) uint8 of the bands read (k, h, w)."""
    if ortho.palette is not None:
        table = np.array(ortho.palette, dtype=np.uint8)
        return np.asarray(table[values[0].astype(np.int64) & 255])
    if (ortho.low, ortho.high) != (0.0, 255.0) or values.dtype != np.uint8:
        scaled = (values.astype(np.float32) - ortho.low) * (255.0 / (ortho.high - ortho.low))
        values = np.clip(np.nan_to_num(scaled) + 0.5, 0, 255).astype(np.uint8)
    if len(values) == 1:
        values = np.repeat(values, 3, axis=0)
    return np.ascontiguousarray(np.moveaxis(values, 0, -1), dtype=np.uint8)


def _bilinear(image: NDArray[np.uint8], at: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Values (n, ...) at pixel coordinates (n, 2), the first pixel's centre at (0.5, 0.5); n below 32,768."""
    found = cv2.remap(
        image, at[:, None, 0] - 0.5, at[:, None, 1] - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found[:, 0], dtype=np.uint8)


@contextmanager
def opened_raster(path: Path) -> Iterator[Any]:
    """The open file.

    Raises:
        ScanFileError: GDAL finds something wrong, or it has no place on Earth.
        MissingExtraError: rasterio is not installed.
    """
    require("lidar", "An ortho image or a raster of heights", "rasterio")
    import rasterio

    try:
        with rasterio.open(path) as file:
            if file.transform.is_identity or file.transform.determinant == 0:
                raise ScanFileError(
                    f"{path}: the raster is not geo-referenced (no transform from cells to coordinates); "
                    "expected a GeoTIFF, or a raster with its world file"
                )
            yield file
    except rasterio.errors.RasterioError as error:
        raise ScanFileError(
            f"{path}: expected a raster that GDAL reads, e.g. a GeoTIFF: {error}; fetch it again"
        ) from error


def _bands(file: Any) -> tuple[tuple[int, int, int], tuple[tuple[int, int, int], ...] | None]:
    """Numbers of the bands of red, green and blue, and the colour table if there is one."""
    names = [interpretation.name for interpretation in file.colorinterp]
    if "palette" in names:
        number = names.index("palette") + 1
        table = file.colormap(number)
        return (number,) * 3, tuple(tuple(table.get(i, (0, 0, 0))[:3]) for i in range(256))
    if {"red", "green", "blue"} <= set(names):
        return tuple(names.index(name) + 1 for name in ("red", "green", "blue")), None  # type: ignore[return-value]
    usable = [i + 1 for i, name in enumerate(names) if name != "alpha"]
    if not usable:
        raise ScanFileError(f"{file.name}: expected a band of grey or three of colour, found {names}")
    return (tuple(usable[:3]) if len(usable) >= 3 else (usable[0],) * 3), None  # type: ignore[return-value]


def _range(file: Any, bands: tuple[int, int, int], palette: object) -> tuple[float, float]:
    """Values that become 0 and 255: the type's own for bytes, else of the image's bulk."""
    if palette is not None or all(file.dtypes[band - 1] == "uint8" for band in bands):
        return 0.0, 255.0
    scale = max(1.0, max(file.width, file.height) / _OVERVIEW_PX)
    shape = max(1, round(file.height / scale)), max(1, round(file.width / scale))
    values = (
        file.read(list(dict.fromkeys(bands)), out_shape=shape, masked=True).compressed().astype(np.float64)
    )
    values = values[np.isfinite(values)]
    if not len(values):
        raise ScanFileError(f"{file.name}: the image holds no data")
    low, high = np.percentile(values, _RANGE_PERCENT)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")  # TIFF and BigTIFF


def is_raster(path: Path) -> bool:
    """Whether a file is a TIFF, by its first bytes."""
    if not path.is_file():
        return path.suffix.lower() in (".tif", ".tiff")
    with path.open("rb") as stream:
        return stream.read(4) in _MAGIC


# What programs write for "no height" in files that do not say so.
_NO_HEIGHT = (-9999.0, -99999.0, -32767.0, -32768.0)


def open_dsm(path: Path) -> ScanFile:
    """What a raster of heights says, its box, and how many of its cells have a height.

    Raises:
        ScanFileError: no file, not a raster of heights, without a place on Earth, or without a height.
        MissingExtraError: the packages of the extra `lidar` are not installed.
    """
    if not path.is_file():
        raise ScanFileError(f"{path}: expected a GeoTIFF of heights, found no file; check the path")
    with opened_raster(path) as file:
        if file.count != 1 or file.dtypes[0] == "uint8" or np.dtype(file.dtypes[0]).kind not in "iuf":
            raise ScanFileError(
                f"{path}: expected one band of heights of 16 bits or more, found {file.count} of "
                f"{file.dtypes[0]}; a picture colours a scan: --ortho {path.name}"
            )
        wkt = file.crs.to_wkt() if file.crs else None
    points, low, high = measured(read_dsm(path, 1_000_000))
    if not points:
        raise ScanFileError(f"{path}: expected heights, found a raster in which every cell is empty")
    return ScanFile(
        path=path,
        sha256=file_sha256(path),
        size_bytes=path.stat().st_size,
        points=points,
        low=low,
        high=high,
        wkt=wkt,
        geo_keys=None,
        wkt_counts=True,
    )


def read_dsm(path: Path, chunk_points: int) -> Iterator[RawPoints]:
    """The middles of the cells that have a height, in the raster's CRS, about `chunk_points` at a time.

    Raises:
        ScanFileError: the file is broken.
    """
    with opened_raster(path) as file:
        from rasterio.windows import Window

        rows = max(1, chunk_points // file.width)
        scale, offset = file.scales[0], file.offsets[0]
        for top in range(0, file.height, rows):
            window = Window(0, top, file.width, min(rows, file.height - top))
            heights = file.read(1, window=window, masked=True).astype(np.float64)
            known = ~np.ma.getmaskarray(heights) & np.isfinite(heights.data)
            known &= ~np.isin(heights.data, _NO_HEIGHT)
            row, column = np.nonzero(known)
            x, y = file.transform @ (column + 0.5, row + top + 0.5)
            xyz = np.stack([x, y, heights.data[known] * scale + offset], axis=1)
            if not (np.abs(xyz) < LONGEST_COORDINATE).all():
                raise ScanFileError(
                    f"{path}: expected coordinates and heights below 1e9, found others from row {top} on; "
                    "say which value means 'no height', e.g. by gdal_edit.py -a_nodata"
                )
            yield RawPoints(
                xyz=xyz,
                rgb=None,
                intensity=np.zeros(len(xyz), np.uint16),
                classification=np.full(len(xyz), UNCLASSIFIED, np.uint8),
                withheld=np.zeros(len(xyz), np.bool_),
            )
