"""Where a place in UTM lies in the coordinates of an image that has its own reference system."""

import warnings
from collections.abc import Callable

import numpy as np
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from featuredb.errors import GeodesyError
from featuredb.geo.utm import geodetic_from_utm, zone_of
from featuredb.geometry.arrays import FloatArray

_REACH_DEG = 0.05  # the area of interest around a place: a few kilometres


def raster_from_utm(wkt: str, epsg: int, place: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """The function that takes UTM easting, northing (n, 2) to x, y (n, 2) of another reference system.

    Of PROJ's operations between the two datums the one with the best stated accuracy at the place is taken,
    as for scans: an image and a scan of one system go to UTM by the same one. What it cannot convert becomes
    NaN.

    Args:
        wkt: the image's system, WKT or anything that PROJ reads; a vertical part does not matter. x is
            easting or longitude, y northing or latitude.
        epsg: 326zz or 327zz.
        place: (2,) easting, northing in metres somewhere in the image.

    Raises:
        GeodesyError: the system is unreadable or names no place on Earth, or PROJ knows no way to it.
    """
    zone_of(epsg)
    try:
        source = CRS.from_user_input(wkt)
    except CRSError as error:
        raise GeodesyError(f"the image's reference system is not readable: {wkt!r:.200} ({error})") from error
    source = (source.sub_crs_list[0] if source.is_compound else source).to_2d()
    if not (source.is_projected or source.is_geographic):
        raise GeodesyError(
            f"expected an image in a projected or geographic reference system, found {source.type_name} "
            f"{source.name!r}; warp it, e.g. by gdalwarp -t_srs EPSG:{epsg}"
        )
    target = CRS.from_epsg(epsg)
    if source.equals(target, ignore_axis_order=True):
        return lambda utm: np.array(utm, dtype=np.float64)
    latitude, longitude, _ = geodetic_from_utm((place[0], place[1], 0.0), epsg)
    area = AreaOfInterest(
        float(longitude) - _REACH_DEG,
        max(float(latitude) - _REACH_DEG, -90.0),
        float(longitude) + _REACH_DEG,
        min(float(latitude) + _REACH_DEG, 90.0),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a missing grid is said where the scan is added
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=area)  # type: ignore[arg-type]
    if not group.transformers:
        raise GeodesyError(
            f"PROJ knows no way from {source.name!r} to EPSG:{epsg}; warp the image by gdalwarp"
        )
    best = group.transformers[0]

    def convert(utm: FloatArray) -> FloatArray:
        try:
            xy = best.transform(utm[:, 0], utm[:, 1], direction=TransformDirection.INVERSE)
        except ProjError as error:
            raise GeodesyError(f"PROJ cannot convert EPSG:{epsg} to {source.name!r}: {error}") from error
        result = np.stack(xy, axis=1)
        result[~np.isfinite(result).all(axis=1)] = np.nan
        return result

    return convert
