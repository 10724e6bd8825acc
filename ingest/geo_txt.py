"""OpenDroneMap's `geo.txt`: positions of photos in any coordinate system.

The first line names the system: `EPSG:32632`, a PROJ string or `WGS84 UTM 32N`. Then a line a photo: name,
x (or longitude), y (or latitude), and as far as they are known z, yaw, pitch, roll, horizontal and vertical
accuracy, all in the units of the system. See https://docs.opendronemap.org/geo/.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

COLUMNS = ("path", "lat", "lon", "height", "accuracy", "accuracy_height")
_UTM = re.compile(r"^WGS84 UTM (\d{1,2})([NS])$", re.IGNORECASE)
_VALUES = ("x", "y", "height", "yaw", "pitch", "roll", "accuracy", "accuracy_height")
_NONE = -9999.0  # how OpenDroneMap writes a height that nobody knows


def read_geo_txt(text: str) -> list[tuple[int, Mapping[str, Any] | str]]:
    """Number of each photo's line, and its values by `COLUMNS` or why it cannot be read.

    Raises:
        ValueError: the first line names no coordinate system.
    """
    lines = [line.strip() for line in text.splitlines()]
    crs = _crs(lines[0] if lines else "")
    transform = Transformer.from_crs(crs, 4326, always_xy=True)
    metre = 1.0 if crs.is_geographic else float(crs.axis_info[0].unit_conversion_factor)
    rows: list[tuple[int, Mapping[str, Any] | str]] = []
    for number, line in enumerate(lines[1:], start=1):
        if line and not line.startswith("#"):
            rows.append((number, _row(line, transform, metre)))
    return rows


def _crs(line: str) -> CRS:
    utm = _UTM.match(line)
    try:
        return CRS(f"EPSG:{326 if utm[2].upper() == 'N' else 327}{int(utm[1]):02d}" if utm else line)
    except CRSError:
        raise ValueError(
            "the first line has to name a coordinate system, such as EPSG:4326 or WGS84 UTM 32N, "
            f"and is {line[:60]!r}"
        ) from None


def _row(line: str, transform: Transformer, metre: float) -> Mapping[str, Any] | str:
    name, *words = line.split()
    try:
        numbers = [float(word) for word in words[: len(_VALUES)]]
    except ValueError:
        return f"{name}: expected numbers after the name, found {' '.join(words)[:60]!r}"
    if len(numbers) < 2:
        return f"{name}: expected x and y after the name, found {len(numbers)} numbers"
    values = dict(zip(_VALUES, numbers, strict=False))
    longitude, latitude = transform.transform(values["x"], values["y"])
    if not (math.isfinite(longitude) and math.isfinite(latitude)):
        return f"{name}: {values['x']:g}, {values['y']:g} is no place of the coordinate system"
    height = values.get("height", _NONE)
    return {
        "path": name,
        "lat": latitude,
        "lon": longitude,
        "height": None if height == _NONE else height * metre,
        **{key: values[key] * metre for key in ("accuracy", "accuracy_height") if values.get(key, 0.0) > 0.0},
    }
