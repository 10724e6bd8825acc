"""What a photo says about itself: EXIF and the XMP that DJI's drones add. EXIF 3.0 (CIPA DC-008-2023).

Nothing here raises on bad metadata: a wrong value becomes None, with a line in `ExifInfo.warnings`.
"""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.exif.angles import XMP_BODY, XMP_GIMBALS, camera_angles
from featuredb.features.exif.gps import (
    DEFAULT_SIGMA_HORIZONTAL_M,
    DEFAULT_SIGMA_VERTICAL_M,
    finer_position,
    gps_altitude,
    gps_position,
    gps_sigmas,
)
from featuredb.features.exif.tiff_ifd import Ifd, TiffReader
from featuredb.features.image_header import read_header
from featuredb.features.stored_image import ImageHeader
from featuredb.geometry.camera_angles import CameraAngles

# Diagonal of the 24 x 36 mm frame to which "35 mm equivalent" refers (CIPA DCG-001).
FULL_FRAME_DIAGONAL_MM = 43.2666
# Wider than this a photo is a crop in height of its sensor, whose own shape is 4:3 (phones, drones) or
# 3:2; the equivalent focal length is that of the sensor. 4:3 is assumed; were it 3:2, 4 % would be lost.
_CROPPED_ASPECT = 1.6
# From a circular fisheye to a long telephoto lens, in units of the longer side.
_FOCAL_RANGE = (0.1, 40.0)
_MAX_TEXT = 200
_MAX_WARNINGS = 20

_XMP_NAMES = (  # of numbers, by an expression for their namespace
    *XMP_GIMBALS.items(),
    (
        "drone(?:-dji)?",
        (
            *("RtkFlag", "RtkStdLat", "RtkStdLon", "RtkStdHgt"),
            *("GpsLatitude", "GpsLongitude", "GpsLongtitude"),
        ),
    ),
    (
        "[Cc]amera",  # Pix4D's
        (
            *XMP_BODY,
            *("GPSXYAccuracy", "GPSZAccuracy", "IMUYawAccuracy", "IMUPitchAccuracy", "IMURollAccuracy"),
        ),
    ),
)
_XMP_TAGS = "|".join(f"{space}:(?:{'|'.join(names)})" for space, names in _XMP_NAMES)
_XMP_VALUE = re.compile(
    rf"({_XMP_TAGS})\s*(?:=\s*[\"']|>)\s*([+-]?\d{{1,9}}(?:\.\d{{0,12}})?)\s*[\"'<]".encode()
)

# How the lenses of films are named that do not say their camera: by the film's bytes, and the shot.
UNNAMED_MAKE = "film"
_SHOT = "shot"
_FOCAL_IN_KEY = re.compile(r".*\|\d+x\d+\|f(\d+)(\||$)")
_SOFTWARE = "featuredb"  # of EXIF, in pictures of films


def unnamed_model(sha256: str) -> str:
    """The camera's model of a film that does not say it; no two films have the same."""
    return sha256[:16]


def shot_model(model: str, shot: int) -> str:
    """The camera's model of a shot, counted from 0: who cuts a film may have had several cameras."""
    return model if shot == 0 else f"{model} {_SHOT} {shot + 1}"


def is_of_film(camera_key: str, film: str) -> bool:
    """Whether an `ExifInfo.camera_key` is of some shot of a film's model."""
    start = f"{UNNAMED_MAKE}|{film}".lower()
    return camera_key.startswith((f"{start}|", f"{start} {_SHOT} "))


