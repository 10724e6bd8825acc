"""Files of telemetry made for tests: GPMF entries byte by byte, and an mp4 with nothing but such tracks."""

import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

EPOCH_2000 = datetime(2000, 1, 1, tzinfo=UTC)


def klv(key: str, kind: str, size: int, count: int, data: bytes) -> bytes:
    """One GPMF entry with its padding; kind "" is nested."""
    header = struct.pack(">4sBBH", key.encode(), ord(kind) if kind else 0, size, count)
    return header + data + b"\0" * (-len(data) % 4)


def nest(key: str, *entries: bytes) -> bytes:
    body = b"".join(entries)
    return klv(key, "", 1, len(body), body) if len(body) < 65536 else klv(key, "", 4, len(body) // 4, body)


def gps5(
    rows: Sequence[tuple[float, float, float]],
    *,
    fix: int = 3,
    dop: float = 1.5,
    utc: str = "240531115959.500",
    extra: Sequence[bytes] = (),
) -> bytes:
    """A HERO5's GPS stream: rows of latitude, longitude, height."""
    scale = (10_000_000, 10_000_000, 1000, 1000, 100)
    samples = b"".join(
        struct.pack(">5i", *(round(value * s) for value, s in zip((*row, 2.0, 2.1), scale, strict=True)))
        for row in rows
    )
    return nest(
        "STRM",
        klv("TSMP", "L", 4, 1, struct.pack(">I", len(rows))),
        klv("STNM", "c", 1, 7, b"GPS abc"),
        klv("GPSF", "L", 4, 1, struct.pack(">I", fix)),
        klv("GPSU", "U", 16, 1, utc.encode()),
        klv("GPSP", "S", 2, 1, struct.pack(">H", round(100 * dop))),
        *extra,
        klv("UNIT", "c", 3, 5, b"deg" + b"deg" + b"m\0\0" + b"m/s" + b"m/s"),
        klv("SCAL", "l", 4, 5, struct.pack(">5i", *scale)),
        klv("GPS5", "l", 20, len(rows), samples),
    )


def gps9(rows: Sequence[tuple[float, float, float, datetime, float, int]]) -> bytes:
    """A HERO11's GPS stream: rows of latitude, longitude, height, UTC, DOP, fix."""
    scale = (10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1)
    samples = b""
    for latitude, longitude, height, utc, dop, fix in rows:
        since = utc - EPOCH_2000
        seconds = since.seconds + since.microseconds / 1e6
        values = (latitude, longitude, height, 0.0, 0.0, since.days, seconds, dop, fix)
        whole = [round(value * s) for value, s in zip(values, scale, strict=True)]
        samples += struct.pack(">7i2H", *whole)
    return nest(
        "STRM",
        klv("TYPE", "c", 1, 9, b"lllllllSS"),
        klv("SCAL", "l", 4, 9, struct.pack(">9i", *scale)),
        klv("GPS9", "?", 32, len(rows), samples),
    )


def device(*streams: bytes) -> bytes:
    """A packet of one camera; streams that are of no interest are put before the others."""
    accelerations = klv("ACCL", "s", 6, 3, struct.pack(">9h", *range(9)))
    other = nest("STRM", klv("STNM", "c", 1, 4, b"Acc."), klv("SCAL", "s", 2, 1, b"\x01\xa2"), accelerations)
    return nest("DEVC", klv("DVNM", "c", 1, 6, b"Camera"), other, *streams)


def write_mp4(path: Path, tracks: Sequence[tuple[str, Sequence[tuple[int, bytes]]]]) -> None:
    """An mp4 with tracks of data; each a sample entry ("gpmd", "tx3g") and (milliseconds, bytes) samples."""
    head = _box(b"ftyp", b"isom\0\0\2\0isommp41")
    media, chunks = b"", []
    for _, samples in tracks:
        offsets = []
        for _, data in samples:
            offsets.append(len(head) + 8 + len(media))
            media += data
        chunks.append(offsets)
    length = max((sum(ms for ms, _ in samples) for _, samples in tracks), default=0)
    movie = _full(b"mvhd", struct.pack(">4I", 0, 0, 1000, length) + b"\0\1\0\0\1" + b"\0" * 75)
    boxes = [
        _track(number, entry, samples, offsets)
        for number, ((entry, samples), offsets) in enumerate(zip(tracks, chunks, strict=True), start=1)
    ]
    path.write_bytes(head + _box(b"mdat", media) + _box(b"moov", movie, *boxes))


def mov_text(text: str) -> bytes:
    """The sample of a subtitle track."""
    data = text.encode()
    return struct.pack(">H", len(data)) + data


def _box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + kind + body


def _full(kind: bytes, *parts: bytes) -> bytes:
    return _box(kind, b"\0\0\0\0", *parts)


def _track(number: int, entry: str, samples: Sequence[tuple[int, bytes]], offsets: list[int]) -> bytes:
    length = sum(ms for ms, _ in samples)
    handler = b"sbtl" if entry == "tx3g" else b"meta"
    description = b"\0" * 6 + b"\0\1"
    if entry == "tx3g":
        fonts = _box(b"ftab", b"\0\1\0\1\x05Serif")
        description += (
            b"\0" * 4 + b"\1\xff" + b"\0" * 4 + b"\0" * 8 + b"\0\0\0\0\0\1\0\x12\xff\xff\xff\xff" + fonts
        )
    table = _box(
        b"stbl",
        _full(b"stsd", struct.pack(">I", 1), _box(entry.encode(), description)),
        _full(b"stts", struct.pack(">I", len(samples)), *(struct.pack(">II", 1, ms) for ms, _ in samples)),
        _full(b"stsc", struct.pack(">4I", 1, 1, 1, 1)),
        _full(b"stsz", struct.pack(">II", 0, len(samples)), *(struct.pack(">I", len(d)) for _, d in samples)),
        _full(b"stco", struct.pack(">I", len(offsets)), *(struct.pack(">I", at) for at in offsets)),
    )
    information = _box(
        b"minf",
        _box(b"gmhd", _full(b"gmin", b"\0" * 12)),
        _box(b"dinf", _full(b"dref", struct.pack(">I", 1), _box(b"url ", b"\0\0\0\1"))),
        table,
    )
    media = _box(
        b"mdia",
        _full(b"mdhd", struct.pack(">4I", 0, 0, 1000, length), b"\x55\xc4\0\0"),
        _full(b"hdlr", b"\0\0\0\0", handler, b"\0" * 12, b"test\0"),
        information,
    )
    header = struct.pack(">5I", 0, 0, number, 0, length) + b"\0" * 60
    return _box(b"trak", _box(b"tkhd", b"\0\0\0\7", header), media)
