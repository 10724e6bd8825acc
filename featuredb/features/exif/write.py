"""Metadata of photos that are written here: positions in EXIF, properties in XMP, the segments for both."""

import re
import struct
from collections.abc import Mapping
from fractions import Fraction
from typing import Literal
from xml.sax.saxutils import escape

from PIL import ExifTags
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from featuredb.errors import InvalidValueError
from featuredb.features.exif.tiff_ifd import TiffReader
from featuredb.features.image_header import read_header

# Denominator of arc seconds: 1e-5" is 0.3 mm on the ground, so a truth prior is exact to under a millimetre.
_SECOND_PARTS = 100_000
_MILLIMETRES, _CENTIDEGREES = 1000, 10_000
_GPS_POINTER = ExifTags.IFD.GPSInfo.value
_LONG = 4
_MICROSECONDS = 1_000_000
NAMESPACES = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
    "featuredb": "urn:featuredb:photo:1.0",
}
_END = b"</rdf:RDF>"
_EMPTY = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
    '</rdf:RDF></x:xmpmeta>\n<?xpacket end="w"?>'
).encode()
EXIF_PREFIX = b"Exif\0\0"
XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
_APP0, _APP1, _SOS = 0xE0, 0xE1, 0xDA
_LONGEST = 0xFFFF - 2  # a segment's length has 16 bits and counts itself


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


def with_properties(xmp: bytes, properties: Mapping[str, str], stale: tuple[str, ...] = ()) -> bytes:
    """The packet with these simple properties in a description of their own.

    Properties of the same names are taken out first, whether they are attributes or elements, and so are
    those that are `stale`. What cannot be recognised as a packet is replaced as a whole.

    Args:
        xmp: the packet; b"" where there is none.
        properties: by names with their prefixes, such as "drone-dji:GimbalYawDegree"; see NAMESPACES.
    """
    packet = xmp if _END in xmp else _EMPTY
    for name in (*properties, *stale):
        packet = _without(packet, name.encode())
    prefixes = sorted({name.split(":")[0] for name in properties})
    spaces = "".join(f'\n  xmlns:{prefix}="{NAMESPACES[prefix]}"' for prefix in prefixes)
    clean = {name: "".join(c for c in value if c >= " ") for name, value in properties.items()}
    values = "".join(f'\n  {name}="{escape(text, {chr(34): "&quot;"})}"' for name, text in clean.items())
    mine = f'<rdf:Description rdf:about=""{spaces}{values}/>\n'.encode()
    head, end, tail = packet.rpartition(_END)
    return head + mine + end + tail


def _without(packet: bytes, name: bytes) -> bytes:
    name = re.escape(name)
    # One blank, not a run of them: packets are padded by kilobytes of blanks, and a search for a run would
    # begin anew at each of them.
    packet = re.sub(rb"\s" + name + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", b"", packet)
    return re.sub(rb"<" + name + rb"(\s[^<>]*)?(/>|>[^<]*</" + name + rb"\s*>)\s*", b"", packet)


def with_app1(data: bytes, exif: bytes, xmp: bytes) -> bytes:
    """The file with this EXIF (a TIFF stream) and this XMP packet in the place of its own.

    They come first, behind a JFIF header if there is one. All other segments, the scans, and what cameras
    append behind the picture stay as they are, bit for bit.

    Raises:
        ImageError: not a JPEG that can be read.
        InvalidValueError: another format, or EXIF or XMP that is longer than a segment can be.
    """
    header = read_header(data)
    if header.format != "JPEG":
        raise InvalidValueError(f"expected a JPEG file, found {header.format}")
    kept: list[bytes] = []
    first: list[bytes] = []
    at = 2
    while True:
        start = at
        while data[at + 1] == 0xFF:  # fill bytes before a marker
            at += 1
        marker = data[at + 1]
        if marker == _SOS:
            break
        stop = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        body = data[at + 4 : at + 4 + len(XMP_PREFIX)]
        if marker == _APP0 and body.startswith(b"JFIF\0") and not kept:
            first.append(data[start:stop])
        elif not (marker == _APP1 and (body.startswith(EXIF_PREFIX) or body == XMP_PREFIX)):
            kept.append(data[start:stop])
        at = stop
    mine = [_app1("EXIF", EXIF_PREFIX + exif), _app1("XMP", XMP_PREFIX + xmp)]
    return b"".join([data[:2], *first, *mine, *kept, data[start:]])


def _app1(name: str, body: bytes) -> bytes:
    if len(body) > _LONGEST:
        raise InvalidValueError(f"{name} of {len(body)} bytes does not fit into a segment of {_LONGEST}")
    return bytes([0xFF, _APP1]) + (len(body) + 2).to_bytes(2, "big") + body
