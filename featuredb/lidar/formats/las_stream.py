"""Writes a LAS 1.4 or LAZ file piece by piece, so that its points need not fit into memory."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.las import import_laspy

_WITH_RGB, _WITHOUT_RGB = 7, 6  # LAS 1.4's point formats
_TO_16_BIT = 257  # LAS colours are 16 bits wide: 255 becomes 65535
_REACH = 2.0**31 - 1  # coordinates are 32-bit integers of steps from the offset
# The finest step with which the points' box can be told; the first is a tenth of what surveyors read off.
STEPS_M = (0.0001, 0.001)


def offset_and_step(low: FloatArray, high: FloatArray) -> tuple[FloatArray, float]:
    """Offset (3,) and step, metres, by which a file tells coordinates between two corners (3,) of a box.

    Raises:
        InvalidValueError: the box is too large for any step of STEPS_M.
    """
    middle = np.round((np.asarray(low) + np.asarray(high)) / 2.0)
    reach = float(np.abs([low - middle, high - middle]).max()) + 1.0
    for step in STEPS_M:
        if reach < step * _REACH:
            return middle, step
    raise InvalidValueError(
        f"the points reach {reach / 1000:.0f} km from their middle, {STEPS_M[-1] * _REACH / 1000:.0f} km is "
        "what LAS can hold to the millimetre"
    )


class LasStream(AbstractContextManager["LasStream"]):
    """A file that is being written; leaving the block ends it. The same points give the same bytes.

    A file without points is not left behind.

    Args:
        path: a name in .laz is compressed.
        wkt: of the coordinates.
        offset: (3,) from which coordinates are counted in the file. step_m: to which they are rounded.
        day: of creation, in the header; not today's, so that the same points are the same file.
        rgb: points have colours.
        extra: further columns by name: type and description of at most 32 characters.

    Raises:
        MissingExtraError: laspy is not installed.
    """

    def __init__(
        self,
        path: Path,
        wkt: str,
        *,
        offset: FloatArray,
        step_m: float,
        day: date,
        rgb: bool = True,
        extra: Mapping[str, tuple[DTypeLike, str]] | None = None,
    ) -> None:
        laspy = import_laspy("Writing LAS")
        header = laspy.LasHeader(point_format=_WITH_RGB if rgb else _WITHOUT_RGB, version="1.4")
        header.scales, header.offsets = np.full(3, step_m), offset
        header.creation_date, header.generating_software = day, "featuredb"
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
        for name, (kind, text) in (extra or {}).items():
            header.add_extra_dim(laspy.ExtraBytesParams(name, kind, text))
        path.parent.mkdir(parents=True, exist_ok=True)
        self._laspy, self._header, self._path = laspy, header, path
        self._written = False
        # One thread, since others would hand over their chunks as they come.
        backend = laspy.LazBackend.Lazrs if path.suffix == ".laz" else None
        self._writer = laspy.open(path, mode="w", header=header, laz_backend=backend)

    def write(
        self, xyz: FloatArray, columns: Mapping[str, NDArray[Any]], rgb: NDArray[np.uint8] | None = None
    ) -> None:
        """Add points (n, 3), n > 0, with columns (n,) by name, of the format or extra, and colours (n, 3)."""
        record = self._laspy.ScaleAwarePointRecord.zeros(len(xyz), header=self._header)
        record.x, record.y, record.z = xyz.T
        if rgb is not None:
            record.red, record.green, record.blue = rgb.T.astype(np.uint16) * _TO_16_BIT
        record.return_number[:] = record.number_of_returns[:] = 1
        for name, values in columns.items():
            record[name] = values
        self._writer.write_points(record)
        self._written = True

    def __exit__(self, *failed: object) -> None:
        self._writer.close()
        if not self._written:
            self._path.unlink()
