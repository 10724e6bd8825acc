"""EXIF as cameras write it."""

from fractions import Fraction

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from featuredb.simworld.shot import Shot

# Denominator of arc seconds: 1e-5" is 0.3 mm on the ground, so a truth prior is exact to under a millimetre.
_SECOND_PARTS = 100_000
_MILLIMETRES = 1000


def exif_of(shot: Shot, lat_lon_h: tuple[float, float, float] | None) -> Image.Exif:
    """The EXIF block of a shot; GPS only where `lat_lon_h` (degrees, degrees, metres) is given.

    The altitude is written with reference 0 or 1 as is; this world's receivers count from the ellipsoid.
    """
    exif = Image.Exif()
    base, time = ExifTags.Base, shot.time
    stamp = time.strftime("%Y:%m:%d %H:%M:%S")
    offset = time.strftime("%z")
    exif[base.Make.value], exif[base.Model.value] = shot.device.make, shot.device.model
    exif[base.Orientation.value] = 1
    exif[base.Software.value] = "featuredb simworld"
    exif[base.DateTime.value] = stamp
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[base.DateTimeOriginal.value] = stamp
    details[base.OffsetTimeOriginal.value] = f"{offset[:3]}:{offset[3:]}"
    details[base.SubsecTimeOriginal.value] = f"{time.microsecond // 1000:03d}"
    details[base.FocalLength.value] = _rational(shot.device.focal_mm, 100)
    details[base.FocalLengthIn35mmFilm.value] = shot.device.focal_35mm
    details[base.ExifImageWidth.value] = shot.device.camera.width
    details[base.ExifImageHeight.value] = shot.device.camera.height
    if lat_lon_h is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(_gps(lat_lon_h))
    return exif


def _gps(lat_lon_h: tuple[float, float, float]) -> dict[int, object]:
    latitude, longitude, height = lat_lon_h
    gps = ExifTags.GPS
    return {
        gps.GPSVersionID.value: b"\x02\x03\x00\x00",
        gps.GPSLatitudeRef.value: "N" if latitude >= 0 else "S",
        gps.GPSLatitude.value: _degrees(latitude),
        gps.GPSLongitudeRef.value: "E" if longitude >= 0 else "W",
        gps.GPSLongitude.value: _degrees(longitude),
        gps.GPSAltitudeRef.value: b"\x00" if height >= 0 else b"\x01",
        gps.GPSAltitude.value: _rational(abs(height), _MILLIMETRES),
        gps.GPSMapDatum.value: "WGS-84",
    }


def _degrees(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    parts = round(abs(value) * 3600 * _SECOND_PARTS)
    minutes, seconds = divmod(parts, 60 * _SECOND_PARTS)
    degrees, minutes = divmod(minutes, 60)
    return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(seconds, _SECOND_PARTS)


def _rational(value: float, denominator: int) -> IFDRational:
    return IFDRational(Fraction(round(value * denominator), denominator))
