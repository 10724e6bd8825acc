"""GeoTIFF keys, by which LAS files before 1.4 name their CRS, as a CRS of PROJ.

Keys and codes are those of the OGC GeoTIFF standard 1.1 (19-008r4). A file may name a code, a code of the
vertical CRS, or define its own projection; of the latter the three that scans come in are understood:
transverse Mercator, Lambert's conformal conic with two parallels, and Albers' equal-area conic.
"""

from collections.abc import Mapping

from pyproj import CRS
from pyproj.crs import CompoundCRS, Datum, GeographicCRS, ProjectedCRS  # type: ignore[attr-defined]
from pyproj.crs.coordinate_system import Cartesian2DCS
from pyproj.crs.enums import Cartesian2DCSAxis
from pyproj.exceptions import CRSError

from featuredb.errors import GeodesyError
from featuredb.geo.heights import FOOT_M, US_SURVEY_FOOT_M

GeoKeys = Mapping[int, int | float | str]

_MODEL_TYPE, _PROJECTED, _GEOGRAPHIC, _VERTICAL = 1024, 3072, 2048, 4096
_DATUM, _PROJECTION, _UNITS = 2050, 3075, 3076
_USER_DEFINED = 32767
_UNIT_AXES = {
    9001: (1.0, Cartesian2DCSAxis.EASTING_NORTHING),
    9002: (FOOT_M, Cartesian2DCSAxis.EASTING_NORTHING_FT),
    9003: (US_SURVEY_FOOT_M, Cartesian2DCSAxis.EASTING_NORTHING_US_FT),
}
# By the code of the method: PROJ's name of it, and the keys of its parameters, the first that is there.
_METHODS: dict[object, tuple[str, dict[str, tuple[int, ...]]]] = {
    1: ("tmerc", {"lat_0": (3081,), "lon_0": (3080,), "k_0": (3092,), "x_0": (3082,), "y_0": (3083,)}),
    8: (
        "lcc",
        {
            **{"lat_0": (3085, 3081), "lon_0": (3084, 3080), "lat_1": (3078,), "lat_2": (3079,)},
            **{"x_0": (3086, 3082), "y_0": (3087, 3083)},
        },
    ),
    11: (
        "aea",
        {
            **{"lat_0": (3081, 3085), "lon_0": (3080, 3084), "lat_1": (3078,), "lat_2": (3079,)},
            **{"x_0": (3082, 3086), "y_0": (3083, 3087)},
        },
    ),
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
    if axes is None or geodetic is None or projection not in _METHODS:
        raise GeodesyError(
            f"the file's GeoTIFF keys define a projection of their own that is not understood: "
            f"{_shown(keys)}; {demand}"
        )
    method, parameters = _METHODS[projection]
    values = {name: number(*sources) for name, sources in parameters.items()}
    values |= {name: values[name] * unit_m for name in ("x_0", "y_0")}
    if not values.get("k_0", 1.0):
        values["k_0"] = 1.0
    conversion = CRS.from_dict({"proj": method, **values}).coordinate_operation
    assert conversion is not None  # a projection has one
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
