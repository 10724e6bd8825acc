"""Writes a LAS 1.4 or LAZ file piece by piece, so that its points need not fit into memory."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from datetime import date
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from featuredb.errors import InvalidValueError, MissingExtraError
from featuredb.geometry.arrays import FloatArray

_POINT_FORMAT_WITH_RGB = 7
_TO_16_BIT = 257  # LAS colours are 16 bits wide: 255 becomes 65535
_REACH = 2.0**31 - 1  # coordinates are 32-bit integers of steps from the offset
# The finest step with which the points' box can be told; the first is a tenth of what surveyors read off.
STEPS_M = (0.0001, 0.001)


class LasStream(AbstractContextManager["LasStream"]):
    """A file that is being written; leaving the block ends it.

    Args:
        path: a name in .laz is compressed.
        wkt: of the coordinates.
        low, high: (3,) box of all points to come; it sets offset and step.
        day: of creation, in the header; not today's, so that the same points are the same file.
        extra: further columns by name: type and description of at most 32 characters.

    Raises:
        InvalidValueError: the box is too large for any step of STEPS_M.
        MissingExtraError: laspy is not installed.
    """

    def __init__(
        self,
        path: Path,
        wkt: str,
        low: FloatArray,
        high: FloatArray,
        day: date,
        extra: Mapping[str, tuple[DTypeLike, str]],
    ) -> None:
        laspy = _laspy()
        header = laspy.LasHeader(point_format=_POINT_FORMAT_WITH_RGB, version="1.4")
        middle = np.round((np.asarray(low) + np.asarray(high)) / 2.0)
        reach = float(np.abs([low - middle, high - middle]).max()) + 1.0
        step = next((s for s in STEPS_M if reach < s * _REACH), None)
        if step is None:
            raise InvalidValueError(
                f"{path.name}: the points reach {reach / 1000:.0f} km from their middle, "
                f"{STEPS_M[-1] * _REACH / 1000:.0f} km is what LAS can hold to the millimetre"
            )
        header.scales, header.offsets = np.full(3, step), middle
        header.creation_date, header.generating_software = day, "featuredb"
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
        for name, (kind, text) in extra.items():
            header.add_extra_dim(laspy.ExtraBytesParams(name, kind, text))
        self._laspy, self._header = laspy, header
        self._writer = laspy.open(path, mode="w", header=header)

    def write(self, xyz: FloatArray, rgb: NDArray[np.uint8], columns: Mapping[str, NDArray[Any]]) -> None:
        """Points (n, 3) with colours (n, 3), and columns (n,) by name: of the format, or extra ones."""
        record = self._laspy.ScaleAwarePointRecord.zeros(len(xyz), header=self._header)
        record.x, record.y, record.z = xyz.T
        record.red, record.green, record.blue = rgb.T.astype(np.uint16) * _TO_16_BIT
        record.return_number[:] = record.number_of_returns[:] = 1
        for name, values in columns.items():
            record[name] = values
        self._writer.write_points(record)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()


def _laspy() -> Any:
    try:
        import laspy
        import lazrs  # noqa: F401  # laspy's writer of LAZ
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"Writing LAS needs the package {error.name}, which is not installed: "
            "pip install 'featuredb[lidar]'"
        ) from error
    return laspy
