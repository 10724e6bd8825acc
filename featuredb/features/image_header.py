"""What an image file is, how large, and whether it is complete: from its bytes, without decoding pixels.

Own readers of the few headers instead of a library's, because they run on hostile input in threads: they
allocate nothing, warn nobody and cost well under a millisecond.
"""

import re
import struct
import zlib
from typing import Any

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.exif.tiff_ifd import Ifd, TiffReader
from featuredb.features.heif import SEQUENCE_BRANDS, STILL_BRANDS, read_heif
from featuredb.features.stored_image import ImageHeader

IMAGE_ERROR_CODES = (
    "unreadable",  # the file could not be opened or is not a regular file
    "not_an_image",
    "truncated",
    "broken",  # complete by its length, but its contents contradict themselves
    "too_large",
    "too_small",
    "unsupported",  # an image, but of a kind that is not taken
)

# Markers that may stand between the scans of a JPEG: DHT, DAC, EOI, SOS, DQT, DNL, DRI, APPn, COM.
_JPEG_BETWEEN_SCANS = frozenset({0xC4, 0xCC, 0xD9, 0xDA, 0xDB, 0xDC, 0xDD, 0xFE, *range(0xE0, 0xF0)})
_JPEG_SOF = frozenset(set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC})
_JPEG_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# Encoders write about ten scans; each scan costs a pass over the image, which makes a cheap bomb.
_MAX_JPEG_SCANS = 100
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def check_signature(head: bytes) -> None:
    """Refuse by its first 32 bytes what cannot be an image, so that nothing else of it need be read.

    Raises:
        ImageError: codes not_an_image, unsupported, truncated.
    """
    if not head:
        raise ImageError("the file is empty", "not_an_image")
    if not (
        head[:2] == b"\xff\xd8"
        or head[:8] == _PNG_SIGNATURE
        or (head[:4] == b"RIFF" and head[8:12] == b"WEBP")
        or head[:4] in (b"II*\0", b"MM\0*")
        or _is_bmp(head)
        or (head[4:8] == b"ftyp" and head[8:12] in STILL_BRANDS)
    ):
        raise _refusal(head)


def read_header(data: bytes) -> ImageHeader:
    """Format, size and completeness of the image file in `data`.

    Raises:
        ImageError: codes not_an_image, truncated, broken, unsupported.
    """
    check_signature(data[:32])
    if data[:2] == b"\xff\xd8":
        return _jpeg(data)
    if data[:8] == _PNG_SIGNATURE:
        return _png(data)
    if data[:4] == b"RIFF":
        return _webp(data)
    if data[4:8] == b"ftyp":
        return read_heif(data)
    return _bmp(data) if _is_bmp(data) else _tiff(data)


def _is_bmp(head: bytes) -> bool:
    """The signature and one of the sizes of a header; two letters alone would be too weak."""
    return head[:2] == b"BM" and head[14:18] in (b"\x28\0\0\0", b"\x6c\0\0\0", b"\x7c\0\0\0")


def _refusal(data: bytes) -> ImageError:
    brand = data[8:12] if data[4:8] == b"ftyp" else b""
    if brand in SEQUENCE_BRANDS:
        return ImageError("a sequence of HEIF pictures is not supported; export one", "unsupported")
    if brand:
        return ImageError(f"a film (MP4, brand {brand!r}) is not a photo", "unsupported")
    known = {
        b"GIF8": "GIF",
        b"\0\0\0\x0c": "JPEG 2000",
        b"\xffO\xffQ": "JPEG 2000",
        b"8BPS": "Photoshop",
        b"II+\0": "BigTIFF",
        b"MM\0+": "BigTIFF",
        b"FUJI": "a Fujifilm raw file",
    }
    if data[:4] in known:
        return ImageError(
            f"{known[data[:4]]} is not supported; convert to JPEG, PNG, WebP, TIFF or BMP", "unsupported"
        )
    if _PNG_SIGNATURE.startswith(data) or (len(data) < 12 and data[:4] == b"RIFF"):
        return ImageError(f"the file ends after {len(data)} bytes, within its header", "truncated")
    return ImageError(
        f"expected a JPEG, HEIC, AVIF, PNG, WebP, TIFF or BMP file, found bytes that begin with {data[:8]!r}",
        "not_an_image",
    )


def _truncated(name: str, data: bytes, what: str) -> ImageError:
    return ImageError(f"the {name} ends after {len(data)} bytes, {what}; copy the file again", "truncated")


