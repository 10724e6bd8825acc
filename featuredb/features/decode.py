"""Image files to pixels, by one rule for ingest and queries alike.

Pixels come as stored: EXIF orientation is not applied, so that features, cameras and poses of a photo
belong to the same pixels whichever program reads it. Grey is OpenCV's own: the luma of a JPEG as
coded, 0.299 R + 0.587 G + 0.114 B for the others. Transparency is dropped. 16 bits keep the upper 8 of
those that the picture uses, since cameras of 10 to 14 bits store dark ones.

A file is checked before anything is allocated for its pixels: kind, size, limits and completeness.
"""

import stat
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.features.heif import heic_pixels
from featuredb.features.image_header import read_header
from featuredb.features.stored_image import ImageHeader

# libjpeg fills what a scan does not cover with coefficients 0, which is this grey.
_JPEG_FILL = 128
_REDUCED = {
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}
# Bytes that decode to something else than the fill; no 0xFF among them, so they add no marker.
_JPEG_PROBE = bytes((37 * i + 11) % 251 for i in range(512))


@dataclass(frozen=True, slots=True, kw_only=True)
class DecodeLimits:
    """What is refused before decoding.

    Attributes:
        max_bytes: file size; the largest JPEGs of today's drones and phones have some 50 MB.
        max_pixels: width times height; medium-format cameras have 102 million, and 120 million are
            360 MB as colour.
        max_scan_pixels: pixels times the passes over them that a JPEG asks for. Encoders make some ten,
            which the largest pictures may have; smaller ones may have more.
        max_side_px: a JPEG's own limit; longer sides are panoramas, which no single camera model fits.
        min_side_px: below this SIFT finds too few keypoints to place anything, and icons are meant.
    """

    max_bytes: int = 64 << 20
    max_pixels: int = 120_000_000
    max_scan_pixels: int = 1_200_000_000
    max_side_px: int = 65_500
    min_side_px: int = 64


DEFAULT_LIMITS = DecodeLimits()
# A person's own files may be larger than a stranger's query; smaller pictures are thumbnails, with too few
# features to hold in a map.
INGEST_LIMITS = DecodeLimits(
    max_bytes=256 << 20, max_pixels=200_000_000, max_scan_pixels=2_000_000_000, min_side_px=240
)


def probe(data: bytes | Path, limits: DecodeLimits = DEFAULT_LIMITS) -> ImageHeader:
    """Format and size of an image file, after checking that it is complete and within the limits.

    Raises:
        ImageError: with a `code` of IMAGE_ERROR_CODES.
    """
    return _check(read_image_bytes(data, limits), limits)


def decode_gray(
    data: bytes | Path,
    limits: DecodeLimits = DEFAULT_LIMITS,
    *,
    header: ImageHeader | None = None,
    side_px: int | None = None,
) -> NDArray[np.uint8]:
    """Grey pixels (h, w) uint8 of an image file, as stored.

    Args:
        header: of `probe` with these limits, where the caller has it already.
        side_px: a JPEG is decoded at a half, a quarter or an eighth of its size if its longer side still has
            so many pixels then: in less time, and hardly different from one that is made smaller later.

    Raises:
        ImageError: with a `code` of IMAGE_ERROR_CODES.
    """
    content = read_image_bytes(data, limits)
    header = header or _check(content, limits)
    by = 1
    if header.format == "JPEG" and side_px is not None:
        by = max(d for d in (1, *_REDUCED) if d == 1 or max(header.width, header.height) >= d * side_px)
    return _decode(content, header, _REDUCED.get(by, cv2.IMREAD_GRAYSCALE), by)


def decode_rgb(data: bytes | Path, limits: DecodeLimits = DEFAULT_LIMITS) -> NDArray[np.uint8]:
    """Colours (h, w, 3) uint8, red first, of an image file, as stored.

    Raises:
        ImageError: with a `code` of IMAGE_ERROR_CODES.
    """
    content = read_image_bytes(data, limits)
    return _decode(content, _check(content, limits), cv2.IMREAD_COLOR_RGB)


def read_image_bytes(data: bytes | Path, limits: DecodeLimits = DEFAULT_LIMITS) -> bytes:
    """The bytes of the file, read only if it is a regular file of allowed size.

    Raises:
        ImageError: unreadable, too_large.
    """
    if isinstance(data, Path):
        data = _read_file(data, limits)
    if len(data) > limits.max_bytes:
        raise _too_many_bytes(len(data), limits)
    return bytes(data)


