"""Coordinates of other reference systems, as surveyors hand them over, to WGS84.

A survey names its system by an EPSG code, a PROJ string, or in words ("WGS84 UTM 11N", OpenDroneMap's way).
Axes are always taken as x (easting or longitude) before y (northing or latitude), whatever the system's
definition says: that is how such files are written.
"""

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from featuredb.errors import GeodesyError
from featuredb.geo.crs.scan import height_datum_of, height_unit_of, plane_part
from featuredb.geo.datum import HeightDatum
from featuredb.geometry.arrays import FloatArray

_UTM_WORDS = re.compile(r"^\s*WGS\s*-?84\s+UTM\s+(?:zone\s+)?(\d{1,2})\s*([NS])\s*$", re.IGNORECASE)
_EXAMPLES = "e.g. EPSG:32611, WGS84 UTM 11N or +proj=utm +zone=11 +datum=WGS84 +units=m +no_defs"


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyCrs:
    """A reference system of survey coordinates.

    Attributes:
        geographic: x, y are longitude, latitude in degrees.
        height_unit_m: metres per unit of height: the vertical system's, else that of the plane's axes.
        height_datum: what heights are counted from, "unknown" where the system does not say.
    """

    definition: str
    name: str
    geographic: bool
    height_unit_m: float
    height_datum: HeightDatum


def survey_crs(text: str) -> SurveyCrs:
    """The system that a header names.

    Raises:
        GeodesyError: not a reference system that PROJ knows, or one without a plane or geographic part.
    """
    words = _UTM_WORDS.match(text)
    definition = text.strip()
    if words:
        zone = int(words[1])
        if not 1 <= zone <= 60:
            raise GeodesyError(f"expected a UTM zone from 1 to 60, found {zone} in {definition!r}")
        definition = f"EPSG:{(32600 if words[2].upper() == 'N' else 32700) + zone}"
    try:
        crs = CRS.from_user_input(definition)
    except CRSError as error:
        raise GeodesyError(
            f"expected a coordinate reference system, {_EXAMPLES}; found {text.strip()!r}"
        ) from error
    plane = plane_part(crs)
    if not (plane.is_projected or plane.is_geographic):
        raise GeodesyError(
            f"expected a plane or geographic reference system, {_EXAMPLES}; found {crs.name!r} "
            f"({crs.type_name})"
        )
    vertical = crs.sub_crs_list[1] if crs.is_compound else None
    is_3d = vertical is None and len(crs.axis_info) == 3
    return SurveyCrs(
        definition=definition,
        name=crs.name if crs.name != "unknown" else definition,
        geographic=bool(plane.is_geographic),
        height_unit_m=height_unit_of(crs if is_3d else plane, vertical, is_3d)[1],
        # Surveys' plane systems count heights from a benchmark more often than from the ellipsoid, whatever
        # their third axis is called: a person may say.
        height_datum=height_datum_of(vertical, is_3d and plane.is_geographic),
    )


def geodetic_from_survey(crs: SurveyCrs, xyz: ArrayLike) -> FloatArray:
    """WGS84 latitude, longitude (degrees) and height (metres, datum unchanged), (n, 3), of survey x, y, z.

    Args:
        xyz: (n, 3) x, y in the system's units, z in its height unit; NaN heights stay NaN.

    Raises:
        GeodesyError: PROJ cannot convert a point.
    """
    points = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
    x, y = np.ascontiguousarray(points[:, :2].T)
    longitude, latitude = _to_wgs84(crs.definition).transform(x, y)
    result = np.stack([latitude, longitude, points[:, 2] * crs.height_unit_m], axis=1)
    bad = ~np.isfinite(result[:, :2]).all(axis=1)
    if bad.any():
        raise GeodesyError(
            f"{int(bad.sum())} of {len(points)} points cannot be converted from {crs.name} to WGS84, the "
            f"first being {points[bad][0].tolist()}; check the reference system and the order of x and y"
        )
    return result


@lru_cache(maxsize=16)
def _to_wgs84(definition: str) -> Transformer:
    return Transformer.from_crs(plane_part(CRS.from_user_input(definition)), "EPSG:4326", always_xy=True)
