"""Vertical datums: a height says what it is measured from, or that nobody knows.

Datums are converted with PROJ's geoid grids, from files that are installed on this machine only. Where a grid
is missing the answer is a value that says so: treating one datum as another is an error of tens of metres.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.checks import as_geodetic
from featuredb.geo.heights import HEIGHT_DATUMS as HEIGHT_DATUMS
from featuredb.geo.heights import HeightDatum as HeightDatum
from featuredb.geo.projections import shift_heights

# Grid files of each geoid by PROJ's present and former names, best first; `projsync --file` installs one.
GEOID_GRIDS: dict[HeightDatum, tuple[str, ...]] = {
    "egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"),
    "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx"),
    "navd88": ("us_noaa_g2018u0.tif", "g2018u0.gtx"),  # GEOID18, the conterminous United States
}

# GEOID18 leads from NAVD88 to NAD83(2011), whose origin lies 2 m from WGS84's, so that heights above the two
# differ by decimetres to metres. EPSG:8970 (ITRF2014 to NAD83(2011)) at its reference epoch 2010.0, undone;
# WGS84 follows ITRF within centimetres, and plate motion since then changes heights by less.
_WGS84_FROM_NAD83 = (
    "+step +proj=cart +ellps=GRS80 +step +inv +proj=helmert +x=1.0053 +y=-1.90921 +z=-0.54157 "
    "+rx=0.02678138 +ry=-0.00042027 +rz=0.01093206 +s=0.00036891 +convention=coordinate_frame "
    "+step +inv +proj=cart +ellps=WGS84"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeightConversion:
    """A height above the WGS84 ellipsoid, or why there is none.

    Attributes:
        reason: "" when converted; otherwise what is missing and what to do.
    """

    height_m: float | None
    reason: str = ""

    def __post_init__(self) -> None:
        if (self.height_m is None) != bool(self.reason):
            raise InvalidValueError(
                "HeightConversion: expected either a height or a reason for its absence, found "
                f"height {self.height_m!r} and reason {self.reason!r}"
            )


def check_datum(name: str) -> HeightDatum:
    """The datum of that name.

    Raises:
        InvalidValueError: none of HEIGHT_DATUMS.
    """
    for datum in HEIGHT_DATUMS:
        if datum == name:
            return datum
    raise InvalidValueError(
        f"height datum: expected one of {', '.join(HEIGHT_DATUMS)}, found {name!r}; "
        "say 'unknown' rather than guess"
    )


def ellipsoidal_height(
    latitude_deg: float,
    longitude_deg: float,
    height_m: float,
    datum: str,
    grid_directories: Sequence[Path] | None = None,
) -> HeightConversion:
    """Height above the WGS84 ellipsoid of a height in a datum, at a place.

    Args:
        grid_directories: where to look for geoid grids; by default PROJ's own data directories.

    Returns:
        The height, or the reason why it is not known here. Never the network, never an assumed zero.

    Raises:
        InvalidValueError: unknown datum's name, or not finite.
        GeodesyError: latitude or longitude out of range.
    """
    checked = check_datum(datum)
    place = as_geodetic("ellipsoidal_height", (latitude_deg, longitude_deg, height_m)).rows
    if checked == "ellipsoidal":
        return HeightConversion(height_m=float(place[0, 2]))
    if checked == "unknown":
        return HeightConversion(
            height_m=None,
            reason="the height's datum is unknown; state it (one of "
            f"{', '.join(d for d in HEIGHT_DATUMS if d != 'unknown')}) to convert it",
        )
    grid = find_geoid_grid(checked, grid_directories)
    if grid is None:
        names = " or ".join(GEOID_GRIDS[checked])
        return HeightConversion(
            height_m=None,
            reason=f"the geoid grid of {checked} ({names}) is not installed; "
            f"install it by 'projsync --file {GEOID_GRIDS[checked][0]}' in PROJ's data directory",
        )
    try:
        height = shift_heights(place, grid, _WGS84_FROM_NAD83 if checked == "navd88" else "")[0]
    except GeodesyError as error:
        return HeightConversion(height_m=None, reason=str(error))
    if not np.isfinite(height):
        return HeightConversion(
            height_m=None,
            reason=f"latitude {latitude_deg}, longitude {longitude_deg} lies outside the geoid grid "
            f"{grid.name} of {checked}",
        )
    return HeightConversion(height_m=float(height))


def find_geoid_grid(datum: HeightDatum, directories: Sequence[Path] | None = None) -> Path | None:
    """The installed grid file of a datum's geoid, or None; by default looks where PROJ looks."""
    if directories is None:
        from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]

        listed = [*get_data_dir().split(os.pathsep), str(get_user_data_dir())]
        directories = [Path(directory) for directory in listed if directory]
    for name in GEOID_GRIDS.get(datum, ()):
        for directory in directories:
            if (directory / name).is_file():
                return (directory / name).resolve()
    return None
