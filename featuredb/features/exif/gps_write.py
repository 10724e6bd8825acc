"""A GPS directory put into an existing EXIF block without moving anything else in it.

Makers' notes hold offsets from the start of the block, which nobody else knows to be offsets. So the new
directory goes behind everything, and only the pointer to it changes. TIFF 6.0, section 2; EXIF 3.0, section
4.6.6.
"""

import struct
from collections.abc import Mapping
from fractions import Fraction

from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from featuredb.features.exif.tiff_ifd import TiffReader

_GPS_POINTER = ExifTags.IFD.GPSInfo.value
_LONG = 4
_MICROSECONDS = 1_000_000


def with_gps(tiff: bytes, gps: Mapping[int, object]) -> bytes:
    """The EXIF block with this position; b"" makes a new block.

    Of the old directory the time and day of the fix are kept; the rest tells of a receiver that the position
    is not from.

    Args:
        gps: see `featuredb.features.exif.write.gps_directory`.

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
    kept: dict[int, object] = {}
    if pointer is not None:
        old = reader.read(struct.unpack(order + "I", entries[pointer][8:])[0])
        clock, day = old.numbers(ExifTags.GPS.GPSTimeStamp), old.text(ExifTags.GPS.GPSDateStamp)
        if clock is not None and all(0.0 <= part < _MICROSECONDS for part in clock):
            kept[ExifTags.GPS.GPSTimeStamp] = tuple(
                IFDRational(Fraction(part).limit_denominator(_MICROSECONDS)) for part in clock
            )
        if day:
            kept[ExifTags.GPS.GPSDateStamp] = day
    gps_at = len(out)
    directory = ImageFileDirectory_v2(ifh=tiff[:4] + b"\0" * 4, group=_GPS_POINTER)
    directory.update({**kept, **gps})
    out += directory.tobytes(gps_at)
    if pointer is not None:
        at = reader.first_offset + 2 + 12 * pointer
        out[at : at + 12] = struct.pack(order + "HHII", _GPS_POINTER, _LONG, 1, gps_at)
        return bytes(out)
    # No place for the pointer: a copy of the first directory with it, at the end; values stay where they are.
    entries.append(struct.pack(order + "HHII", _GPS_POINTER, _LONG, 1, gps_at))
    entries.sort(key=lambda entry: _tag(entry, order))
    after = reader.first_offset + 2 + 12 * (len(entries) - 1)
    following = tiff[after : after + 4].ljust(4, b"\0")
    out += b"\0" * (len(out) % 2)
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
