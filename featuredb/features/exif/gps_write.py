"""A GPS directory put into an existing EXIF block without moving anything else in it.

Makers' notes hold offsets from the start of the block, which nobody else knows to be offsets. So the new
directory goes behind everything, and only the pointer to it changes. TIFF 6.0, section 2; EXIF 3.0, section
4.6.6.
"""

import math
import struct
from dataclasses import dataclass
from typing import Literal

from featuredb.features.exif.tiff_ifd import TiffReader

_GPS_POINTER = 0x8825
_LONG = 4
_KEPT = frozenset(
    {7, 29}
)  # time and day of the fix; the rest tells of a receiver that the position is not from
_SECOND_PARTS = 1_000_000  # of an arc second: 0.03 mm on the ground
_MILLIMETRES, _CENTIDEGREES = 1000, 10_000
_VERSION = b"\x02\x04\x00\x00"  # EXIF 3.0, which counts altitudes from the ellipsoid, too


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsFields:
    """What is written.

    Attributes:
        latitude_deg, longitude_deg: WGS84.
        altitude_m: above `reference`.
        heading_deg: of the optical axis, clockwise from true north, [0, 360).
        error_m: radius that holds 68 % of the horizontal error.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    reference: Literal["sea_level", "ellipsoid"]
    heading_deg: float
    error_m: float


def with_gps(tiff: bytes, fields: GpsFields) -> bytes:
    """The EXIF block with this position; b"" makes a new block.

    Raises:
        InvalidValueError: `tiff` is no TIFF stream.
    """
    if not tiff:
        tiff = b"II*\0" + struct.pack("<IHI", 8, 0, 0)  # an empty first directory
    reader = TiffReader(tiff)
    order = reader.order
    out = bytearray(tiff + b"\0" * (len(tiff) % 2))
    entries = _raw_entries(tiff, reader.first_offset, order)
    pointer = next((k for k, entry in enumerate(entries) if _tag(entry, order) == _GPS_POINTER), None)
    old = (
        _raw_entries(tiff, struct.unpack(order + "I", entries[pointer][8:])[0], order)
        if pointer is not None
        else []
    )
    kept = [entry for entry in old if _tag(entry, order) in _KEPT]
    gps_at = len(out)
    out += _directory(kept, _gps_values(fields, order), gps_at, order)
    if pointer is not None:
        at = reader.first_offset + 2 + 12 * pointer
        out[at : at + 12] = struct.pack(order + "HHII", _GPS_POINTER, _LONG, 1, gps_at)
        return bytes(out)
    # No place for the pointer: a copy of the first directory with it, at the end; values stay where they are.
    entries.append(struct.pack(order + "HHII", _GPS_POINTER, _LONG, 1, gps_at))
    entries.sort(key=lambda entry: _tag(entry, order))
    after = reader.first_offset + 2 + 12 * (len(entries) - 1)
    following = tiff[after : after + 4].ljust(4, b"\0")
    struct.pack_into(order + "I", out, 4, len(out))
    out += struct.pack(order + "H", len(entries)) + b"".join(entries) + following
    return bytes(out)


def _raw_entries(tiff: bytes, offset: int, order: str) -> list[bytes]:
    """The entries of 12 bytes of a directory; none where it lies outside."""
    if not 8 <= offset <= len(tiff) - 2:
        return []
    (count,) = struct.unpack_from(order + "H", tiff, offset)
    count = min(count, (len(tiff) - offset - 2) // 12)
    return [tiff[offset + 2 + 12 * k : offset + 14 + 12 * k] for k in range(count)]


def _tag(entry: bytes, order: str) -> int:
    return int(struct.unpack_from(order + "H", entry)[0])


def _directory(kept: list[bytes], values: dict[int, tuple[int, int, bytes]], at: int, order: str) -> bytes:
    """A directory at offset `at` with entries as they are, and values of (type, count, bytes) by tag."""
    count = len(kept) + len(values)
    data_at = at + 2 + 12 * count + 4
    entries, data = list(kept), b""
    for tag, (kind, number, value) in values.items():
        if len(value) <= 4:
            field = value.ljust(4, b"\0")
        else:
            field = struct.pack(order + "I", data_at + len(data))
            data += value + b"\0" * (len(value) % 2)
        entries.append(struct.pack(order + "HHI", tag, kind, number) + field)
    entries.sort(key=lambda entry: _tag(entry, order))
    return struct.pack(order + "H", count) + b"".join(entries) + b"\0\0\0\0" + data


def _gps_values(fields: GpsFields, order: str) -> dict[int, tuple[int, int, bytes]]:
    """(type, count, bytes) by tag: 1 byte, 2 text, 5 rational."""

    def rational(value: float, parts: int) -> bytes:
        shared = math.gcd(round(value * parts), parts)
        return struct.pack(order + "II", round(value * parts) // shared, parts // shared)

    def angle(degrees: float) -> bytes:
        parts = round(abs(degrees) * 3600 * _SECOND_PARTS)
        minutes, seconds = divmod(parts, 60 * _SECOND_PARTS)
        whole, minutes = divmod(minutes, 60)
        return struct.pack(order + "IIIIII", whole, 1, minutes, 1, seconds, _SECOND_PARTS)

    below = fields.altitude_m < 0
    reference = (2 if fields.reference == "ellipsoid" else 0) + below
    heading = round(fields.heading_deg * _CENTIDEGREES) % (360 * _CENTIDEGREES) / _CENTIDEGREES
    return {
        0: (1, 4, _VERSION),
        1: (2, 2, b"S\0" if fields.latitude_deg < 0 else b"N\0"),
        2: (5, 3, angle(fields.latitude_deg)),
        3: (2, 2, b"W\0" if fields.longitude_deg < 0 else b"E\0"),
        4: (5, 3, angle(fields.longitude_deg)),
        5: (1, 1, bytes([reference])),
        6: (5, 1, rational(abs(fields.altitude_m), _MILLIMETRES)),
        16: (2, 2, b"T\0"),
        17: (5, 1, rational(heading, _CENTIDEGREES)),
        18: (2, 7, b"WGS-84\0"),
        31: (5, 1, rational(fields.error_m, _MILLIMETRES)),
    }
