"""LAS 1.0 to 1.4, LAZ and COPC files: what the header says, and the points by chunks. The home of laspy.

A file is read as a stream, so its size does not matter. Whatever is wrong with it becomes a `ScanFileError`
that names the file: what was expected, what was found, what to do.
"""

import logging
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import file_sha256
from featuredb.errors import ScanFileError
from featuredb.extras import require
from featuredb.geo.crs.geotiff_keys import GeoKeys
from featuredb.geometry.arrays import FloatArray

NOISE_CLASSES = (7, 18)  # ASPRS: low noise, high noise
UNCLASSIFIED = 1
_WKT_RECORD, _KEYS_RECORD = 2112, 34735
_SHORTEST_HEADER, _HEADER_1_4 = 227, 375
_RECORD_HEADER, _EXTENDED_RECORD_HEADER = 54, 60  # bytes of a VLR and an EVLR without their data
# The longest coordinate that any CRS in metres or feet has, generously; beyond it scale or offset are broken.
LONGEST_COORDINATE = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanFile:
    """What a file says before its points are read.

    Attributes:
        points: number of points by the header.
        low, high: (3,) box in file coordinates, by the header or, where that is wrong, by the points.
        wkt: the WKT record, or None.
        geo_keys: GeoTIFF keys, or None.
        wkt_counts: the header says that the WKT is the CRS and not the keys.
    """

    path: Path
    sha256: str
    size_bytes: int
    points: int
    low: FloatArray
    high: FloatArray
    wkt: str | None
    geo_keys: GeoKeys | None
    wkt_counts: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RawPoints:
    """Some points as the file has them.

    Attributes:
        xyz: (n, 3) float64, file coordinates.
        rgb: (n, 3) uint16, or None.
        intensity: (n,) uint16.
        classification: (n,) uint8; 0, "never classified", is given as 1, "unclassified".
        withheld: (n,) bool, marked by the file's writer as not to be used.
    """

    xyz: FloatArray
    rgb: NDArray[np.uint16] | None
    intensity: NDArray[np.uint16]
    classification: NDArray[np.uint8]
    withheld: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.xyz)


