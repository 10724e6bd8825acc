"""HEIF files (HEIC, AVIF), as phones write them: their header, and HEIC's pixels.

The boxes are read here, without a library, as the headers of other kinds are. Of several pictures in a file
the primary one counts; depth maps, gain maps and thumbnails beside it are not looked at. How the picture is
turned, the file says in boxes of its own, which go before EXIF's orientation: pixels are handed out unturned,
with the orientation that EXIF would have for them. ISO/IEC 14496-12 (boxes), 23008-12 and 23000-22 (HEIF).

An AVIF may be coded larger than its header says, and is made smaller by libavif, which decodes up to 268
million pixels; libheif refuses that.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, MissingExtraError
from featuredb.extras import require
from featuredb.features.stored_image import ImageHeader

STILL_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"mif1", b"avif"})
SEQUENCE_BRANDS = frozenset({b"hevc", b"hevx", b"msf1", b"avis"})
_PICTURES = (b"hvc1", b"av01", b"grid")  # cameras' kinds; a library may decode others, of any size
_BLOCK = 64  # pixels of HEVC's largest block: encoders fill the last one, and cut that off again
_MAX_META = 1 << 20  # bytes of the box that describes all; a phone's has some 20 kB
# (quarter turns against the clock, then the axis of a mirror or None) as an orientation of EXIF.
_ORIENTATIONS: dict[tuple[int, int | None], int] = {
    **{(0, None): 1, (1, None): 8, (2, None): 3, (3, None): 6},
    **{(0, 0): 4, (1, 0): 5, (2, 0): 2, (3, 0): 7},  # top and bottom change places
    **{(0, 1): 2, (1, 1): 7, (2, 1): 4, (3, 1): 5},  # left and right do
}


@dataclass(slots=True)
class _Reader:
    """Big-endian numbers of a box, one after the other."""

    data: bytes
    at: int
    stop: int

    def number(self, size: int) -> int:
        if self.at + size > self.stop:
            raise _broken(f"a box ends at byte {self.stop}, within a number")
        self.at += size
        return int.from_bytes(self.data[self.at - size : self.at], "big")

    def version(self) -> int:
        """Of a box that has one, and flags."""
        return self.number(4) >> 24

    def boxes(self) -> Iterator[tuple[bytes, "_Reader"]]:
        """The boxes from here to the end."""
        while self.at + 8 <= self.stop:
            begin, size, kind = self.at, self.number(4), self.data[self.at : self.at + 4]
            self.at += 4
            size = self.number(8) if size == 1 else size or self.stop - begin
            if not self.at <= begin + size <= self.stop:
                raise _broken(f"the box {kind!r} at byte {begin} has the wrong length {size}")
            body, self.at = _Reader(self.data, self.at, begin + size), begin + size
            yield kind, body


@dataclass(slots=True)
class _Meta:
    """What the box `meta` says. Items by their number; properties in the order of the file."""

    primary: int | None = None
    types: dict[int, bytes] = field(default_factory=dict)
    extents: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)  # construction, start, stop
    properties: list[tuple[bytes, _Reader]] = field(default_factory=list)
    used: dict[int, list[int]] = field(default_factory=dict)
    idat: int = 0

    @property
    def is_avif(self) -> bool:
        """Coded as AV1, and not as HEVC."""
        return b"av01" in self.types.values()


def read_heif(data: bytes) -> ImageHeader:
    """Size, orientation and metadata of the primary picture.

    Raises:
        ImageError: codes truncated, broken, unsupported.
    """
    meta = _read_meta(_meta_box(data))
    width, height, orientation = _geometry(meta)
    ends = [stop for extents in meta.extents.values() for kind, _, stop in extents if kind == 0]
    end = max(ends, default=0)
    if end > len(data):
        raise ImageError(
            f"the HEIF file ends after {len(data)} bytes of {end}; copy the file again", "truncated"
        )
    exif, xmp = (_item(meta, kind) for kind in (b"Exif", b"mime:application/rdf+xml"))
    if exif is not None:  # behind an offset, before which "Exif" may stand
        skipped = 4 + int.from_bytes(data[exif[0] : exif[0] + 4], "big")
        exif = (exif[0] + skipped, exif[1]) if exif[0] + skipped < exif[1] else None
        if exif is not None and data[exif[0] : exif[0] + 6] == b"Exif\0\0":
            exif = (exif[0] + 6, exif[1])
    kind = "AVIF" if meta.is_avif else "HEIC"
    return ImageHeader(kind, width, height, orientation=orientation, exif=exif, xmp=xmp, end=end)


def heic_pixels(data: bytes, header_size: tuple[int, int], orientation: int) -> NDArray[np.uint8]:
    """Colours (h, w, 3) uint8, red first, of the primary picture, unturned; the upper 8 bits.

    Args:
        header_size, orientation: (width, height) and orientation of `read_heif`.

    Raises:
        ImageError: codes unsupported (the extra is missing), broken, too_large (memory).
    """
    try:
        require("heic", "A HEIC photo", "pillow_heif")
    except MissingExtraError as error:
        raise ImageError(str(error), "unsupported") from error
    import pillow_heif

    pillow_heif.options.DECODE_THREADS = 1  # photos and queries are already spread over the cores
    turned_size = header_size if orientation < 5 else header_size[::-1]
    try:
        file = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)  # decodes nothing yet
        if file.size != turned_size:
            raise _broken(f"a picture of {turned_size} pixels is found as one of {file.size}")
        pixels = np.asarray(file[file.primary_index])
    except (ValueError, RuntimeError, LookupError, OSError, EOFError, SyntaxError, MemoryError) as error:
        no_memory = isinstance(error, MemoryError) or "Memory allocation" in str(error)
        code = "too_large" if no_memory else "broken"
        raise ImageError(f"the HEIC cannot be decoded: {str(error)[:200]}", code) from error
    if pixels.dtype == np.uint16:  # grey of 10 and 12 bits, whatever `convert_hdr_to_8bit` says
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    return np.ascontiguousarray(_unturned(pixels[:, :, :3], orientation))


def _unturned(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """What EXIF's orientation would turn into this."""
    if orientation >= 5:
        pixels = pixels.transpose(1, 0, 2)
    return pixels[:: -1 if orientation in (3, 4, 6, 7) else 1, :: -1 if orientation in (2, 3, 7, 8) else 1]


