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

    Raises:
        GeodesyError: not a UTM code.
        InvalidValueError: not a datum's name.
    """
    crs, ellipsoidal = _zone_and_datum(epsg, height_datum)
    text = str(crs.to_wkt("WKT1_GDAL"))
    return f'COMPD_CS["{crs.name} + Ellipsoid (metre)",{text},{_ELLIPSOID}]' if ellipsoidal else text


def utm_projjson(epsg: int, height_datum: str) -> dict[str, Any]:
    """PROJJSON of a UTM zone with what its heights are counted from, for GeoParquet and STAC.

    A compound system with EGM96, EGM2008 or NAVD88; a projected 3D system for heights above the ellipsoid;
    the zone alone, in which z has no reference, where the datum is unknown.

    Raises:
        GeodesyError: not a UTM code.
        InvalidValueError: not a datum's name.
    """
    crs, ellipsoidal = _zone_and_datum(epsg, height_datum)
    document: dict[str, Any] = (crs.to_3d() if ellipsoidal else crs).to_json_dict()
    return document


def _zone_and_datum(epsg: int, height_datum: str) -> tuple[CRS, bool]:
    """The zone, as a compound system with a geoid's heights; whether heights are above the ellipsoid."""
    zone_of(epsg)
    datum = check_datum(height_datum)
    geoid = _EPSG_OF_DATUM.get(datum)
    crs = CRS.from_epsg(epsg) if geoid is None else CRS.from_user_input(f"EPSG:{epsg}+{geoid}")
    return crs, datum == "ellipsoidal"
