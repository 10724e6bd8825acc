"""The coordinate system of a scan: what a file says, what a person says, and the way from there to UTM.

Files state it as WKT, as GeoTIFF keys, wrongly, or not at all. Here it becomes a horizontal CRS, a height
datum, and the unit of heights, each with the reason why it was taken so; what cannot be known is demanded,
never guessed. Heights keep their datum (featuredb.geo.datum) and only change their unit, except where they
are
ellipsoidal: those go with the horizontal coordinates to WGS84.

X is easting or longitude and Y northing or latitude, as the LAS specification has it, whatever order of axes
the CRS's own definition has.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from featuredb.errors import GeodesyError
from featuredb.geo.datum import HeightDatum, check_datum
from featuredb.geo.geotiff_keys import GeoKeys, crs_of_geo_keys
from featuredb.geo.heights import FOOT_M, HEIGHT_UNITS, US_SURVEY_FOOT_M
from featuredb.geo.utm import utm_epsg, zone_of
from featuredb.geometry.arrays import FloatArray

# EPSG's vertical datums, and what other writers call them.
_DATUM_CODES: dict[int, HeightDatum] = {5103: "navd88", 5171: "egm96", 1027: "egm2008"}
_DATUM_NAMES: tuple[tuple[str, HeightDatum], ...] = (
    ("navd88", "navd88"),
    ("north american vertical datum 1988", "navd88"),
    ("north american vertical datum of 1988", "navd88"),
    ("egm96", "egm96"),
    ("egm2008", "egm2008"),
    ("ellipsoid", "ellipsoidal"),
)
_DEMAND = (
    "state the coordinate system by --crs, e.g. --crs EPSG:32612, or with that of the heights, "
    "--crs EPSG:6556+5703"
)
# The area of use of a CRS is a box around countries and zones; surveys reach a little beyond. Three degrees
# are half a UTM zone: what lies farther out was read with the wrong CRS or the wrong unit.
_AREA_MARGIN_DEG = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanCrs:
    """The coordinate system of a scan's coordinates.

    Attributes:
        wkt: WKT2 of the horizontal CRS, or of the whole where heights are ellipsoidal (`is_3d`).
        name: of the horizontal CRS; with its EPSG code where it has one.
        source: where it was taken from: "--crs", "WKT" or "GeoTIFF keys".
        is_3d: heights are a coordinate of the CRS itself and go with it to WGS84.
        horizontal_unit: name of the unit of X and Y.
        vertical_name: name of the vertical CRS, "" where the file has none.
        height_datum: one of featuredb.geo.datum.HEIGHT_DATUMS.
        height_unit: name of the unit of Z.
        height_unit_m: metres per unit of Z.
        height_unit_reason: why that unit was taken.
        notes: what a person should know: contradictions, assumptions.
    """

    wkt: str
    name: str
    source: str
    is_3d: bool
    horizontal_unit: str
    vertical_name: str
    height_datum: HeightDatum
    height_unit: str
    height_unit_m: float
    height_unit_reason: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class UtmTransform:
    """The way from a scan's coordinates to UTM on WGS84, one and the same for all its points.

    Attributes:
        epsg: zone of the result.
        description: PROJ's name of the operation, e.g. "NAD83(HARN) to WGS 84 (3)".
        accuracy_m: its stated accuracy, or None where none is stated.
        z_scale: by which Z is multiplied first.
        notes: what a person should know.
    """

    epsg: int
    description: str
    accuracy_m: float | None
    z_scale: float
    with_heights: bool
    notes: tuple[str, ...]
    _transformer: Transformer | None = field(repr=False)

    def apply(self, xyz: FloatArray) -> FloatArray:
        """UTM easting, northing, height (n, 3) in metres of file coordinates (n, 3).

        Raises:
            GeodesyError: a point that the CRS cannot express, e.g. far from its area.
        """
        utm = np.array(xyz, dtype=np.float64)
        utm[:, 2] *= self.z_scale
        if self._transformer is None or not len(utm):
            return utm
        try:
            if self.with_heights:
                utm[:, 0], utm[:, 1], utm[:, 2] = self._transformer.transform(utm[:, 0], utm[:, 1], utm[:, 2])
            else:
                utm[:, 0], utm[:, 1] = self._transformer.transform(utm[:, 0], utm[:, 1])
        except ProjError as error:
            raise GeodesyError(f"PROJ cannot transform the scan to EPSG:{self.epsg}: {error}") from error
        bad = ~np.isfinite(utm).all(axis=1)
        if bad.any():
            x, y, z = np.asarray(xyz)[bad][0].tolist()
            raise GeodesyError(
                f"expected coordinates of the scan's CRS, found X {x}, Y {y}, Z {z} that it cannot express; "
                f"{_DEMAND}"
            )
        return utm


def scan_crs(
    *,
    wkt: str | None = None,
    geo_keys: GeoKeys | None = None,
    override: str | None = None,
    height_unit: str | None = None,
    height_datum: str | None = None,
) -> ScanCrs:
    """The CRS of a scan from what its file holds and what a person says, who has the last word.

    Args:
        wkt: the file's WKT record, if any.
        geo_keys: the file's GeoTIFF keys, if any; used where there is no WKT.
        override: `--crs`: an EPSG code ("EPSG:2949", "EPSG:6556+5703"), WKT or PROJ string.
        height_unit: `--height-unit`: one of HEIGHT_UNITS.
        height_datum: `--height-datum`: one of HEIGHT_DATUMS.

    Raises:
        GeodesyError: there is none, it is broken, names no place on Earth, or has heights that point down.
        InvalidValueError: unknown height datum.
    """
    crs, source, notes = _chosen_crs(wkt, geo_keys, override)
    vertical = None
    if crs.is_compound:
        crs, vertical = crs.sub_crs_list[0], crs.sub_crs_list[1]
    if (
        crs.is_vertical
        or crs.is_engineering
        or not (crs.is_projected or crs.is_geographic or crs.is_geocentric)
    ):
        raise GeodesyError(
            f"expected a projected, geographic or geocentric CRS, found {crs.type_name} {crs.name!r} "
            f"({source}), which names no place on Earth; {_DEMAND}"
        )
    _check_axes(crs, source)
    is_3d = vertical is None and len(crs.axis_info) == 3
    unit, unit_m, reason = _height_unit(
        crs, vertical, is_3d, height_unit, geo_keys if source != "--crs" else None
    )
    datum = _height_datum(vertical, is_3d)
    if height_datum is not None:
        stated = check_datum(height_datum)
        if datum not in (stated, "unknown"):
            notes.append(f"heights are taken as {stated} as you say, though the CRS says {datum}")
        if is_3d and stated != "ellipsoidal":
            raise GeodesyError(
                f"--height-datum {stated}: the CRS {crs.name!r} has ellipsoidal heights as its third axis; "
                "state a CRS without heights by --crs"
            )
        datum = stated
    return ScanCrs(
        wkt=crs.to_wkt(),
        name=_name(crs),
        source=source,
        is_3d=is_3d,
        horizontal_unit=crs.axis_info[0].unit_name,
        vertical_name="" if vertical is None else _name(vertical),
        height_datum=datum,
        height_unit=unit,
        height_unit_m=unit_m,
        height_unit_reason=reason,
        notes=tuple(notes),
    )


def utm_transform(crs: ScanCrs, low: FloatArray, high: FloatArray, epsg: int | None = None) -> UtmTransform:
    """The transform of a scan with a box of file coordinates to UTM.

    The zone is that of the box's centre unless given. Of the operations that PROJ knows between the datums
    and has all files for, the one with the best stated accuracy at the place is taken, for all points alike.

    Args:
        low, high: (3,) corners of the scan's box, file coordinates.
        epsg: zone to use instead.

    Raises:
        GeodesyError: the box does not lie on Earth, or not in the area that the CRS is made for.
    """
    source = CRS.from_wkt(crs.wkt)
    west, south, east, north = _geographic_box(crs, source, low, high)
    notes = list(_check_area(source, crs.name, west, south, east, north))
    epsg = utm_epsg((south + north) / 2.0, _middle(west, east)) if epsg is None else epsg
    zone_of(epsg)
    target = CRS.from_epsg(epsg)
    if not crs.is_3d and source.equals(target, ignore_axis_order=True):
        return UtmTransform(
            epsg=epsg, description="none, it is in UTM already", accuracy_m=0.0, z_scale=crs.height_unit_m,
            with_heights=False, notes=tuple(notes), _transformer=None,
        )  # fmt: skip
    area: Any = AreaOfInterest(west, max(south, -90.0), east, min(north, 90.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a missing grid is said below
        group = TransformerGroup(
            source, target.to_3d() if crs.is_3d else target, always_xy=True, area_of_interest=area
        )
    if not group.transformers:
        raise GeodesyError(f"PROJ knows no way from {crs.name} to EPSG:{epsg}; {_DEMAND}")
    best = group.transformers[0]
    if not group.best_available and group.unavailable_operations:
        missing = group.unavailable_operations[0]
        notes.append(
            f"a better datum transformation needs a grid that is not installed ({missing.name}, "
            f"{missing.accuracy:g} m); PROJ's own tool `projsync` installs it"
        )
    accuracy = float(best.accuracy) if best.accuracy >= 0.0 else None
    # In a 3D CRS PROJ converts the unit of the third axis itself; what --height-unit says comes on top.
    axis_m = source.axis_info[2].unit_conversion_factor if crs.is_3d else 1.0
    return UtmTransform(
        epsg=epsg,
        description=best.description,
        accuracy_m=accuracy,
        z_scale=crs.height_unit_m / axis_m,
        with_heights=crs.is_3d,
        notes=tuple(notes),
        _transformer=best,
    )


def _chosen_crs(
    wkt: str | None, geo_keys: GeoKeys | None, override: str | None
) -> tuple[CRS, str, list[str]]:
    """The CRS that counts, where it is from, and notes."""
    if override is not None:
        try:
            return CRS.from_user_input(override), "--crs", []
        except CRSError as error:
            raise GeodesyError(
                f"--crs: expected an EPSG code such as EPSG:2949 or EPSG:6556+5703, WKT or a PROJ string, "
                f"found {override!r:.200} ({error})"
            ) from error
    if wkt is not None and wkt.strip():
        try:
            return CRS.from_wkt(wkt), "WKT", []
        except CRSError as error:
            raise GeodesyError(
                f"the file's WKT is not readable: {' '.join(wkt.split())!r:.200} ({error}); {_DEMAND}"
            ) from error
    if geo_keys:
        return crs_of_geo_keys(geo_keys, _DEMAND), "GeoTIFF keys", []
    raise GeodesyError(f"expected a coordinate system in the file, found none; {_DEMAND}")


def _check_axes(crs: CRS, source: str) -> None:
    directions = {axis.direction.lower() for axis in crs.axis_info[:2]}
    if (
        crs.is_projected
        and directions & {"south", "west"}
        and directions != {"south"}
        and directions != {"north"}
    ):
        raise GeodesyError(
            f"the CRS {crs.name!r} ({source}) counts towards {' and '.join(sorted(directions))}; scans are "
            "read as easting and northing only: transform the file first"
        )


def _height_unit(
    crs: CRS, vertical: CRS | None, is_3d: bool, stated: str | None, geo_keys: GeoKeys | None
) -> tuple[str, float, str]:
    """Name of the unit of Z, metres per unit, and why."""
    if stated is not None:
        if stated not in HEIGHT_UNITS:
            raise GeodesyError(f"--height-unit: expected one of {', '.join(HEIGHT_UNITS)}, found {stated!r}")
        return stated, HEIGHT_UNITS[stated], "as stated by --height-unit"
    if is_3d:
        axis = crs.axis_info[2]
        return axis.unit_name, axis.unit_conversion_factor, "third axis of the CRS"
    if vertical is not None:
        axis = vertical.axis_info[0]
        if axis.direction.lower() == "down":
            raise GeodesyError(
                f"the vertical CRS {vertical.name!r} counts depths downwards; expected heights: "
                "transform the file"
            )
        return axis.unit_name, axis.unit_conversion_factor, f"unit of the vertical CRS {vertical.name}"
    code = (geo_keys or {}).get(4099)
    if code in _UNIT_CODES:
        name, metres = _UNIT_CODES[int(code)]
        return name, metres, "the file's GeoTIFF key of vertical units"
    axis = crs.axis_info[0]
    if crs.is_projected and axis.unit_conversion_factor != 1.0:
        # LAStools, PDAL's reader and the surveyors' habit agree: what names no vertical CRS has one unit
        # throughout.
        return (
            axis.unit_name,
            axis.unit_conversion_factor,
            "no vertical CRS is named: taken to be the horizontal unit; "
            "--height-unit m, ft or us-ft says otherwise",
        )
    return "metre", 1.0, "no vertical CRS is named: taken to be metres; --height-unit says otherwise"


_UNIT_CODES = {
    9001: ("metre", 1.0),
    9002: ("foot", FOOT_M),
    9003: ("US survey foot", US_SURVEY_FOOT_M),
}


def _height_datum(vertical: CRS | None, is_3d: bool) -> HeightDatum:
    if is_3d:
        return "ellipsoidal"
    if vertical is None:
        return "unknown"
    identity: Mapping[str, Any] = {}
    if vertical.datum is not None:
        identity = vertical.datum.to_json_dict().get("id") or {}
    if identity.get("authority") == "EPSG" and identity.get("code") in _DATUM_CODES:
        return _DATUM_CODES[int(identity["code"])]
    names = f"{vertical.name} {vertical.datum.name if vertical.datum else ''}".lower().replace("_", " ")
    return next((datum for name, datum in _DATUM_NAMES if name in names), "unknown")


def _name(crs: CRS) -> str:
    code = crs.to_epsg(min_confidence=100)
    return f"{crs.name} (EPSG:{code})" if code else str(crs.name)


def _geographic_box(
    crs: ScanCrs, source: CRS, low: FloatArray, high: FloatArray
) -> tuple[float, float, float, float]:
    """West, south, east, north in degrees of a scan's box, roughly; it is only for choosing by."""
    if source.is_geocentric:
        radius = float(np.linalg.norm((np.asarray(low) + np.asarray(high)) / 2.0))
        if not 6.3e6 < radius < 6.5e6:
            raise GeodesyError(
                f"the CRS {crs.name!r} ({crs.source}) is geocentric, but the coordinates from "
                f"{_numbers(low)} to {_numbers(high)} lie {radius / 1e3:,.0f} km from the Earth's centre, "
                f"expected 6,350 to 6,400: it is not the CRS of these points; {_DEMAND}"
            )
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            to_degrees = Transformer.from_crs(
                source, CRS.from_epsg(4979 if crs.is_3d else 4326), always_xy=True
            )
        columns = 3 if crs.is_3d else 2
        degrees = np.array(to_degrees.transform(*corners[:, :columns].T))[:2].T
    except ProjError as error:
        raise GeodesyError(
            f"PROJ cannot use the CRS {crs.name!r} ({crs.source}): {error}; {_DEMAND}"
        ) from error
    if not np.isfinite(degrees).all() or (abs(degrees) > [180.0, 90.0]).any():
        raise GeodesyError(
            f"the coordinates from {_numbers(low)} to {_numbers(high)} are none of the CRS {crs.name!r} "
            f"({crs.source}); {_DEMAND}"
        )
    (west, south), (east, north) = degrees.min(axis=0), degrees.max(axis=0)
    if east - west > 180.0:  # across the antimeridian
        west, east = degrees[degrees[:, 0] > 0, 0].min(), degrees[degrees[:, 0] <= 0, 0].max()
    return float(west), float(south), float(east), float(north)


