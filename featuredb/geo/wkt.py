"""UTM reference systems as text, for files that carry one: LAS 1.4, GeoTIFF, GeoParquet, STAC."""

from typing import Any

from pyproj import CRS

from featuredb.geo.datum import check_datum
from featuredb.geo.utm import zone_of

_EPSG_OF_DATUM = {"egm96": 5773, "egm2008": 3855, "navd88": 5703}
# The way in which LAS files have said "heights above the ellipsoid" since WKT 1, which has no axis for them.
_ELLIPSOID = 'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1],AXIS["Up",UP]]'


def utm_wkt(epsg: int, height_datum: str) -> str:
    """WKT 1 of a UTM zone with its vertical datum; of the zone alone where the datum is unknown.

    Args:
        epsg: 326zz or 327zz.
        height_datum: one of featuredb.geo.datum.HEIGHT_DATUMS.

    Raises:
        GeodesyError: not a UTM code.
        InvalidValueError: not a datum's name.
    """
    zone_of(epsg)
    datum = check_datum(height_datum)
    if datum in _EPSG_OF_DATUM:
        return str(CRS.from_user_input(f"EPSG:{epsg}+{_EPSG_OF_DATUM[datum]}").to_wkt("WKT1_GDAL"))
    zone = CRS.from_epsg(epsg)
    plane = str(zone.to_wkt("WKT1_GDAL"))
    return (
        plane if datum == "unknown" else f'COMPD_CS["{zone.name} + Ellipsoid (metre)",{plane},{_ELLIPSOID}]'
    )


def utm_projjson(epsg: int, height_datum: str) -> dict[str, Any]:
    """PROJJSON of a UTM zone with what its heights are counted from, for GeoParquet and STAC.

    A compound system with EGM96, EGM2008 or NAVD88; a projected 3D system for heights above the ellipsoid;
    the zone alone, in which z has no reference, where the datum is unknown.

    Args:
        epsg: 326zz or 327zz.
        height_datum: one of featuredb.geo.datum.HEIGHT_DATUMS.

    Raises:
        GeodesyError: not a UTM code.
        InvalidValueError: not a datum's name.
    """
    zone_of(epsg)
    datum = check_datum(height_datum)
    if datum in _EPSG_OF_DATUM:
        crs = CRS.from_user_input(f"EPSG:{epsg}+{_EPSG_OF_DATUM[datum]}")
    else:
        crs = CRS.from_epsg(epsg) if datum == "unknown" else CRS.from_epsg(epsg).to_3d()
    document: dict[str, Any] = crs.to_json_dict()
    return document
