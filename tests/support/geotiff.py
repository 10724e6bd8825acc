"""Pictures with their place on Earth, as files."""

from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray


def write_geotiff(
    path: Path,
    image: NDArray[np.generic],
    *,
    epsg: int,
    west: float,
    north: float,
    pixel_m: float,
    nodata: float | None = None,
) -> None:
    """Write an image (h, w, bands) of uint8, uint16 or float32, tiled and compressed without loss.

    Args:
        west, north: outer corner of the top-left pixel, in the system's units.
        nodata: value that means "nothing here".

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, bands = image.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=width,
        height=height,
        count=bands,
        dtype=image.dtype,
        crs=f"EPSG:{epsg}",
        transform=rasterio.Affine(pixel_m, 0.0, west, 0.0, -pixel_m, north),
        nodata=nodata,
        tiled=True,
        blockxsize=256,
        blockysize=256,
        compress="deflate",
        predictor=2 if image.dtype.kind in "ui" else 3,
    ) as file:
        file.write(np.moveaxis(image, -1, 0))
