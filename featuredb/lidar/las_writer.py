"""Writes points as LAS 1.4 or LAZ, with their reference system as WKT."""

from datetime import date
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


class LasStream:
    """A LAS 1.4 or LAZ file that is written piece by piece; use it in a `with` block.

    A file without points is not left behind. The same points give the same bytes.
    """

    def __init__(self, path: Path, wkt: str, offset: FloatArray, *, rgb: bool, time: date) -> None:
        """
        Args:
            path: a name in .laz is compressed.
            offset: (3,) from which coordinates are counted in the file, near the points.
            rgb: points have colours.
            time: the file's day of creation, which LAS wants to know.
        """
        header = laspy.LasHeader(point_format=7 if rgb else 6, version="1.4")
        header.scales, header.offsets = np.full(3, _STEP_M), offset
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
        header.creation_date, header.generating_software = time, "featuredb"
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._header = path, header
        self._written = False
        # One thread, since others would hand over their chunks as they come.
        backend = laspy.LazBackend.Lazrs if path.suffix == ".laz" else None
        self._writer = laspy.open(path, mode="w", header=header, laz_backend=backend)

    def write(self, xyz: FloatArray, columns: Columns, rgb: NDArray[np.uint8] | None = None) -> None:
        """Add points (n, 3), n > 0, with columns by laspy's names and colours (n, 3)."""
        record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=self._header)
        record.x, record.y, record.z = xyz.T
        for name, value in columns.items():
            record[name] = value
        if rgb is not None:
            record.red, record.green, record.blue = rgb.T.astype(np.uint16) * _TO_16_BIT
        self._writer.write_points(record)
        self._written = True

    def __enter__(self) -> "LasStream":
        return self

    def __exit__(self, *failed: object) -> None:
        self._writer.close()
        if not self._written:
            self._path.unlink()
