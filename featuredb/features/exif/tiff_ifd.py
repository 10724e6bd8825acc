"""A reader of TIFF directories (the form of EXIF too) that survives any input.

It reads values only: no strips, no images. Every offset is checked against the data, so a wrong one
costs that one value. TIFF 6.0, section 2; EXIF 3.0, section 4.6.2.
"""

import struct
from dataclasses import dataclass, field

from featuredb.errors import InvalidValueError

# Real directories have under a hundred entries; the limit bounds the work on hostile ones.
_MAX_ENTRIES = 1000
# Values that we read are short texts and a few numbers; strip tables of large images reach some 100 kB.
_MAX_VALUE_BYTES = 1 << 20
_FORMATS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}

TagValue = bytes | tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ifd:
    """One directory.

    Attributes:
        values: by tag number; text and opaque data as bytes, everything else as numbers (a rational with
            denominator 0 is NaN).
        warnings: what could not be read.
    """

    values: dict[int, TagValue] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def number(self, tag: int) -> float | None:
        """The first number of the tag, or None where it is absent or not a number; may be NaN."""
        value = self.values.get(tag)
        return float(value[0]) if isinstance(value, tuple) and value else None

    def numbers(self, tag: int) -> tuple[float, ...] | None:
        value = self.values.get(tag)
        return value if isinstance(value, tuple) else None

    def text(self, tag: int) -> str:
        """Text of the tag up to its first NUL, stripped; "" where absent or not text."""
        value = self.values.get(tag)
        if not isinstance(value, bytes):
            return ""
        # EXIF 2 says ASCII, EXIF 3 adds UTF-8, cameras write Latin-1 too.
        raw = value.split(b"\0", 1)[0]
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
        return "".join(c for c in text if c.isprintable()).strip()


class TiffReader:
    """Directories of the TIFF stream in `data`; offsets count from its first byte."""

    def __init__(self, data: bytes | memoryview) -> None:
        """Read the header only.

        Raises:
            InvalidValueError: not a classic TIFF header.
        """
        self._data = memoryview(data)
        order = bytes(self._data[:2])
        if order not in (b"II", b"MM") or len(self._data) < 8:
            raise InvalidValueError(f"TIFF: expected a header II or MM of 8 bytes, found {order!r}")
        self.order = "<" if order == b"II" else ">"
        magic, self.first_offset = struct.unpack_from(self.order + "HI", self._data, 2)
        if magic != 42:
            raise InvalidValueError(f"TIFF: expected the number 42 in the header, found {magic}")

    def read(self, offset: float | None) -> Ifd:
        """The directory at this offset; an unreadable one is empty and says so in its warnings."""
        if offset is None or not 8 <= offset <= len(self._data) - 2:
            return Ifd(warnings=(f"directory at offset {offset} is outside of {len(self._data)} bytes",))
        start = int(offset)
        (count,) = struct.unpack_from(self.order + "H", self._data, start)
        warnings: list[str] = []
        room = (len(self._data) - start - 2) // 12
        if count > min(room, _MAX_ENTRIES):
            warnings.append(f"directory at offset {start} claims {count} entries, room for {room}")
        values: dict[int, TagValue] = {}
        for i in range(min(count, room, _MAX_ENTRIES)):
            at = start + 2 + 12 * i
            tag, kind, n = struct.unpack_from(self.order + "HHI", self._data, at)
            value = self._value(kind, n, at + 8)
            if value is None:
                warnings.append(f"tag {tag} (type {kind}, {n} values) cannot be read")
            else:
                values.setdefault(tag, value)
        return Ifd(values=values, warnings=tuple(warnings))

    def _value(self, kind: int, count: int, at: int) -> TagValue | None:
        size = _SIZES.get(kind)
        if size is None or not 0 < count * size <= _MAX_VALUE_BYTES:
            return None
        if count * size > 4:
            (at,) = struct.unpack_from(self.order + "I", self._data, at)
        if at + count * size > len(self._data):
            return None
        if kind in (2, 7):
            return bytes(self._data[at : at + count])
        if kind in (5, 10):
            parts = struct.unpack_from(f"{self.order}{2 * count}{'I' if kind == 5 else 'i'}", self._data, at)
            return tuple(a / b if b else float("nan") for a, b in zip(parts[::2], parts[1::2], strict=True))
        return struct.unpack_from(f"{self.order}{count}{_FORMATS[kind]}", self._data, at)
