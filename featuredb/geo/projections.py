"""Typed adapter around PROJ: the few conversions that the geodesy needs, all on WGS84.

Every conversion is a PROJ pipeline written out in full, so none of them looks up a database, a grid or the
network, and axis order is always longitude before latitude. pyproj makes a Transformer usable from several
threads by itself but not a Proj, so all objects are kept per thread here and created once in each. It is
imported with the first of them: most commands that only look at a database convert nothing.
"""

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import GeodesyError
from featuredb.geometry.arrays import FloatArray

if TYPE_CHECKING:
    from pyproj import Proj, Transformer

WGS84_SEMI_MAJOR_M = 6378137.0
WGS84_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)

_DEGREES_IN = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step "
_GEOCENTRIC = _DEGREES_IN + "+proj=cart +ellps=WGS84"


class _PerThread(threading.local):
    def __init__(self) -> None:
        self.transformers: dict[str, Transformer] = {}
        self.projections: dict[str, Proj] = {}


_per_thread = _PerThread()


def ecef_from_geodetic(lat_lon_h: FloatArray) -> FloatArray:
    """Geocentric x, y, z (n, 3) in metres of latitude, longitude (degrees) and ellipsoidal height (m)."""
    return _transform(_GEOCENTRIC, lat_lon_h[:, [1, 0, 2]])


def geodetic_from_ecef(ecef: FloatArray) -> FloatArray:
    """Latitude, longitude (degrees) and ellipsoidal height (m), (n, 3), of geocentric points (n, 3) in m.

    PROJ inverts in one step of Bowring's method, which is wrong by a micrometre 10 km above the ellipsoid and
    by millimetres in orbit; one Newton step on its latitude and height brings the error down to float64's
    resolution. Longitude needs none: it is the arc tangent of y over x.
    """
    geodetic = _transform(_GEOCENTRIC, ecef, inverse=True)[:, [1, 0, 2]]
    residual = ecef - ecef_from_geodetic(geodetic)
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    _, north, up = np.einsum("nij,nj->in", enu_from_ecef_rotation(latitude, longitude), residual)
    w_squared = 1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    prime_vertical = WGS84_SEMI_MAJOR_M / np.sqrt(w_squared)
    meridional = prime_vertical * (1.0 - _ECCENTRICITY_SQUARED) / w_squared
    geodetic[:, 0] = np.clip(geodetic[:, 0] + np.degrees(north / (meridional + geodetic[:, 2])), -90.0, 90.0)
    geodetic[:, 2] += up
    return geodetic


def enu_from_ecef_rotation(latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> FloatArray:
    """Rotations (..., 3, 3) from geocentric axes to east, north, up at the given places (radians)."""
    latitude, longitude = np.broadcast_arrays(
        np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
    )
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    rotation = np.empty((*latitude.shape, 3, 3))
    rotation[..., 0, :] = np.stack([-sin_lon, cos_lon, np.zeros_like(sin_lon)], axis=-1)
    rotation[..., 1, :] = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    rotation[..., 2, :] = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return rotation


def utm_from_lat_lon_h(lat_lon_h: FloatArray, zone: int, south: bool) -> FloatArray:
    """Easting, northing, height (n, 3) in metres of latitude, longitude (degrees), height (m)."""
    return _transform(_DEGREES_IN + _utm_definition(zone, south), lat_lon_h[:, [1, 0, 2]])


def lat_lon_h_from_utm(utm: FloatArray, zone: int, south: bool) -> FloatArray:
    """Latitude, longitude (degrees), height (n, 3) of easting, northing, height (n, 3) in metres.

    At the antimeridian PROJ leaves longitudes of up to 1e-12 radians beyond 180 degrees.
    """
    geodetic = _transform(_DEGREES_IN + _utm_definition(zone, south), utm, inverse=True)[:, [1, 0, 2]]
    geodetic[:, 1] = np.clip(geodetic[:, 1], -180.0, 180.0)
    return geodetic


def shift_heights(lat_lon_h: FloatArray, grid: Path, after: str = "") -> FloatArray:
    """Heights (n,) in metres after adding a geoid grid's undulation; infinity outside the grid.

    Args:
        lat_lon_h: (n, 3) latitude, longitude (degrees), height (m) above the geoid.
        grid: a grid file; given by its full path, PROJ looks for it nowhere else.
        after: further steps of the pipeline, in radians.

    Raises:
        GeodesyError: PROJ cannot read the grid.
    """
    from pyproj.exceptions import ProjError

    pipeline = f'{_DEGREES_IN}+proj=vgridshift +grids="{grid}" +multiplier=1 {after}'
    try:
        shifted = _raw_transform(pipeline, lat_lon_h[:, [1, 0, 2]])
    except ProjError as error:
        raise GeodesyError(f"PROJ cannot read the geoid grid {grid}; install it anew ({error})") from error
    return shifted[:, 2]


def utm_factors(latitude_deg: float, longitude_deg: float, zone: int, south: bool) -> tuple[float, float]:
    """Meridian convergence in degrees and point scale of a UTM zone at one place, by PROJ's derivatives."""
    definition = _utm_definition(zone, south)
    projection = _per_thread.projections.get(definition)
    if projection is None:
        from pyproj import Proj

        projection = _per_thread.projections[definition] = Proj(definition)
    factors = projection.get_factors(longitude_deg, latitude_deg, errcheck=False)
    convergence, scale = float(factors.meridian_convergence), float(factors.meridional_scale)
    if not (np.isfinite(convergence) and np.isfinite(scale)):
        raise GeodesyError(
            f"UTM zone {zone} has no scale or convergence at latitude {latitude_deg}, longitude "
            f"{longitude_deg}: too far from the zone's central meridian; use the place's own zone"
        )
    return convergence, scale


def _utm_definition(zone: int, south: bool) -> str:
    return f"+proj=utm +zone={zone} {'+south ' if south else ''}+ellps=WGS84"


def _transform(pipeline: str, points: FloatArray, *, inverse: bool = False) -> FloatArray:
    result = _raw_transform(pipeline, points, inverse=inverse)
    bad = ~np.isfinite(result).all(axis=1)
    if bad.any():
        raise GeodesyError(
            f"PROJ cannot convert {int(bad.sum())} of {len(result)} points, the first being "
            f"{points[bad][0].tolist()}; they lie outside the domain of '{pipeline}'"
        )
    return result


def _raw_transform(pipeline: str, points: FloatArray, *, inverse: bool = False) -> FloatArray:
    """Points (n, 3) through a pipeline, as PROJ answers: infinity for what it cannot convert."""
    from pyproj import Transformer
    from pyproj.enums import TransformDirection

    transformer = _per_thread.transformers.get(pipeline)
    if transformer is None:
        transformer = _per_thread.transformers[pipeline] = Transformer.from_pipeline(pipeline)
    direction = TransformDirection.INVERSE if inverse else TransformDirection.FORWARD
    x, y, z = np.ascontiguousarray(points.T)
    return np.stack(transformer.transform(x, y, z, direction=direction), axis=1)