def _jpeg(data: bytes) -> ImageHeader:
    """Walk the segments to the frame header, then the scans to the end marker. ITU T.81, annex B."""
    at, scans, jfif = 2, 0, False
    frame: tuple[int, int] | None = None
    metadata: dict[str, Any] = {}  # exif and xmp of ImageHeader
    while True:
        if scans:  # entropy-coded data: the next marker that is neither stuffing nor a restart
            found = _JPEG_IN_SCAN.search(data, at)
            if found is None:
                raise _truncated("JPEG", data, "before its end marker")
            at = found.start()
        while data[at : at + 2] == b"\xff\xff":
            at += 1
        if at + 2 > len(data):
            raise _truncated("JPEG", data, "before its end marker")
        marker = data[at + 1]
        if data[at] != 0xFF or (scans and marker not in _JPEG_BETWEEN_SCANS):
            raise ImageError(
                f"the JPEG has the wrong marker {data[at : at + 2].hex()} at byte {at}", "broken"
            )
        if marker == 0xD9:
            if frame is None or not scans:
                raise ImageError("the JPEG ends before any picture", "broken")
            width, height = frame
            return ImageHeader("JPEG", width, height, jfif=jfif, scans=scans, end=at + 2, **metadata)
        body, stop = at + 4, at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if max(body, stop) > len(data):
            raise _truncated("JPEG", data, f"within the segment at byte {at}")
        if stop < body:
            raise ImageError(f"the JPEG has a segment without length at byte {at}", "broken")
        if marker in _JPEG_SOF:
            if frame is not None:
                raise ImageError("the JPEG has two frame headers", "broken")
            frame = _jpeg_frame(marker, data[body:stop])
        elif marker == 0xE0 and data[body : body + 5] == b"JFIF\0":
            jfif = True
        elif marker == 0xE1 and data[body : body + 6] == b"Exif\0\0":
            metadata.setdefault("exif", (body + 6, stop))
        elif marker == 0xE1 and data[body : body + 29] == b"http://ns.adobe.com/xap/1.0/\0":
            metadata.setdefault("xmp", (body + 29, stop))
        elif marker == 0xDA:
            scans += 1
            if frame is None:
                raise ImageError("the JPEG has a scan before its frame header", "broken")
            if scans > _MAX_JPEG_SCANS:
                raise ImageError(f"the JPEG has over {_MAX_JPEG_SCANS} scans; save it again", "unsupported")
        at = stop


def _jpeg_frame(marker: int, body: bytes) -> tuple[int, int]:
    if len(body) < 6:
        raise ImageError("the JPEG's frame header is too short", "broken")
    bits, height, width, components = struct.unpack_from(">BHHB", body)
    if marker not in (0xC0, 0xC1, 0xC2):
        kind = "arithmetic coding" if marker >= 0xC9 else "lossless or hierarchical coding"
        raise ImageError(f"a JPEG with {kind} is not supported; save it as baseline JPEG", "unsupported")
    if bits != 8 or components not in (1, 3, 4):
        raise ImageError(
            f"a JPEG with {components} components of {bits} bits is not supported; use 8 bits", "unsupported"
        )
    return width, height


def _png(data: bytes) -> ImageHeader:
    """Walk all chunks and check their sums, so that a flipped bit is found. PNG 3rd edition, section 5."""
    at, size = 8, (0, 0)
    metadata: dict[str, Any] = {}  # exif and xmp of ImageHeader
    view = memoryview(data)
    has_pixels = False
    while True:
        if at + 12 > len(data):
            raise _truncated("PNG", data, "before its end chunk")
        length, kind = struct.unpack_from(">I4s", data, at)
        body, stop = at + 8, at + 8 + length
        if stop + 4 > len(data):
            raise _truncated("PNG", data, f"within the chunk {kind!r} at byte {at}")
        if at == 8 and (kind != b"IHDR" or length != 13):
            raise ImageError("the PNG does not begin with its header chunk", "broken")
        critical = not kind[0] & 0x20
        if critical and zlib.crc32(view[at + 4 : stop]) != int.from_bytes(data[stop : stop + 4], "big"):
            raise ImageError(f"the PNG's chunk {kind!r} at byte {at} has a wrong check sum", "broken")
        if kind == b"IHDR":
            size = struct.unpack_from(">II", data, body)
        elif kind == b"acTL":
            raise ImageError("an animated PNG is not supported; export one frame", "unsupported")
        elif kind == b"eXIf":
            metadata["exif"] = (body, stop)
        elif kind == b"iTXt" and data[body : body + 22] == b"XML:com.adobe.xmp\0\0\0\0\0":
            metadata["xmp"] = (body + 22, stop)
        elif kind == b"IDAT":
            has_pixels = True
        elif kind == b"IEND":
            if not has_pixels:
                raise ImageError("the PNG has no pixels", "broken")
            return ImageHeader("PNG", *size, end=stop + 4, **metadata)
        at = stop + 4


