"""UTM on WGS84: which zone, coordinates in and out, convergence and scale.

UTM is a map projection, not a metric frame: its scale is 0.9996 at the central meridian and grid north is not
true north. Distances and directions are therefore never computed in it; `LocalFrame` is for that.
"""

import math
from typing import Literal

from numpy.typing import ArrayLike

from featuredb.errors import GeodesyError
from featuredb.geo.checks import as_geodetic, as_utm
from featuredb.geo.projections import lat_lon_h_from_utm, utm_factors, utm_from_lat_lon_h
from featuredb.geometry.arrays import FloatArray

Hemisphere = Literal["north", "south"]

MIN_LATITUDE_DEG = -80.0  # south of it the Universal Polar Stereographic grid takes over
MAX_LATITUDE_DEG = 84.0  # north of it likewise
_EPSG_NORTH, _EPSG_SOUTH = 32600, 32700


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code (326zz north of the equator and on it, 327zz south) of the UTM zone of a place.

    A border meridian belongs to the zone east of it, so longitude 180 lies in zone 1. Zone 32 is widened over
    the south-west coast of Norway (32V) and zones 31, 33, 35, 37 over Svalbard, whose 32X, 34X and 36X do not
    exist (NGA.SIG.0012, 2014, section 3).

    Raises:
        GeodesyError: outside 80 S to 84 N, longitude outside [-180, 180], or not finite.
    """
    latitude, longitude = float(latitude_deg), float(longitude_deg)
    if not (MIN_LATITUDE_DEG <= latitude <= MAX_LATITUDE_DEG):
        raise GeodesyError(
            f"UTM: expected a latitude within [{MIN_LATITUDE_DEG:g}, {MAX_LATITUDE_DEG:g}] degrees, found "
            f"{latitude}; polar regions have no UTM zone"
        )
    if not -180.0 <= longitude <= 180.0:
        raise GeodesyError(f"UTM: expected a longitude within [-180, 180] degrees, found {longitude}")
    zone = math.floor((longitude + 180.0) / 6.0) % 60 + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 if longitude < 9.0 else 33 if longitude < 21.0 else 35 if longitude < 33.0 else 37
    return (_EPSG_NORTH if latitude >= 0.0 else _EPSG_SOUTH) + zone


def zone_of(epsg: int) -> tuple[int, Hemisphere]:
    """Zone 1..60 and hemisphere of an EPSG code.

    Raises:
        GeodesyError: not one of WGS84's UTM zones, 32601..32660 and 32701..32760.
    """
    hemispheres: tuple[tuple[int, Hemisphere], ...] = ((_EPSG_NORTH, "north"), (_EPSG_SOUTH, "south"))
    for base, hemisphere in hemispheres:
        if 1 <= epsg - base <= 60 and epsg == int(epsg):
            return int(epsg) - base, hemisphere
    raise GeodesyError(
        f"expected the EPSG code of a WGS84 UTM zone (32601..32660 or 32701..32760), found {epsg}; "
        "transform the data to UTM first"
    )


def utm_from_geodetic(lat_lon_h: ArrayLike, epsg: int) -> FloatArray:
    """Easting, northing, height in metres of WGS84 latitude, longitude (degrees) and height (m).

    The zone is the caller's: a point may lie in a neighbouring zone, which is what one wants at zone borders.
    Heights pass unchanged.

    Args:
        lat_lon_h: (n, 3) or (3,) float64.
        epsg: 326zz or 327zz.

    Raises:
        GeodesyError: not a UTM code, latitude or longitude out of range, or too far from the zone.
        InvalidValueError: wrong shape or not finite.
    """
    zone, hemisphere = zone_of(epsg)
    points = as_geodetic("utm_from_geodetic", lat_lon_h)
    return points.shaped_like_input(utm_from_lat_lon_h(points.rows, zone, hemisphere == "south"))


def geodetic_from_utm(utm: ArrayLike, epsg: int) -> FloatArray:
    """WGS84 latitude, longitude (degrees) and height (m) of UTM easting, northing, height in metres.

    The inverse of `utm_from_geodetic`, same shapes and errors; what looks like degrees is refused.
    """
    zone, hemisphere = zone_of(epsg)
    points = as_utm(f"coordinates in EPSG:{epsg}", utm)
    return points.shaped_like_input(lat_lon_h_from_utm(points.rows, zone, hemisphere == "south"))


def meridian_convergence_deg(latitude_deg: float, longitude_deg: float, epsg: int) -> float:
    """Angle in degrees from true north to grid north, clockwise, at a place, in the zone of `epsg`.

    Positive east of the central meridian on the northern hemisphere; grid azimuth = true azimuth minus it.

    Raises:
        GeodesyError: not a UTM code, coordinates out of range, or too far from the zone.
    """
    return _factors(latitude_deg, longitude_deg, epsg)[0]


def point_scale(latitude_deg: float, longitude_deg: float, epsg: int) -> float:
    """Grid metres per metre on the ellipsoid at a place, 0.9996 at the central meridian.

    Raises:
        GeodesyError: as `meridian_convergence_deg`.
    """
    return _factors(latitude_deg, longitude_deg, epsg)[1]


def _factors(latitude_deg: float, longitude_deg: float, epsg: int) -> tuple[float, float]:
    zone, hemisphere = zone_of(epsg)
    as_geodetic("UTM factors", (latitude_deg, longitude_deg, 0.0))
    return utm_factors(float(latitude_deg), float(longitude_deg), zone, hemisphere == "south")
