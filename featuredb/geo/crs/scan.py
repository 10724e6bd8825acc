"""The coordinate system of a scan: what a file says, and what a person says.

Files state it as WKT, as GeoTIFF keys, wrongly, or not at all. Here it becomes a horizontal CRS, a height
datum, and the unit of heights, each with the reason why it was taken so; what cannot be known is demanded,
never guessed. Heights keep their datum (featuredb.geo.datum) and only change their unit, except where they
are ellipsoidal: those go with the horizontal coordinates to WGS84.

X is easting or longitude and Y northing or latitude, as the LAS specification has it, whatever order of axes
the CRS's own definition has.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pyproj import CRS
from pyproj.exceptions import CRSError

from featuredb.errors import GeodesyError
from featuredb.geo.crs.geotiff_keys import GeoKeys, crs_of_geo_keys
from featuredb.geo.datum import HeightDatum, check_datum
from featuredb.geo.heights import FOOT_M, HEIGHT_UNITS, US_SURVEY_FOOT_M

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
DEMAND = (
    "state the coordinate system by --crs, e.g. --crs EPSG:32612, or with that of the heights, "
    "--crs EPSG:6556+5703"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanCrs:
    """The coordinate system of a scan's coordinates.

    Attributes:
        wkt: WKT2 of the horizontal CRS, or of the whole where heights are ellipsoidal (`is_3d`).
        name: of the horizontal CRS; with its EPSG code where it has one.
        source: where it was taken from: "--crs", "WKT" or "GeoTIFF keys".
        is_3d: heights are a coordinate of the CRS itself and go with it to WGS84.
        horizontal_unit: name of the unit of X and Y.
        height_datum: one of featuredb.geo.datum.HEIGHT_DATUMS.
        height_unit_m: metres per unit of Z.
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

    Raises:
        GeodesyError: there is none, it is broken, names no place on Earth, or has heights that point down.
        InvalidValueError: unknown height datum.
    """
    crs, source, notes = _chosen_crs(wkt, geo_keys, override)
    vertical = None
    if crs.is_compound:
        crs, vertical = crs.sub_crs_list[0], crs.sub_crs_list[1]
    # A bound compound is vertical, and projected as well: its heights would pass for ellipsoidal ones.
    if crs.is_vertical or not (crs.is_projected or crs.is_geographic or crs.is_geocentric):
        raise GeodesyError(
            f"expected a projected, geographic or geocentric CRS, found {crs.type_name} {crs.name!r} "
            f"({source}), which names no place on Earth; {DEMAND}"
        )
    _check_axes(crs, source)
    is_3d = vertical is None and len(crs.axis_info) == 3
    unit, unit_m, reason = height_unit_of(
        crs, vertical, is_3d, height_unit, geo_keys if source != "--crs" else None
    )
    datum = height_datum_of(vertical, is_3d)
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
                f"the file's WKT is not readable: {' '.join(wkt.split())!r:.200} ({error}); {DEMAND}"
            ) from error
    if geo_keys:
        return crs_of_geo_keys(geo_keys, DEMAND), "GeoTIFF keys", []
    raise GeodesyError(f"expected a coordinate system in the file, found none; {DEMAND}")


def _check_axes(crs: CRS, source: str) -> None:
    directions = {axis.direction.lower() for axis in crs.axis_info[:2]}
    if crs.is_projected and directions & {"south", "west"} and directions != {"south"}:
        raise GeodesyError(
            f"the CRS {crs.name!r} ({source}) counts towards {' and '.join(sorted(directions))}; scans are "
            "read as easting and northing only: transform the file first"
        )


def height_unit_of(
    crs: CRS, vertical: CRS | None, is_3d: bool, stated: str | None = None, geo_keys: GeoKeys | None = None
) -> tuple[str, float, str]:
    """Name of the unit of Z, metres per unit, and why.

    Args:
        crs: without the vertical part. stated: by a person.
    """
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
        why = "no vertical CRS is named: taken to be the horizontal unit; --height-unit m, ft or us-ft says "
        return axis.unit_name, axis.unit_conversion_factor, why + "otherwise"
    return "metre", 1.0, "no vertical CRS is named: taken to be metres; --height-unit says otherwise"


_UNIT_CODES = {9001: ("metre", 1.0), 9002: ("foot", FOOT_M), 9003: ("US survey foot", US_SURVEY_FOOT_M)}


def height_datum_of(vertical: CRS | None, is_3d: bool) -> HeightDatum:
    """What heights are counted from, "unknown" where the system does not say."""
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


def plane_part(crs: CRS) -> CRS:
    """The horizontal part of a compound system; any other as it is, without a bound transformation."""
    return (crs.sub_crs_list[0] if crs.is_compound else crs).to_2d()


def _name(crs: CRS) -> str:
    code = crs.to_epsg(min_confidence=100)
    return f"{crs.name} (EPSG:{code})" if code else str(crs.name)
