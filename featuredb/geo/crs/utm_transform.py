"""The way between UTM and the coordinates of a scan or an image that has its own reference system.

Of the operations that PROJ knows between the datums and has all files for, the one with the best stated
accuracy at the place is taken, for all points alike: an image and a scan of one system go to UTM by the same.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from featuredb.errors import GeodesyError
from featuredb.geo.crs.scan import DEMAND, ScanCrs, plane_part
from featuredb.geo.utm import geodetic_from_utm, utm_epsg, zone_of
from featuredb.geometry.arrays import FloatArray

# The area of use of a CRS is a box around countries and zones; surveys reach a little beyond. Three degrees
# are half a UTM zone: what lies farther out was read with the wrong CRS or the wrong unit.
_AREA_MARGIN_DEG = 3.0
_REACH_DEG = 0.05  # the area of interest around a place of an image: a few kilometres


@dataclass(frozen=True, slots=True, kw_only=True)
class UtmTransform:
    """The way from a scan's coordinates to UTM on WGS84, one and the same for all its points.

    Attributes:
        description: PROJ's name of the operation, e.g. "NAD83(HARN) to WGS 84 (3)".
        accuracy_m: its stated accuracy, or None where none is stated.
        z_scale: by which Z is multiplied first.
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
            columns = 3 if self.with_heights else 2
            utm[:, :columns] = np.stack(self._transformer.transform(*utm.T[:columns]), axis=1)
        except ProjError as error:
            raise GeodesyError(f"PROJ cannot transform the scan to EPSG:{self.epsg}: {error}") from error
        bad = ~np.isfinite(utm).all(axis=1)
        if bad.any():
            x, y, z = np.asarray(xyz)[bad][0].tolist()
            raise GeodesyError(
                f"expected coordinates of the scan's CRS, found X {x}, Y {y}, Z {z} that it cannot express; "
                f"{DEMAND}"
            )
        return utm


def utm_transform(crs: ScanCrs, low: FloatArray, high: FloatArray, epsg: int | None = None) -> UtmTransform:
    """The transform of a scan with a box of file coordinates to UTM.

    The zone is that of the box's centre unless given.

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
    group = _operations(source, target.to_3d() if crs.is_3d else target, (west, south, east, north), DEMAND)
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


def raster_from_utm(wkt: str, epsg: int, place: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """The function that takes UTM easting, northing (n, 2) to x, y (n, 2) of another reference system.

    What PROJ cannot convert becomes NaN.

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
        source = plane_part(CRS.from_user_input(wkt))
    except CRSError as error:
        raise GeodesyError(f"the image's reference system is not readable: {wkt!r:.200} ({error})") from error
    if not (source.is_projected or source.is_geographic):
        raise GeodesyError(
            f"expected an image in a projected or geographic reference system, found {source.type_name} "
            f"{source.name!r}; warp it, e.g. by gdalwarp -t_srs EPSG:{epsg}"
        )
    target = CRS.from_epsg(epsg)
    if source.equals(target, ignore_axis_order=True):
        return lambda utm: np.array(utm, dtype=np.float64)
    latitude, longitude, _ = geodetic_from_utm((place[0], place[1], 0.0), epsg)
    x, y = float(longitude), float(latitude)
    box = (x - _REACH_DEG, y - _REACH_DEG, x + _REACH_DEG, y + _REACH_DEG)
    best = _operations(source, target, box, "warp the image by gdalwarp").transformers[0]

    def convert(utm: FloatArray) -> FloatArray:
        try:
            xy = best.transform(utm[:, 0], utm[:, 1], direction=TransformDirection.INVERSE)
        except ProjError as error:
            raise GeodesyError(f"PROJ cannot convert EPSG:{epsg} to {source.name!r}: {error}") from error
        result = np.stack(xy, axis=1)
        result[~np.isfinite(result).all(axis=1)] = np.nan
        return result

    return convert


def _operations(
    source: CRS, target: CRS, box: tuple[float, float, float, float], advice: str
) -> TransformerGroup:
    """What PROJ knows between two systems in a box of degrees, best stated accuracy first."""
    west, south, east, north = box
    area: Any = AreaOfInterest(west, max(south, -90.0), east, min(north, 90.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whoever adds a scan is told of a missing grid
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=area)
    if not group.transformers:
        raise GeodesyError(f"PROJ knows no way from {source.name} to {target.name}; {advice}")
    return group


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
                f"expected 6,350 to 6,400: it is not the CRS of these points; {DEMAND}"
            )
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wgs84 = CRS.from_epsg(4979 if crs.is_3d else 4326)
            to_degrees = Transformer.from_crs(source, wgs84, always_xy=True)
        columns = 3 if crs.is_3d else 2
        degrees = np.array(to_degrees.transform(*corners[:, :columns].T))[:2].T
    except ProjError as error:
        raise GeodesyError(
            f"PROJ cannot use the CRS {crs.name!r} ({crs.source}): {error}; {DEMAND}"
        ) from error
    if not np.isfinite(degrees).all() or (abs(degrees) > [180.0, 90.0]).any():
        raise GeodesyError(
            f"the coordinates from {_numbers(low)} to {_numbers(high)} are none of the CRS {crs.name!r} "
            f"({crs.source}); {DEMAND}"
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
            f"that the CRS is for ({area.name}); {DEMAND}"
        )
    if beyond > 0.0:
        return (f"{where} lies {beyond:.2f} degrees outside the area that {name} is for ({area.name})",)
    return ()


def _numbers(values: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in values) + ")"
