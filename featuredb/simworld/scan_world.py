"""Writes the scan and the ortho image of a simulated world, and those of a town that is not there.

Needs the extra `lidar` for the files' formats.
"""

from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.extras import require
from featuredb.geo.crs.wkt import utm_wkt
from featuredb.lidar.formats.las_stream import LasStream
from featuredb.simworld.laser.airborne import AirborneScan, AirborneScanOptions, scan_town
from featuredb.simworld.ortho import Ortho, OrthoOptions, make_ortho
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.town import make_town
from featuredb.simworld.world import WorldOptions, town_of

SCAN_FILE, ORTHO_FILE = "scan.laz", "ortho.tif"
OTHER_SCAN_FILE, OTHER_ORTHO_FILE = "other_town_scan.laz", "other_town_ortho.tif"
_OTHER_TOWN = 2000  # added to the seed: neither this town nor that of the negative photos

_STEP_M = 0.001
_ANGLE_STEP_DEG = 0.006  # of LAS 1.4's scan angle
_DAY = date(2025, 4, 2)  # of a spring before the photos


def write_scan(path: Path, scan: AirborneScan, rgb: NDArray[np.uint8] | None = None) -> None:
    """Write a scan in UTM with ellipsoidal heights; with colours (n, 3) where `rgb` is given.

    Raises:
        OSError: the file cannot be written.
    """
    columns: dict[str, NDArray[Any]] = {
        "intensity": scan.intensity,
        "classification": scan.classification,
        "return_number": scan.return_number,
        "number_of_returns": scan.number_of_returns,
        "scan_angle": np.round(scan.scan_angle_deg / _ANGLE_STEP_DEG).astype(np.int16),
        "gps_time": scan.gps_time_s,
        "point_source_id": scan.strip,
    }
    utm, wkt = scan.utm(), utm_wkt(scan.epsg, "ellipsoidal")
    offset = np.floor(utm.min(axis=0))
    with LasStream(path, wkt, offset=offset, step_m=_STEP_M, day=_DAY, rgb=rgb is not None) as stream:
        stream.write(utm, columns, rgb)


def write_lidar(
    folder: Path,
    world: WorldOptions,
    note: Callable[[str], None] = lambda name: None,
    *,
    scan: AirborneScanOptions | None = None,
    ortho: OrthoOptions | None = None,
) -> None:
    """Write scan and ortho image, each of a day of its own, of the world's town and of another one in its
    place, to which nothing registers.

    Args:
        note: gets each file's name before it is made.

    Raises:
        MissingExtraError: the packages of the extra `lidar` are not installed.
    """
    require("lidar", "A scan with an ortho image", "laspy", "lazrs", "rasterio")
    Path(folder).mkdir(parents=True, exist_ok=True)
    for scene, scan_name, ortho_name in (
        (town_of(world), SCAN_FILE, ORTHO_FILE),
        (other_town_here(world), OTHER_SCAN_FILE, OTHER_ORTHO_FILE),
    ):
        note(scan_name)
        write_scan(folder / scan_name, scan_town(scene, scan or AirborneScanOptions()))
        note(ortho_name)
        _write_ortho(folder / ortho_name, make_ortho(scene, ortho or OrthoOptions()))


def _write_ortho(path: Path, image: Ortho) -> None:
    """Write a GeoTIFF, tiled and compressed without loss."""
    import rasterio

    height, width, bands = image.rgb.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=width,
        height=height,
        count=bands,
        dtype=image.rgb.dtype,
        crs=f"EPSG:{image.epsg}",
        transform=rasterio.Affine(image.pixel_m, 0.0, image.west, 0.0, -image.pixel_m, image.north),
        tiled=True,
        blockxsize=256,
        blockysize=256,
        compress="deflate",
        predictor=2,
    ) as file:
        file.write(np.moveaxis(image.rgb, -1, 0))


def other_town_here(options: WorldOptions) -> Scene:
    """A town of another seed at the very place of the world's town."""
    return make_town(options.seed + _OTHER_TOWN, name="other town, same place", size_m=options.town_size_m)
