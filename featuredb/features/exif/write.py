"""EXIF's way of writing positions and numbers, for photos that are written here."""

from fractions import Fraction

from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational

# Denominator of arc seconds: 1e-5" is 0.3 mm on the ground, so a truth prior is exact to under a millimetre.
_SECOND_PARTS = 100_000
_MILLIMETRES = 1000


def gps_directory(lat_lon_h: tuple[float, float, float]) -> dict[int, object]:
    """The GPS directory of a position: WGS84 degrees, degrees, metres.

    The altitude is written with reference 0 or 1 (sea level) as is, whatever it is counted from.
    """
    latitude, longitude, height = lat_lon_h
    gps = ExifTags.GPS
    return {
        gps.GPSVersionID.value: b"\x02\x03\x00\x00",
        gps.GPSLatitudeRef.value: "N" if latitude >= 0 else "S",
        gps.GPSLatitude.value: _degrees(latitude),
        gps.GPSLongitudeRef.value: "E" if longitude >= 0 else "W",
        gps.GPSLongitude.value: _degrees(longitude),
        gps.GPSAltitudeRef.value: b"\x00" if height >= 0 else b"\x01",
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
