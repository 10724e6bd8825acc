"""Rasters of heights (DSM, DEM): a cell is a point, so that a place without a scan has a ground as well."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from featuredb.errors import ScanFileError
from featuredb.file_digest import file_sha256
from featuredb.lidar.formats.las import LONGEST_COORDINATE, UNCLASSIFIED, RawPoints, ScanFile, measured
from featuredb.lidar.formats.ortho_image import opened_raster

_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")  # TIFF and BigTIFF


def is_raster(path: Path) -> bool:
    """Whether a file is a TIFF, by its first bytes."""
    if not path.is_file():
        return path.suffix.lower() in (".tif", ".tiff")
    with path.open("rb") as stream:
        return stream.read(4) in _MAGIC


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