def focal_of_key(camera_key: str) -> float | None:
    """Focal length in pixels that an `ExifInfo.camera_key` names, three digits of it; None for none."""
    named = _FOCAL_IN_KEY.match(camera_key)
    return None if named is None else float(named[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class ExifInfo:
    """Metadata of one photo; None or "" where absent or wrong.

    Attributes:
        width, height: size of the stored image, pixels.
        make, model, serial: camera maker, model, body serial number.
        orientation: EXIF orientation 1..8.
        resaved: a program has saved the photo anew (`ImageHeader.jfif`), perhaps turned by 180 degrees.
        focal_px: focal length in pixels of the image as stored.
        capture_time: when taken; timezone-aware only where the photo gives its offset.
        latitude_deg, longitude_deg: WGS84 degrees, both or none.
        altitude_m: metres above the sea or the ellipsoid, as the photo says; for drones often neither.
        sigma_horizontal_m, sigma_vertical_m: one standard deviation per axis of the position.
        angles: how the camera was turned.
        artist, copyright: attribution.
        warnings: what was wrong, for people.
    """

    width: int = 0
    height: int = 0
    make: str = ""
    model: str = ""
    serial: str = ""
    orientation: int = 1
    resaved: bool = False
    focal_px: float | None = None
    capture_time: datetime | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    sigma_horizontal_m: float = DEFAULT_SIGMA_HORIZONTAL_M
    sigma_vertical_m: float = DEFAULT_SIGMA_VERTICAL_M
    angles: CameraAngles | None = None
    artist: str = ""
    copyright: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def camera_key(self) -> str:
        """Name of the intrinsics that a photo shares with others of the same camera; "" for an unknown one.

        The focal length counts to three digits, so that zoom positions differ and rounding does not. Photos
        that a program has saved anew are a camera of their own: pictures turned by 180 degrees have their
        principal point on the other side, and nothing else in the file tells it.
        """
        make, model, serial = self.make.strip(), self.model.strip(), self.serial.strip()
        if not (make or model):
            return ""
        focal = "unknown"
        if self.focal_px:
            digits = float(f"{self.focal_px:.3g}")
            focal = f"f{digits:.0f}"
        parts = [make, model, f"{self.width}x{self.height}", focal, *([serial] if serial else [])]
        return "|".join([*parts, "jfif"] if self.resaved else parts).lower()


def read_exif(data: bytes, header: ImageHeader | None = None) -> ExifInfo:
    """Metadata of the image file in `data`.

    Args:
        data: the whole file.
        header: of `probe`, where the caller has it already.
    """
    if header is None:
        try:
            header = read_header(data)
        except ImageError as error:
            return ExifInfo(warnings=(f"no metadata: {error}",))
    tiff = data[slice(*header.exif)] if header.exif else b""
    xmp = data[slice(*header.xmp)] if header.xmp else b""
    return parse_exif(
        tiff, xmp, header.width, header.height, orientation=header.orientation, jfif=header.jfif
    )


def parse_exif(
    tiff: bytes, xmp: bytes, width: int, height: int, *, orientation: int | None = None, jfif: bool = False
) -> ExifInfo:
    """Metadata from the TIFF stream of EXIF and the XMP packet (either may be empty).

    Args:
        tiff: from the byte order mark on, without the prefix "Exif".
        xmp: XML text.
        width, height: of the stored image, pixels; the focal length is given for these.
        orientation: said by the format, which EXIF then only repeats.
        jfif: see `ImageHeader`; pictures of films that featuredb saved have it, too, and are unturned.
    """
    main, exif, gps, warnings = _directories(tiff)
    values = {m[1].decode().split(":")[1]: float(m[2]) for m in _XMP_VALUE.finditer(xmp)}
    position = finer_position(gps_position(gps, warnings), values)
    orientation = orientation or _orientation(main, warnings)
    sigma_h, sigma_v = gps_sigmas(gps, values, warnings)
    return ExifInfo(
        width=width,
        height=height,
        make=main.text(271)[:_MAX_TEXT],
        model=main.text(272)[:_MAX_TEXT],
        serial=exif.text(42033)[:_MAX_TEXT],
        orientation=orientation,
        resaved=jfif and main.text(305) != _SOFTWARE,
        focal_px=_focal_px(exif, width, height, warnings),
        capture_time=_capture_time(main, exif, warnings),
        latitude_deg=position[0] if position else None,
        longitude_deg=position[1] if position else None,
        altitude_m=gps_altitude(gps, warnings) if position else None,
        sigma_horizontal_m=sigma_h,
        sigma_vertical_m=sigma_v,
        angles=camera_angles(gps, values, main.text(271), orientation, warnings),
        artist=main.text(315)[:_MAX_TEXT],
        copyright=main.text(33432)[:_MAX_TEXT],
        warnings=tuple(warnings[:_MAX_WARNINGS]),
    )


def _directories(tiff: bytes) -> tuple[Ifd, Ifd, Ifd, list[str]]:
    """The main, EXIF and GPS directories. Only these three are read, so there are no cycles to follow."""
    warnings: list[str] = []
    empty = Ifd()
    if not tiff:
        return empty, empty, empty, warnings
    try:
        reader = TiffReader(tiff)
    except InvalidValueError as error:
        return empty, empty, empty, [f"EXIF: {error}"]
    main = reader.read(reader.first_offset)
    found = [main]
    for pointer in (34665, 34853):
        found.append(reader.read(main.number(pointer)) if pointer in main.values else empty)
    for name, ifd in zip(("EXIF main", "EXIF", "EXIF GPS"), found, strict=True):
        warnings += [f"{name}: {warning}" for warning in ifd.warnings]
    return found[0], found[1], found[2], warnings


def _orientation(main: Ifd, warnings: list[str]) -> int:
    value = main.number(274)
    if value is None or value in (1, 2, 3, 4, 5, 6, 7, 8):
        return int(value or 1)
    if value != 0:  # 0 is a common way to say nothing
        warnings.append(f"EXIF: orientation {value} is not in 1..8")
    return 1


def _positive(ifd: Ifd, tag: int) -> float | None:
    value = ifd.number(tag)
    return value if value is not None and math.isfinite(value) and value > 0 else None


def _focal_px(exif: Ifd, width: int, height: int, warnings: list[str]) -> float | None:
    """Focal length in stored pixels: by the sensor's resolution, else by the 35 mm equivalent.

    The first is exact where cameras write it (Canon, Nikon, Sony), the second is rounded to whole
    millimetres. Where both are there and disagree by a quarter, the first was spoilt by some program.
    """
    frame = _original_frame(exif, width, height, warnings)
    if frame is None:
        return None
    full_width, full_height, scale = frame
    by_sensor = _focal_by_sensor(exif, full_width, warnings)
    equivalent_mm = _positive(exif, 41989)
    by_equivalent = None
    if equivalent_mm is not None:
        longer, shorter = max(full_width, full_height), min(full_width, full_height)
        diagonal = 1.25 * longer if longer / shorter > _CROPPED_ASPECT else math.hypot(longer, shorter)
        by_equivalent = equivalent_mm / FULL_FRAME_DIAGONAL_MM * diagonal
    focal = by_sensor or by_equivalent
    if by_sensor and by_equivalent and not 0.8 < by_sensor / by_equivalent < 1.25:
        warnings.append(
            f"EXIF: focal length by sensor resolution ({by_sensor:.0f} px) and by 35 mm equivalent "
            f"({by_equivalent:.0f} px) disagree; the second is taken"
        )
        focal = by_equivalent
    if focal is None:
        return None
    low, high = (limit * max(full_width, full_height) for limit in _FOCAL_RANGE)
    if not low <= focal <= high:
        warnings.append(f"EXIF: a focal length of {focal:.0f} px for {width}x{height} is absurd")
        return None
    return focal * scale


def _original_frame(
    exif: Ifd, width: int, height: int, warnings: list[str]
) -> tuple[float, float, float] | None:
    """Width and height when the photo was taken, and the scale from then to the stored pixels."""
    if width <= 0 or height <= 0:
        return None
    full_width, full_height = _positive(exif, 40962), _positive(exif, 40963)
    if not full_width or not full_height or full_width > 1e6 or full_height > 1e6:
        return width, height, 1.0
    if (full_width > full_height) != (width > height):  # turned without telling EXIF
        full_width, full_height = full_height, full_width
    sx, sy = width / full_width, height / full_height
    if abs(sx / sy - 1.0) < 0.02:  # a change of shape below rounding to whole pixels of small copies
        return full_width, full_height, (sx + sy) / 2
    if sx == 1.0 or sy == 1.0:  # cropped along one side, at full resolution
        return full_width, full_height, 1.0
    warnings.append(
        f"EXIF: the photo was taken with {full_width:.0f}x{full_height:.0f} pixels and is stored with "
        f"{width}x{height}: cropped and scaled, so that its focal length is unknown"
    )
    return None


def _focal_by_sensor(exif: Ifd, full_width: float, warnings: list[str]) -> float | None:
    focal_mm, resolution = _positive(exif, 37386), _positive(exif, 41486)
    zoom = _positive(exif, 41988)
    # Units: 2 inch, 3 cm; 4 mm and 5 micrometre are older cameras' own.
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(int(_positive(exif, 41488) or 2))
    if not focal_mm or not resolution or not unit_mm or (zoom and zoom > 1.01):
        return None
    pixels_per_mm = resolution / unit_mm
    sensor_mm = full_width / pixels_per_mm
    if not 2.0 < sensor_mm < 70.0:  # phones from 3 mm, medium format 54 mm
        warnings.append(f"EXIF: a sensor {sensor_mm:.3g} mm wide is absurd, its resolution is not used")
        return None
    return focal_mm * pixels_per_mm


def _capture_time(main: Ifd, exif: Ifd, warnings: list[str]) -> datetime | None:
    """The first readable of original, digitised and file time, with fraction and offset."""
    for ifd, tag, fraction_tag, offset_tag in (
        (exif, 36867, 37521, 36881),
        (exif, 36868, 37522, 36882),
        (main, 306, 37520, 36880),
    ):
        text = ifd.text(tag)
        if not text or not text.strip(" :0"):
            continue
        try:
            time = datetime.strptime(text[:19], "%Y:%m:%d %H:%M:%S")
        except ValueError:
            warnings.append(f"EXIF: {text[:30]!r} is not a time")
            continue
        fraction = re.fullmatch(r"\d{1,9}", exif.text(fraction_tag))
        if fraction:
            time += timedelta(seconds=float("0." + fraction[0]))
        return _with_offset(time, exif.text(offset_tag), warnings)
    return None


def _with_offset(time: datetime, text: str, warnings: list[str]) -> datetime:
    if not text:
        return time
    match = re.fullmatch(r"([+-])(\d\d):(\d\d)", text)
    minutes = int(match[2]) * 60 + int(match[3]) if match else 0
    if text == "Z":
        return time.replace(tzinfo=UTC)
    if not match or minutes > 14 * 60:
        warnings.append(f"EXIF: {text[:20]!r} is not an offset from UTC")
        return time
    return time.replace(tzinfo=timezone(timedelta(minutes=-minutes if match[1] == "-" else minutes)))
