"""OpenDroneMap's `geo.txt`: positions of photos in any coordinate system.

The first line names the system (`featuredb.geo.crs.survey`). Then a line a photo: name, x (or longitude), y
(or latitude), and as far as they are known z, yaw, pitch, roll, horizontal and vertical accuracy, all in the
units of the system. Angles are in degrees as OpenDroneMap counts them: yaw clockwise from true north, pitch
0 looks straight down and 90 ahead, roll to the right; all zero where nobody knows them. Heights are taken as
those of any table. See https://docs.opendronemap.org/geo/.
"""

from collections.abc import Mapping
from typing import Any

from featuredb.errors import GeodesyError
from featuredb.features.exif.angles import DEFAULT_SIGMA_TILT_DEG, DEFAULT_SIGMA_YAW_DEG
from featuredb.geo.crs.survey import SurveyCrs, geodetic_from_survey, survey_crs
from featuredb.geometry.camera_angles import CameraAngles

COLUMNS = ("path", "lat", "lon", "height", "accuracy", "accuracy_height", "yaw", "pitch", "roll")
_VALUES = ("x", "y", "height", "yaw", "pitch", "roll", "accuracy", "accuracy_height")
_NONE = -9999.0  # how OpenDroneMap writes a height that nobody knows


def read_geo_txt(text: str) -> list[tuple[int, Mapping[str, Any] | str]]:
    """Number of each photo's line, and its values by `COLUMNS` or why it cannot be read.

    Raises:
        ValueError: the first line names no coordinate system.
    """
    lines = [line.strip() for line in text.splitlines()]
    try:
        crs = survey_crs(lines[0] if lines else "")
    except GeodesyError as error:
        raise ValueError(f"the first line has to name a coordinate system: {error}") from error
    return [
        (number, _row(line, crs))
        for number, line in enumerate(lines[1:], start=1)
        if line and not line.startswith("#")
    ]


def _row(line: str, crs: SurveyCrs) -> Mapping[str, Any] | str:
    name, *words = line.split()
    try:
        numbers = [float(word) for word in words[: len(_VALUES)]]
    except ValueError:
        return f"{name}: expected numbers after the name, found {' '.join(words)[:60]!r}"
    if len(numbers) < 2:
        return f"{name}: expected x and y after the name, found {len(numbers)} numbers"
    values = dict(zip(_VALUES, numbers, strict=False))
    known = values.get("height", _NONE) != _NONE
    try:
        ((latitude, longitude, height),) = geodetic_from_survey(
            crs, [[values["x"], values["y"], values["height"] if known else 0.0]]
        ).tolist()
    except GeodesyError as error:
        return f"{name}: {error}"
    return {
        "path": name,
        "lat": latitude,
        "lon": longitude,
        "height": height if known else None,
        "angles": _angles([values.get(key, 0.0) for key in ("yaw", "pitch", "roll")]),
        **{
            key: values[key] * crs.height_unit_m
            for key in ("accuracy", "accuracy_height")
            if values.get(key, 0.0) > 0.0
        },
    }


def _angles(ypr_deg: list[float]) -> CameraAngles | None:
    if not any(ypr_deg) or not all(abs(angle) <= 360.0 for angle in ypr_deg):
        return None
    yaw, pitch, roll = ypr_deg
    return CameraAngles.of_body(
        yaw, pitch, roll, sigma_yaw_deg=DEFAULT_SIGMA_YAW_DEG, sigma_tilt_deg=DEFAULT_SIGMA_TILT_DEG
    )
