"""Folders of photos for studies: copies of them, with other positions or none."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image

from featuredb.features.exif.write import EXIF_PREFIX, gps_directory, with_app1, with_gps
from featuredb.features.image_header import read_header
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray

_SUFFIXES = (".jpg", ".jpeg", ".png")
_GPS_IFD = 34853


def photo_names(folder: Path) -> list[str]:
    """Names of the photos of a folder, sorted."""
    return sorted(p.name for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES)


def position_table(folder: Path, rows: Iterable[tuple[object, ...]]) -> Path:
    """A table beside photos: name, latitude, longitude (degrees), height, and both accuracies (m)."""
    lines = ["path,lat,lon,height,accuracy,accuracy_height", *(",".join(map(str, row)) for row in rows)]
    table = folder / "table.csv"
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return table


def copied(folder: Path, names: Sequence[str], target: Path, *, strip: bool) -> Path:
    """Copies of photos, without positions where `strip` says so; the pictures stay bit for bit."""
    target.mkdir(parents=True, exist_ok=True)
    for name in names:
        data = (folder / name).read_bytes()
        (target / name).write_bytes(without_position(data) if strip else data)
    return target


def with_place(
    jpeg: bytes,
    frame: LocalFrame,
    place: FloatArray,
    error_m: float | None,
    xmp: bytes = b"",
    *datum: str,
    **more: float,
) -> bytes:
    """A JPEG with another position (3,) in its EXIF, and other XMP; `datum`, `more`: as `gps_directory` has
    them. The picture stays as it was."""
    latitude, longitude, height = (float(v) for v in frame.geodetic_from_enu(place))
    gps = gps_directory((latitude, longitude, height), *datum, error_m=error_m, **more)
    return with_app1(jpeg, with_gps(jpeg[slice(*read_header(jpeg).exif)], gps), xmp)


def without_position(jpeg: bytes) -> bytes:
    """A JPEG without the GPS directory of its EXIF and with empty XMP; the picture as it was."""
    with Image.open(io.BytesIO(jpeg)) as image:
        exif = image.getexif()
    exif.pop(_GPS_IFD, None)
    return with_app1(jpeg, exif.tobytes().removeprefix(EXIF_PREFIX), b"")
