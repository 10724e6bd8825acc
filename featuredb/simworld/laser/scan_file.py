"""A scan as a LAZ file. Needs the extra `lidar`."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.crs.wkt import utm_wkt
from featuredb.lidar.formats.las_writer import Columns, write_las
from featuredb.simworld.laser.airborne import AirborneScan


def write_scan(path: Path, scan: AirborneScan, rgb: NDArray[np.uint8] | None = None) -> None:
    """Write a scan in UTM with ellipsoidal heights; with colours (n, 3) where `rgb` is given.

    Raises:
        OSError: the file cannot be written.
    """
    columns: Columns = {
        "intensity": scan.intensity,
        "classification": scan.classification,
        "return_number": scan.return_number,
        "number_of_returns": scan.number_of_returns,
        "scan_angle": scan.scan_angle_deg,
        "gps_time": scan.gps_time_s,
        "point_source_id": scan.strip,
    }
    write_las(path, scan.utm(), utm_wkt(scan.epsg, "ellipsoidal"), columns, rgb)