def open_scan_file(path: Path) -> ScanFile:
    """Read a file's header, check it, and take its SHA-256.

    Raises:
        ScanFileError: no such file, not LAS or LAZ, no points, truncated, or a header that contradicts
            itself.
        MissingExtraError: laspy is not installed.
    """
    if path.is_dir():
        inside = sorted(
            p.name for p in path.iterdir() if p.suffix.lower() in (".las", ".laz", ".tif", ".tiff")
        )
        what = f"name those in it, such as {inside[0]}" if inside else "it has no .las, .laz or .tif"
        raise ScanFileError(f"{path}: expected a LAS, LAZ or COPC file, found a folder; {what}")
    if not path.is_file():
        raise ScanFileError(f"{path}: expected a LAS, LAZ or COPC file, found none; check the path")
    size = path.stat().st_size
    _check_magic(path, size)
    with _reading(path), import_laspy().open(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise ScanFileError(f"{path}: expected points, found a header that says 0; the scan is empty")
        _check_header(path, header, size)
        wkt, keys = _crs_records(header)
        low, high = np.array(header.mins, np.float64), np.array(header.maxs, np.float64)
        first = _raw_points(reader.read_points(min(int(header.point_count), 10_000)))
        points, wkt_counts = int(header.point_count), bool(header.global_encoding.wkt)
    slack = 1e-6 * (1.0 + np.abs(np.concatenate([low, high])).max())
    if not (
        np.isfinite([low, high]).all()
        and (low <= high).all()
        and (first.xyz >= low - slack).all()
        and (first.xyz <= high + slack).all()
    ):
        _, low, high = measured(read_points(path, 1_000_000))
    return ScanFile(
        path=path,
        sha256=file_sha256(path),
        size_bytes=size,
        points=points,
        low=low,
        high=high,
        wkt=wkt,
        geo_keys=keys,
        wkt_counts=wkt_counts,
    )


def read_points(path: Path, chunk_points: int) -> Iterator[RawPoints]:
    """The points of a file in its own order, at most `chunk_points` at a time.

    Raises:
        ScanFileError: the file ends before the header's number of points, or is broken.
    """
    found = 0
    with _reading(path), import_laspy().open(path) as reader:
        expected = int(reader.header.point_count)
        for chunk in reader.chunk_iterator(chunk_points):
            points = _raw_points(chunk)
            if len(points) and not (np.abs(points.xyz) < LONGEST_COORDINATE).all():
                raise ScanFileError(
                    f"{path}: expected coordinates below 1e9, found others after point {found}; "
                    "the file is broken"
                )
            found += len(points)
            yield points
    if found != expected:
        raise ScanFileError(
            f"{path}: expected {expected} points by the header, found {found}; the file is truncated, "
            "fetch it again"
        )


def import_laspy(purpose: str = "Reading scans") -> ModuleType:
    """The package laspy.

    Raises:
        MissingExtraError: it is not installed.
    """
    require("lidar", purpose, "laspy", "lazrs")
    import laspy

    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs what it raises as well
    module: ModuleType = laspy
    return module


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of laspy, lazrs and the system as ScanFileError."""
    import_laspy()
    import lazrs
    from laspy.errors import LaspyException

    try:
        yield
    except ScanFileError:
        raise
    except (
        LaspyException, lazrs.LazrsError, OSError, EOFError, ValueError, TypeError, KeyError, IndexError,
        AttributeError, OverflowError, MemoryError, RuntimeError, struct.error,
    ) as error:  # fmt: skip
        raise ScanFileError(
            f"{path}: expected a readable LAS, LAZ or COPC file, found one that is truncated or broken "
            f"({type(error).__name__}: {' '.join(str(error).split())[:200]}); fetch it again"
        ) from error


def _check_magic(path: Path, size: int) -> None:
    if size == 0:
        raise ScanFileError(f"{path}: expected a LAS, LAZ or COPC file, found an empty file; fetch it again")
    with path.open("rb") as stream:
        start = stream.read(_HEADER_1_4)
    if start[:4] != b"LASF":
        raise ScanFileError(
            f"{path}: expected a LAS, LAZ or COPC file, which begins with 'LASF', found {start[:4]!r}; "
            "convert it, e.g. with PDAL"
        )
    if len(start) < _SHORTEST_HEADER:
        raise ScanFileError(
            f"{path}: expected a header of at least {_SHORTEST_HEADER} bytes, found {len(start)}; "
            "the file is truncated"
        )
    _check_record_counts(path, start, size)


def _check_record_counts(path: Path, start: bytes, size: int) -> None:
    """Records that the header counts must have room in the file, or reading them would not end."""
    header_size, points_at, records = struct.unpack_from("<HII", start, 94)
    if header_size + records * _RECORD_HEADER > points_at or points_at > size:
        raise ScanFileError(
            f"{path}: expected {records} records between byte {header_size} and the points at "
            f"byte {points_at} of {size}; the header is broken or the file truncated, fetch it again"
        )
    if start[24:26] == b"\x01\x04" and len(start) >= _HEADER_1_4:
        extended_at, extended = struct.unpack_from("<QI", start, 235)
        if extended and extended_at + extended * _EXTENDED_RECORD_HEADER > size:
            raise ScanFileError(
                f"{path}: expected {extended} extended records from byte {extended_at} on, found a file "
                f"of {size} bytes; the file is truncated, fetch it again"
            )


def _check_header(path: Path, header: Any, size: int) -> None:
    version = (header.version.major, header.version.minor)
    if not (1, 0) <= version <= (1, 4):
        raise ScanFileError(f"{path}: expected LAS 1.0 to 1.4, found {header.version}; convert it")
    scales, offsets = np.array(header.scales), np.array(header.offsets)
    if not (np.isfinite([scales, offsets]).all() and (scales > 0).all()):
        raise ScanFileError(
            f"{path}: expected positive scales and finite offsets, found {scales.tolist()} and "
            f"{offsets.tolist()}; the header is broken"
        )
    if not header.are_points_compressed:
        needed = header.offset_to_point_data + header.point_count * header.point_format.size
        if size < needed:
            raise ScanFileError(
                f"{path}: expected {needed} bytes for {header.point_count} points, found {size}; the file is "
                "truncated, fetch it again"
            )


def _crs_records(header: Any) -> tuple[str | None, GeoKeys | None]:
    """The WKT and the GeoTIFF keys of a file."""
    wkt, keys, text = None, None, ""
    doubles: tuple[float, ...] = ()
    for vlr in [*header.vlrs, *(header.evlrs or [])]:
        if vlr.user_id != "LASF_Projection":
            continue
        if vlr.record_id == _WKT_RECORD and hasattr(vlr, "string"):
            wkt = str(vlr.string).strip("\x00 \n\r\t") or None
        elif vlr.record_id == _KEYS_RECORD:
            keys = list(getattr(vlr, "geo_keys", []))
        elif vlr.record_id == _KEYS_RECORD + 1:
            data = vlr.record_data_bytes()
            doubles = tuple(np.frombuffer(data[: len(data) // 8 * 8], "<f8").tolist())
        elif vlr.record_id == _KEYS_RECORD + 2:
            text = vlr.record_data_bytes().decode("latin-1")
    return wkt, None if keys is None else _key_values(keys, doubles, text)


def _key_values(keys: list[Any], doubles: tuple[float, ...], text: str) -> GeoKeys:
    values: dict[int, int | float | str] = {}
    for key in keys:
        start, count = int(key.value_offset), int(key.count)
        if key.id == 0 or key.id in values:
            continue
        if key.tiff_tag_location == 0:
            values[int(key.id)] = start
        elif key.tiff_tag_location == _KEYS_RECORD + 1 and count == 1 and start < len(doubles):
            values[int(key.id)] = doubles[start]
        elif key.tiff_tag_location == _KEYS_RECORD + 2:
            values[int(key.id)] = text[start : start + count].strip("|\x00 ")
    return values


def _raw_points(points: Any) -> RawPoints:
    names = set(points.point_format.dimension_names)
    classification = np.array(points["classification"], dtype=np.uint8)
    classification[classification == 0] = UNCLASSIFIED
    rgb = None
    if {"red", "green", "blue"} <= names:
        rgb = np.stack([np.asarray(points[name], np.uint16) for name in ("red", "green", "blue")], axis=1)
    return RawPoints(
        xyz=np.stack([np.asarray(points[name], np.float64) for name in "xyz"], axis=1),
        rgb=rgb,
        intensity=np.array(points["intensity"], dtype=np.uint16),
        classification=classification,
        withheld=np.asarray(points["withheld"]).astype(bool),
    )


def measured(chunks: Iterable[RawPoints]) -> tuple[int, FloatArray, FloatArray]:
    """How many points there are, and the corners (3,) of their box; infinite without any."""
    count, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
    for points in chunks:
        count += len(points)
        low = np.minimum(low, points.xyz.min(axis=0, initial=np.inf))
        high = np.maximum(high, points.xyz.max(axis=0, initial=-np.inf))
    return count, low, high
