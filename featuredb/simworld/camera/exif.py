"""EXIF as cameras write it."""

from PIL import ExifTags, Image

from featuredb.features.exif.write import gps_directory, rational
from featuredb.simworld.camera.shot import Shot


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
    details[base.FocalLength.value] = rational(shot.device.focal_mm, 100)
    details[base.FocalLengthIn35mmFilm.value] = shot.device.focal_35mm
    details[base.ExifImageWidth.value] = shot.device.camera.width
    details[base.ExifImageHeight.value] = shot.device.camera.height
    if lat_lon_h is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps_directory(lat_lon_h))
    return exif
