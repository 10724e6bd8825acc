"""A scan as a LAZ file. Needs the extra `lidar`."""

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.crs.wkt import utm_wkt
from featuredb.lidar.formats.las_stream import LasStream
from featuredb.simworld.laser.airborne import AirborneScan

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