def _broken(what: str) -> ImageError:
    return ImageError(f"the HEIF file's boxes do not fit together: {what}", "broken")


def _meta_box(data: bytes) -> _Reader:
    """The box `meta` of the whole file. What comes behind the last box, phones append."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        body = at + 8
        if size == 1:
            size, body = int.from_bytes(data[at + 8 : at + 16], "big"), at + 16
        if kind == b"meta":
            if size > _MAX_META:
                raise _broken(f"the box 'meta' has {size} bytes")
            if at + size > len(data):
                break
            return _Reader(data, body + 4, at + size)
        if size < 8:
            raise _broken(f"the box {kind!r} at byte {at} has the wrong length {size}")
        at += size
    raise ImageError(
        f"the HEIF file ends after {len(data)} bytes, before it says what is in it; copy the file again",
        "truncated",
    )


def _read_meta(box: _Reader) -> _Meta:
    meta = _Meta()
    for kind, body in box.boxes():
        if kind == b"idat":
            meta.idat = body.at
        elif kind == b"pitm":
            meta.primary = body.number(4 if body.version() else 2)
        elif kind == b"iinf":
            body.number(4 if body.version() else 2)
            for name, entry in body.boxes():
                if name == b"infe":
                    _read_item(entry, meta)
        elif kind == b"iloc":
            _read_extents(body, meta)
        elif kind == b"iprp":
            for name, part in body.boxes():
                if name == b"ipco":
                    meta.properties = list(part.boxes())
                elif name == b"ipma":
                    _read_used(part, meta)
    return meta


def _read_item(entry: _Reader, meta: _Meta) -> None:
    version = entry.version()
    if version < 2:
        return
    number, _ = entry.number(4 if version > 2 else 2), entry.number(2)
    kind = entry.number(4).to_bytes(4, "big")
    if kind == b"mime":
        _, _, content = entry.data[entry.at : entry.stop].partition(b"\0")
        kind = b"mime:" + content.partition(b"\0")[0]
    meta.types[number] = kind


def _read_extents(body: _Reader, meta: _Meta) -> None:
    version, sizes = body.version(), body.number(2)
    offset_size, length_size, base_size = sizes >> 12, sizes >> 8 & 15, sizes >> 4 & 15
    index_size = sizes & 15 if version else 0
    if not {offset_size, length_size, base_size, index_size} <= {0, 4, 8}:  # ISO/IEC 14496-12, 8.11.3
        raise _broken("its table of places has numbers of no size that there is")
    if not length_size or not (offset_size or base_size):
        raise _broken("its items have no length")  # nor would reading them ever end
    for _ in range(body.number(2 if version < 2 else 4)):
        number = body.number(2 if version < 2 else 4)
        construction = body.number(2) & 15 if version else 0
        body.number(2)
        base = body.number(base_size)
        spans = meta.extents.setdefault(number, [])
        for _ in range(body.number(2)):
            body.number(index_size)
            start = base + body.number(offset_size)
            spans.append((construction, start, start + body.number(length_size)))


def _read_used(body: _Reader, meta: _Meta) -> None:
    version, flags = body.number(1), body.number(3)
    size = 2 if flags & 1 else 1
    for _ in range(body.number(4)):
        number = body.number(4 if version else 2)
        mask = 0x7FFF if size == 2 else 0x7F
        meta.used[number] = [(body.number(size) & mask) - 1 for _ in range(body.number(1))]


def _geometry(meta: _Meta) -> tuple[int, int, int]:
    """Width, height, and EXIF's orientation."""
    if meta.primary is None or meta.primary not in meta.types:
        raise ImageError("the HEIF file has no primary picture; export a JPEG", "unsupported")
    if (kind := meta.types[meta.primary]) not in _PICTURES:
        raise ImageError(
            f"a HEIF picture of the kind {kind!r} is not supported; export a JPEG", "unsupported"
        )
    size: tuple[int, int] | None = None
    turns, mirror = 0, None
    for index in meta.used.get(meta.primary, []):
        if not 0 <= index < len(meta.properties):
            continue
        kind, found = meta.properties[index]
        body = _Reader(found.data, found.at, found.stop)
        if kind == b"ispe":
            body.number(4)
            size = body.number(4), body.number(4)
        elif kind == b"clap" and not meta.is_avif:  # libheif cuts, OpenCV does not
            width, per_width, height, per_height = (body.number(4) for _ in range(4))
            coded = size
            size = round(width / max(per_width, 1)), round(height / max(per_height, 1))
            if coded is None or any(not 0 <= a - b < _BLOCK for a, b in zip(coded, size, strict=True)):
                raise ImageError("a HEIF picture that is cut by a box is not supported", "unsupported")
        elif kind == b"irot":
            turns += (body.number(1) & 3) * (1 if mirror is None else -1)
        elif kind == b"imir":
            mirror = body.number(1) & 1
    if size is None:
        raise _broken("the primary picture has no size")
    return *size, _ORIENTATIONS[turns % 4, mirror]


def _item(meta: _Meta, kind: bytes) -> tuple[int, int] | None:
    """Where the first item of a kind lies, if it lies in one piece."""
    for number, found in meta.types.items():
        spans = meta.extents.get(number, [])
        if found == kind and len(spans) == 1 and spans[0][0] in (0, 1):
            construction, start, stop = spans[0]
            shift = meta.idat if construction else 0
            return start + shift, stop + shift
    return None
