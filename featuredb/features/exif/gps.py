"""Where a photo's satellite receiver says it was, from EXIF's GPS directory (EXIF 3.0, 4.6.6)."""

import math

from featuredb.features.exif.tiff_ifd import Ifd

# Consumer GNSS without better knowledge. The GPS standard positioning service promises 95 % within 8 m
# horizontally and 13 m vertically (GPS SPS PS, 5th edition, 2020), that is 3.3 m and 6.6 m as one standard
# deviation per axis; rounded up for multipath, and vertically for the barometer that drones mix in.
DEFAULT_SIGMA_HORIZONTAL_M = 4.0
DEFAULT_SIGMA_VERTICAL_M = 10.0
# User equivalent range error by which a dilution of precision becomes metres, single frequency.
RANGE_ERROR_M = 3.0
# Radius of 68 % of a circular normal distribution, in units of the deviation of one axis.
RADIUS_68 = math.sqrt(-2.0 * math.log(1.0 - 0.68))
_SIGMA_RANGE_M = (0.005, 1000.0)
_SAME_DEG = 2e-5  # 2 m: EXIF's whole tenths of seconds
_DJI_RTK_FLOAT_OR_FIXED = (34.0, 50.0)


def gps_position(gps: Ifd, warnings: list[str]) -> tuple[float, float] | None:
    """Latitude and longitude in degrees, or None where either is missing or wrong."""
    if 2 not in gps.values and 4 not in gps.values:
        return None
    if gps.text(9).upper() == "V":
        warnings.append("EXIF GPS: the receiver says that it had no fix; position not used")
        return None
    latitude = _angle(gps, 2, 1, "NS", 90.0, warnings)
    longitude = _angle(gps, 4, 3, "EW", 180.0, warnings)
    if latitude is None or longitude is None:
        return None
    if abs(latitude) < 1e-6 and abs(longitude) < 1e-6:
        warnings.append("EXIF GPS: position 0, 0 is a receiver without a fix; not used")
        return None
    return latitude, longitude


def finer_position(position: tuple[float, float] | None, xmp: dict[str, float]) -> tuple[float, float] | None:
    """The position of DJI's XMP where it is EXIF's own: EXIF's seconds may have two decimals, 0.3 m."""
    latitude = xmp.get("GpsLatitude")
    longitude = xmp.get("GpsLongitude", xmp.get("GpsLongtitude"))  # so some firmware spells it
    if position is None or latitude is None or longitude is None:
        return position
    same = abs(latitude - position[0]) < _SAME_DEG and abs(longitude - position[1]) < _SAME_DEG
    return (latitude, longitude) if same else position


def _angle(gps: Ifd, tag: int, ref_tag: int, signs: str, limit: float, warnings: list[str]) -> float | None:
    name = "latitude" if signs == "NS" else "longitude"
    parts, ref = gps.numbers(tag), gps.text(ref_tag).upper()[:1]
    if not parts or not ref or ref not in signs:
        warnings.append(f"EXIF GPS: {name} {parts} with reference {ref!r} is incomplete")
        return None
    degrees, minutes, seconds = (*parts[:3], 0.0, 0.0)[:3]
    angle = degrees + minutes / 60 + seconds / 3600
    # Seconds or minutes of exactly 60 come from rounding.
    if not (degrees >= 0 and 0 <= minutes <= 60 and 0 <= seconds <= 60 and angle <= limit):
        warnings.append(f"EXIF GPS: {name} {parts[:3]} is not an angle up to {limit:.0f} degrees")
        return None
    return -angle if ref == signs[1] else angle


def gps_altitude(gps: Ifd, warnings: list[str]) -> float | None:
    """Altitude in metres with its sign; what it is counted from, drones and phones tell wrongly."""
    value = gps.number(6)
    if value is None:
        return None
    # The deepest shore is the Dead Sea's, airliners fly at 13 km.
    if not -500.0 < value < 20_000.0:
        warnings.append(f"EXIF GPS: altitude {value} m is absurd")
        return None
    raw = gps.values.get(5)
    code = (raw[0] if raw else None) if isinstance(raw, (tuple, bytes)) else None
    if code not in (None, 0, 1, 2, 3):
        warnings.append(f"EXIF GPS: altitude reference {code} is not in 0..3")
    return -abs(value) if code in (1, 3) else value


def gps_sigmas(gps: Ifd, xmp: dict[str, float], warnings: list[str]) -> tuple[float, float]:
    """Deviations of the position (horizontal per axis, vertical) in metres."""
    low, high = _SIGMA_RANGE_M
    std = [xmp.get(name, 0.0) for name in ("RtkStdLat", "RtkStdLon", "RtkStdHgt")]
    if xmp.get("RtkFlag") in _DJI_RTK_FLOAT_OR_FIXED and min(std) > 0:
        return min(max(std[0], std[1], low), high), min(max(std[2], low), high)
    ratio = DEFAULT_SIGMA_VERTICAL_M / DEFAULT_SIGMA_HORIZONTAL_M
    stated = xmp.get("GPSXYAccuracy", 0.0)
    if stated > 0:
        vertical = xmp.get("GPSZAccuracy", 0.0) or ratio * stated
        if max(stated, vertical) <= high:
            return max(stated, low), max(vertical, low)
        warnings.append(f"XMP: an accuracy of {stated}, {vertical} is absurd")
    for tag, factor, source in ((31, 1 / RADIUS_68, "positioning_error"), (11, RANGE_ERROR_M, "dop")):
        value = gps.number(tag)
        if value is None or value == 0:
            continue
        sigma = value * factor
        if low <= sigma <= high:
            return sigma, ratio * sigma
        warnings.append(f"EXIF GPS: {source} {value} is absurd")
    return DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
