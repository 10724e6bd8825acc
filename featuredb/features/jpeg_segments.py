"""Metadata of a JPEG file exchanged byte by byte: the compressed picture is not touched."""

from featuredb.errors import InvalidValueError
from featuredb.features.image_header import read_header

EXIF_PREFIX = b"Exif\0\0"
XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
_APP0, _APP1, _SOS = 0xE0, 0xE1, 0xDA
_LONGEST = 0xFFFF - 2  # a segment's length has 16 bits and counts itself


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
