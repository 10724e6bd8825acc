"""EXIF's way of writing positions and numbers, for photos that are written here."""

from fractions import Fraction
from typing import Literal

from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational

# Denominator of arc seconds: 1e-5" is 0.3 mm on the ground, so a truth prior is exact to under a millimetre.
_SECOND_PARTS = 100_000
_MILLIMETRES, _CENTIDEGREES = 1000, 10_000


def gps_directory(
    lat_lon_h: tuple[float, float, float],
    reference: Literal["sea_level", "ellipsoid"] = "sea_level",
    *,
    heading_deg: float | None = None,
    error_m: float | None = None,
) -> dict[int, object]:
    """The GPS directory of a position: WGS84 degrees, degrees, metres.

    Args:
        reference: what the altitude is said to be counted from; it is written as is.
        heading_deg: of the optical axis, clockwise from true north.
        error_m: radius that holds 68 % of the horizontal error.
    """
    latitude, longitude, height = lat_lon_h
    gps = ExifTags.GPS
    ellipsoid = reference == "ellipsoid"  # known to EXIF since 3.0, whose GPS directory is of version 2.4
    more: dict[int, object] = {}
    if heading_deg is not None:
        parts = round(heading_deg * _CENTIDEGREES) % (360 * _CENTIDEGREES)
        more[gps.GPSImgDirectionRef.value] = "T"
        more[gps.GPSImgDirection.value] = IFDRational(parts, _CENTIDEGREES)
    if error_m is not None:
        more[gps.GPSHPositioningError.value] = rational(error_m, _MILLIMETRES)
    return more | {
        gps.GPSVersionID.value: b"\x02\x04\x00\x00" if ellipsoid else b"\x02\x03\x00\x00",
        gps.GPSLatitudeRef.value: "N" if latitude >= 0 else "S",
        gps.GPSLatitude.value: _degrees(latitude),
        gps.GPSLongitudeRef.value: "E" if longitude >= 0 else "W",
        gps.GPSLongitude.value: _degrees(longitude),
        gps.GPSAltitudeRef.value: bytes([2 * ellipsoid + (height < 0)]),
        gps.GPSAltitude.value: rational(abs(height), _MILLIMETRES),
        gps.GPSMapDatum.value: "WGS-84",
    }


def _degrees(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    parts = round(abs(value) * 3600 * _SECOND_PARTS)
    minutes, seconds = divmod(parts, 60 * _SECOND_PARTS)
    degrees, minutes = divmod(minutes, 60)
    return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(seconds, _SECOND_PARTS)


def rational(value: float, denominator: int) -> IFDRational:
    """A number as a fraction."""
    return IFDRational(Fraction(round(value * denominator), denominator))