def _read_file(path: Path, limits: DecodeLimits) -> bytes:
    try:
        info = path.stat()
        if not stat.S_ISREG(info.st_mode):
            raise ImageError(f"{path.name} is not a regular file", "unreadable")
        if info.st_size > limits.max_bytes:
            raise _too_many_bytes(info.st_size, limits)
        with path.open("rb") as file:
            return file.read(limits.max_bytes + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        why = getattr(error, "strerror", None) or error
        raise ImageError(f"{path.name} cannot be read: {why}", "unreadable") from error


def _too_many_bytes(size: int, limits: DecodeLimits) -> ImageError:
    return ImageError(f"the file has {size} bytes, the limit is {limits.max_bytes}", "too_large")


def _check(data: bytes, limits: DecodeLimits) -> ImageHeader:
    header = read_header(data)
    size = f"{header.width}x{header.height}"
    if min(header.width, header.height) < limits.min_side_px:
        raise ImageError(
            f"the image has {size} pixels, both sides must have at least {limits.min_side_px}", "too_small"
        )
    if header.width * header.height > limits.max_pixels:
        raise ImageError(
            f"the image has {size} pixels, the limit is {limits.max_pixels / 1e6:g} million", "too_large"
        )
    if header.width * header.height * header.scans > limits.max_scan_pixels:
        raise ImageError(
            f"the JPEG has {header.scans} scans of {size} pixels, the limit of both together is "
            f"{limits.max_scan_pixels / 1e6:g} million; save it as a baseline JPEG",
            "too_large",
        )
    if max(header.width, header.height) > limits.max_side_px:
        raise ImageError(
            f"the image has {size} pixels, the limit of a side is {limits.max_side_px}", "too_large"
        )
    return header


def _decode(content: bytes, header: ImageHeader, flags: int, by: int = 1) -> NDArray[np.uint8]:
    """Pixels by OpenCV's flags, which make the picture smaller by this divisor."""
    pixels = _heic(content, header, flags) if header.format == "HEIC" else _imdecode(content, flags)
    if header.format in ("PNG", "TIFF") and pixels is not None and pixels.max() < 128:
        # By IMREAD_COLOR_RGB, OpenCV leaves the pixels of such a TIFF as they were in memory.
        deep = _imdecode(content, (flags and cv2.IMREAD_COLOR) | cv2.IMREAD_ANYDEPTH)
        if deep is not None:
            pixels = np.ascontiguousarray(deep[:, :, ::-1]) if flags else deep
    if pixels is None:
        raise ImageError(f"the {header.format} of {header.width}x{header.height} cannot be decoded", "broken")
    if pixels.shape[:2] != (-(-header.height // by), -(-header.width // by)):
        raise ImageError(
            f"the {header.format} claims {header.width}x{header.height} pixels but holds "
            f"{by * pixels.shape[1]}x{by * pixels.shape[0]}",
            "broken",
        )
    if header.format == "JPEG" and header.scans == 1 and _ends_early(content, header, pixels, flags, by):
        raise ImageError(
            "the JPEG's end marker comes before its last pixels; copy the file again", "truncated"
        )
    return pixels


def _heic(content: bytes, header: ImageHeader, flags: int) -> NDArray[np.uint8]:
    rgb = heic_pixels(content, (header.width, header.height), header.orientation or 1)
    if flags != cv2.IMREAD_GRAYSCALE:
        return rgb
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _imdecode(content: bytes, flags: int) -> NDArray[np.uint8] | None:
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except (cv2.error, MemoryError) as error:
        if isinstance(error, MemoryError) or error.code == cv2.Error.StsNoMem:
            raise ImageError("the image needs more memory than there is", "too_large") from error
        return None
    if pixels is not None and pixels.dtype == np.uint16:
        pixels = pixels >> max(int(pixels.max()).bit_length() - 8, 0)
    return None if pixels is None else np.asarray(pixels, dtype=np.uint8)


def _ends_early(content: bytes, header: ImageHeader, pixels: NDArray[np.uint8], flags: int, by: int) -> bool:
    """Whether an end marker was put behind half a picture (repair tools and some downloaders do).

    Only a picture whose last block is all fill is suspected, so others pay nothing. A complete picture
    needs no byte before its end marker beyond its own: it stays the same when some are added there,
    whereas a cut one takes them as its next pixels. A JPEG of several scans that is cut is a picture of
    lower quality, and is not decoded twice.
    """
    last_block = pixels[(header.height - 1) // 8 * 8 // by :, (header.width - 1) // 8 * 8 // by :]
    if not bool((last_block == _JPEG_FILL).all()):
        return False
    cut = header.end - 2
    other = _imdecode(content[:cut] + _JPEG_PROBE + content[cut : header.end], flags)
    return other is None or not np.array_equal(pixels, other)