def _middle(west: float, east: float) -> float:
    middle = (west + east + (360.0 if east < west else 0.0)) / 2.0
    return middle - 360.0 if middle >= 180.0 else middle


def _check_area(
    source: CRS, name: str, west: float, south: float, east: float, north: float
) -> tuple[str, ...]:
    """Notes on where the scan lies beside the area of use, which only CRSs of a register have."""
    area = source.area_of_use
    if area is None:
        return ()
    longitude, latitude = _middle(west, east), (south + north) / 2.0
    width = (area.east - area.west) % 360.0 or 360.0
    past_west = (longitude - area.west + 180.0) % 360.0 - 180.0
    past_east = (longitude - area.east + 180.0) % 360.0 - 180.0
    beside = 0.0 if (longitude - area.west) % 360.0 <= width else min(abs(past_west), abs(past_east))
    beyond = max(beside, area.south - latitude, latitude - area.north, 0.0)
    where = f"latitude {latitude:.4f}, longitude {longitude:.4f}"
    if beyond > _AREA_MARGIN_DEG:
        raise GeodesyError(
            f"with the CRS {name} the scan would lie at {where}, {beyond:.1f} degrees outside the area "
            f"that the CRS is for ({area.name}); {_DEMAND}"
        )
    if beyond > 0.0:
        return (f"{where} lies {beyond:.2f} degrees outside the area that {name} is for ({area.name})",)
    return ()


def _numbers(values: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in values) + ")"
