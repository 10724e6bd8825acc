"""GeoTIFF keys, by which LAS files before 1.4 name their CRS, as a CRS of PROJ.

Keys and codes are those of the OGC GeoTIFF standard 1.1 (19-008r4). A file may name a code, a code of the
vertical CRS, or define its own projection; of the latter the three that scans come in are understood:
transverse Mercator, Lambert's conformal conic with two parallels, and Albers' equal-area conic.
"""

from collections.abc import Mapping

from pyproj import CRS
from pyproj.crs import (  # type: ignore[attr-defined]
    CompoundCRS,
    CoordinateOperation,
    Datum,
    GeographicCRS,
    ProjectedCRS,
)
from pyproj.crs.coordinate_operation import (
    AlbersEqualAreaConversion,
    LambertConformalConic2SPConversion,
    TransverseMercatorConversion,
)
from pyproj.crs.coordinate_system import Cartesian2DCS
from pyproj.crs.enums import Cartesian2DCSAxis
from pyproj.exceptions import CRSError

from featuredb.errors import GeodesyError

GeoKeys = Mapping[int, int | float | str]

_MODEL_TYPE, _PROJECTED, _GEOGRAPHIC, _VERTICAL = 1024, 3072, 2048, 4096
_DATUM, _PROJECTION, _UNITS = 2050, 3075, 3076
_USER_DEFINED = 32767
_UNIT_AXES = {
    9001: (1.0, Cartesian2DCSAxis.EASTING_NORTHING),
    9002: (0.3048, Cartesian2DCSAxis.EASTING_NORTHING_FT),
    9003: (1200.0 / 3937.0, Cartesian2DCSAxis.EASTING_NORTHING_US_FT),
}
_VERTICAL_OF_DATUM = {5103: 5703, 5171: 5773, 1027: 3855}  # writers put the datum's code for the CRS's


def crs_of_geo_keys(keys: GeoKeys, demand: str) -> CRS:
    """The CRS that the keys name.

    Args:
        keys: value of each key: codes as int, parameters as float, citations as str.
        demand: what the person is to do where it cannot be told.

    Raises:
        GeodesyError: none is named, or by codes or a projection that are not known.
    """
    try:
        horizontal = _horizontal(keys, demand)
        code = keys.get(_VERTICAL)
        if not isinstance(code, int) or code in (0, _USER_DEFINED) or len(horizontal.axis_info) == 3:
            return horizontal
        vertical = CRS.from_epsg(_VERTICAL_OF_DATUM.get(code, code))
        return CompoundCRS(f"{horizontal.name} + {vertical.name}", [horizontal, vertical])
    except CRSError as error:
        raise GeodesyError(
            f"the file's GeoTIFF keys {_shown(keys)} make no CRS ({error}); {demand}"
        ) from error


def _horizontal(keys: GeoKeys, demand: str) -> CRS:
    code = keys.get(_PROJECTED)
    if isinstance(code, int) and code not in (0, _USER_DEFINED):
        crs = CRS.from_epsg(code)
        _check_unit(keys, crs, demand)
        return crs
    if code == _USER_DEFINED:
        return _own_projection(keys, demand)
    geographic = keys.get(_GEOGRAPHIC)
    if isinstance(geographic, int) and geographic not in (0, _USER_DEFINED):
        return CRS.from_epsg(geographic)
    raise GeodesyError(f"the file's GeoTIFF keys name no CRS, found {_shown(keys)}; {demand}")


def _check_unit(keys: GeoKeys, crs: CRS, demand: str) -> None:
    """A unit beside a code must be the code's, or nobody knows which of the two the numbers have."""
    unit = keys.get(_UNITS)
    if not isinstance(unit, int) or unit not in _UNIT_AXES:
        return
    metres = _UNIT_AXES[unit][0]
    if abs(metres / crs.axis_info[0].unit_conversion_factor - 1.0) > 1e-9:
        raise GeodesyError(
            f"the file's GeoTIFF keys contradict each other: {crs.name} counts in "
            f"{crs.axis_info[0].unit_name}, the key of units says {metres:.10g} m; {demand}"
        )


def _own_projection(keys: GeoKeys, demand: str) -> CRS:
    """A CRS whose projection the file defines itself."""

    def number(*names: int) -> float:
        for name in names:
            value = keys.get(name)
            if isinstance(value, int | float):
                return float(value)
        return 0.0

    unit_m, axes = _UNIT_AXES.get(int(number(_UNITS)) or 9001, (0.0, None))
    projection, geodetic = keys.get(_PROJECTION), _geodetic(keys)
    if axes is None or geodetic is None or projection not in (1, 8, 11):
        raise GeodesyError(
            f"the file's GeoTIFF keys define a projection of their own that is not understood: "
            f"{_shown(keys)}; {demand}"
        )
    conversion: CoordinateOperation
    if projection == 1:
        conversion = TransverseMercatorConversion(
            latitude_natural_origin=number(3081),
            longitude_natural_origin=number(3080),
            false_easting=number(3082) * unit_m,
            false_northing=number(3083) * unit_m,
            scale_factor_natural_origin=number(3092) or 1.0,
        )
    elif projection == 8:
        conversion = LambertConformalConic2SPConversion(
            latitude_false_origin=number(3085, 3081),
            longitude_false_origin=number(3084, 3080),
            latitude_first_parallel=number(3078),
            latitude_second_parallel=number(3079),
            easting_false_origin=number(3086, 3082) * unit_m,
            northing_false_origin=number(3087, 3083) * unit_m,
        )
    else:
        conversion = AlbersEqualAreaConversion(
            latitude_first_parallel=number(3078),
            latitude_second_parallel=number(3079),
            latitude_false_origin=number(3081, 3085),
            longitude_false_origin=number(3080, 3084),
            easting_false_origin=number(3082, 3086) * unit_m,
            northing_false_origin=number(3083, 3087) * unit_m,
        )
    return ProjectedCRS(
        conversion,
        name=str(keys.get(1026) or keys.get(3073) or "projection defined by the file").strip("| \x00"),
        cartesian_cs=Cartesian2DCS(axes),
        geodetic_crs=geodetic,
    )


def _geodetic(keys: GeoKeys) -> CRS | None:
    code = keys.get(_GEOGRAPHIC)
    if isinstance(code, int) and code not in (0, _USER_DEFINED):
        return CRS.from_epsg(code)
    datum = keys.get(_DATUM)
    if isinstance(datum, int) and datum not in (0, _USER_DEFINED):
        return GeographicCRS(datum=Datum.from_epsg(datum))
    return None


def _shown(keys: GeoKeys) -> str:
    return ", ".join(f"{key}={value!r:.60}" for key, value in sorted(keys.items()) if key != _MODEL_TYPE)
