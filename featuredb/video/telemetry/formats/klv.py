"""GPMF's keys, lengths and values (https://github.com/gopro/gpmf-parser): parsed within their bounds.

An entry is a four-character key, one byte of type, one of the size of a sample, two of the number of samples,
and the samples, padded to four bytes; all big endian. Type 0 holds entries. Lengths are checked against what
is there, so that a damaged or hostile packet ends in `TelemetryError`: nothing is read beyond its parent,
every entry takes at least eight bytes, and nesting is bounded.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray

# Device, stream, data is three; the reference parser allows sixteen.
MAX_DEPTH = 16
# A packet of a second has some hundred entries.
MAX_ENTRIES = 50_000

_HEADER = struct.Struct(">4sBBH")
_NUMBERS = {
    "b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
    "f": ">f4", "d": ">f8", "q": ">i4", "Q": ">i8",
}  # fmt: skip
_FIXED_POINT = {"q": 2.0**-16, "Q": 2.0**-32}
_MAX_FIELDS = 255  # a sample has at most 255 bytes
_FIELD = re.compile(r"([^][])(\[0*([1-9][0-9]{0,2})\])?")  # of a structure, and how often it is repeated


@dataclass(frozen=True, slots=True)
class Klv:
    """One entry.

    Attributes:
        type: one character, "" for nested entries.
        size: bytes of one sample.
        data: size times count bytes.
    """

    key: str
    type: str
    size: int
    count: int
    data: bytes
    children: tuple["Klv", ...] = ()

    def text(self) -> str:
        """Characters of types c, F and U, without trailing zeros; Latin-1, as its units need."""
        return self.data.decode("latin-1").rstrip("\0 ")

    def walk(self) -> Iterator["Klv"]:
        """This entry and all below it, parents first."""
        yield self
        for child in self.children:
            yield from child.walk()


def parse_klv(data: bytes) -> tuple[Klv, ...]:
    """The entries of one packet.

    Raises:
        TelemetryError: truncated, not GPMF, nested too deeply, or too many entries.
    """
    return tuple(_parse(memoryview(data), 0, [MAX_ENTRIES]))


def _parse(data: memoryview, depth: int, left: list[int]) -> list[Klv]:
    if depth > MAX_DEPTH:
        raise TelemetryError(f"GPMF: entries nested more than {MAX_DEPTH} deep; the packet is damaged")
    entries: list[Klv] = []
    at = 0
    while at < len(data):
        if not any(data[at : at + 4]):  # padding up to the end
            break
        if len(data) - at < _HEADER.size:
            raise TelemetryError(
                f"GPMF: {len(data) - at} bytes where an entry of 8 or more was expected; truncated"
            )
        key, kind, size, count = _HEADER.unpack_from(data, at)
        if not all(32 <= byte < 127 for byte in key):
            raise TelemetryError(
                f"GPMF: expected a key of four characters, found {key!r}; the packet is damaged"
            )
        at += _HEADER.size
        length = size * count
        if length > len(data) - at:
            raise TelemetryError(
                f"GPMF: {key.decode('ascii')} announces {length} bytes, {len(data) - at} are left; truncated"
            )
        left[0] -= 1
        if left[0] < 0:
            raise TelemetryError(f"GPMF: more than {MAX_ENTRIES} entries in a packet; it is damaged")
        body = data[at : at + length]
        children = tuple(_parse(body, depth + 1, left)) if kind == 0 else ()
        entries.append(
            Klv(key.decode("ascii"), chr(kind) if kind else "", size, count, bytes(body), children)
        )
        at += length + (-length) % 4
    return entries


def numbers(entry: Klv, structure: str = "") -> FloatArray:
    """The samples of an entry as numbers.

    Args:
        entry: of a numeric type, or of type "?" with its structure.
        structure: the text of the TYPE entry before it, such as "lllllllSS" or "f[8]L".

    Returns:
        (count, fields) float64, not scaled.

    Raises:
        TelemetryError: not numbers, or a structure that does not have the size of a sample.
    """
    kinds = _expand(structure) if entry.type == "?" else [entry.type]
    if any(kind not in _NUMBERS for kind in kinds):
        raise TelemetryError(
            f"GPMF: expected numbers in {entry.key}, found type {entry.type!r} {structure!r}"
        )
    bytes_each = sum(np.dtype(_NUMBERS[kind]).itemsize for kind in kinds)
    if entry.type != "?":
        if not entry.size or entry.size % bytes_each:
            raise TelemetryError(f"GPMF: {entry.key} of type {entry.type} has samples of {entry.size} bytes")
        kinds *= entry.size // bytes_each
    elif bytes_each != entry.size:
        raise TelemetryError(
            f"GPMF: {entry.key} has samples of {entry.size} bytes, its structure {structure!r} {bytes_each}"
        )
    rows = np.frombuffer(
        entry.data, dtype=np.dtype([(str(i), _NUMBERS[kind]) for i, kind in enumerate(kinds)])
    )
    columns = [rows[str(i)].astype(np.float64) * _FIXED_POINT.get(kind, 1.0) for i, kind in enumerate(kinds)]
    return np.stack(columns, axis=1)


def _expand(structure: str) -> list[str]:
    """The characters of a structure with its repetitions written out: "f[3]L" is f, f, f, L."""
    if not structure:
        raise TelemetryError("GPMF: a structure was expected before an entry of type '?', found none")
    parts = _FIELD.findall(structure)
    if "".join(kind + repeated for kind, repeated, _ in parts) != structure:
        raise TelemetryError(f"GPMF: the structure {structure[:40]!r} cannot be read")
    kinds = [kind for kind, _, times in parts for _ in range(int(times or 1))]
    if len(kinds) > _MAX_FIELDS:
        raise TelemetryError(f"GPMF: the structure {structure[:40]!r} has more than {_MAX_FIELDS} fields")
    return kinds