def _webp(data: bytes) -> ImageHeader:
    """RIFF chunks of a WebP. RFC 9649, section 2."""
    end = 8 + int.from_bytes(data[4:8], "little")
    if end > len(data):
        raise _truncated("WebP", data, f"of {end}")
    at, size = 12, None
    metadata: dict[str, Any] = {}  # exif and xmp of ImageHeader
    while at + 8 <= end:
        kind, length = struct.unpack_from("<4sI", data, at)
        body, stop = at + 8, at + 8 + length
        if stop > end:
            raise ImageError(f"the WebP's chunk {kind!r} reaches past its container", "broken")
        if kind == b"VP8X" and length >= 10:
            if data[body] & 0x02:
                raise ImageError("an animated WebP is not supported; export one frame", "unsupported")
            size = tuple(1 + int.from_bytes(data[body + i : body + i + 3], "little") for i in (4, 7))
        elif kind == b"VP8 " and length >= 10 and size is None:
            size = tuple(v & 0x3FFF for v in struct.unpack_from("<HH", data, body + 6))
        elif kind == b"VP8L" and length >= 5 and size is None:
            bits = int.from_bytes(data[body + 1 : body + 5], "little")
            size = ((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
        elif kind == b"EXIF":
            prefix = 6 if data[body : body + 6] == b"Exif\0\0" else 0
            metadata["exif"] = (body + prefix, stop)
        elif kind == b"XMP ":
            metadata["xmp"] = (body, stop)
        at = stop + (length & 1)
    if size is None:
        raise ImageError("the WebP has no picture", "broken")
    return ImageHeader("WEBP", *size, end=end, **metadata)


def _tiff(data: bytes) -> ImageHeader:
    """First directory of a TIFF: kind, size, and whether its strips or tiles lie within the file."""
    try:
        reader = TiffReader(data)
    except InvalidValueError as error:
        raise _truncated("TIFF", data, "within its header") from error
    ifd = reader.read(reader.first_offset)
    width, height = ifd.number(256), ifd.number(257)
    if not width or not height or width != width or height != height:
        raise _truncated("TIFF", data, "without the size of its picture")
    if 50706 in ifd.values or data[8:10] == b"CR" or int(_finite(ifd, 254, 0)) & 1:
        raise ImageError("a camera's raw file is not supported; export a JPEG", "unsupported")
    if _finite(ifd, 339, 1) != 1 or _finite(ifd, 258, 1) not in (1, 2, 4, 8, 16):
        raise ImageError("a TIFF with other than unsigned 1..16 bit samples is not supported", "unsupported")
    for offsets_tag, counts_tag in ((273, 279), (324, 325)):
        offsets, counts = ifd.numbers(offsets_tag), ifd.numbers(counts_tag)
        if offsets and counts:
            last = max(o + c for o, c in zip(offsets, counts, strict=False))
            if last > len(data):
                raise _truncated("TIFF", data, f"its pixels reach to {last:.0f}")
            break
    else:
        raise ImageError("the TIFF does not say where its pixels lie", "broken")
    return ImageHeader("TIFF", int(width), int(height), exif=(0, len(data)), end=len(data))


def _finite(ifd: Ifd, tag: int, default: float) -> float:
    value = ifd.number(tag)
    return default if value is None or value != value or abs(value) > 2**32 else value


def _bmp(data: bytes) -> ImageHeader:
    pixels, _, width, height, _, bits, compression = struct.unpack_from(
        "<IIiiHHI", data[:64].ljust(64, b"\0"), 10
    )
    height = abs(height)
    if width <= 0 or height == 0 or bits not in (1, 4, 8, 16, 24, 32):
        raise ImageError(f"the BMP has the impossible size {width}x{height} at {bits} bits", "broken")
    if compression in (0, 3) and pixels + (width * bits + 31) // 32 * 4 * height > len(data):
        raise _truncated("BMP", data, "within its pixels")
    return ImageHeader("BMP", width, height, end=len(data))
