"""Writes points as LAS 1.4 or LAZ, with their reference system as WKT."""

from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray

_STEP_M = 0.001
_ANGLE_STEP_DEG = 0.006  # of LAS 1.4's scan angle
_TO_16_BIT = 257  # LAS colours are 16 bits wide: 255 becomes 65535

Columns = dict[str, NDArray]  # type: ignore[type-arg]


def write_las(
    path: Path, xyz: FloatArray, wkt: str, columns: Columns, rgb: NDArray[np.uint8] | None = None
) -> None:
    """Write points to `path`; a name in .laz is compressed.

    Args:
        xyz: (n, 3) float64 in the system of `wkt`; kept to a millimetre (or a thousandth of its unit).
        columns: by laspy's names, e.g. intensity, classification, return_number, number_of_returns, gps_time,
            point_source_id; `scan_angle` is in degrees.
        rgb: (n, 3) uint8 or None.

    Raises:
        InvalidValueError: no points, or a column of another length.
        OSError: the file cannot be written.
    """
    n = len(xyz)
    wrong = {name: len(value) for name, value in columns.items() if len(value) != n}
    if n == 0 or wrong:
        raise InvalidValueError(f"write_las: expected at least one point and columns of {n}, found {wrong}")
    header = laspy.LasHeader(point_format=6 if rgb is None else 7, version="1.4")
    header.scales, header.offsets = np.full(3, _STEP_M), np.floor(xyz.min(axis=0))
    header.vlrs.append(WktCoordinateSystemVlr(wkt))
    header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    for name, value in columns.items():
        las[name] = np.round(value / _ANGLE_STEP_DEG).astype(np.int16) if name == "scan_angle" else value
    if rgb is not None:
        las.red, las.green, las.blue = rgb.T.astype(np.uint16) * _TO_16_BIT
    path.parent.mkdir(parents=True, exist_ok=True)
    las.write(path)
