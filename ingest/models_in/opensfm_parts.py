"""Observations of OpenSfM's `tracks.csv`, and its lenses as this system's.

Reference: OpenSfM, doc/source/geometry.rst. Lengths are over the longer side of the image, the principal
point counts from its middle; `featuredb.export.formats.opensfm_camera` is the way back.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError, InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.models_in.json_values import member, number

_HEADER = "OPENSFM_TRACKS_VERSION_v"
_COLUMNS = {"1": 9, "2": 11}  # version 2 adds segmentation and instance
_LONGEST_LINE = 8192
_MOST = 0.5 + 1e-9  # normalised coordinates count from the middle of the image, over its longer side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpensfmTracks:
    """Observations of the images and tracks that were asked for, in the order of the file.

    Attributes:
        image, track: (m,) int64, rows of what was asked for.
        xy: (m, 2) normalised. scale: (m,) of the feature, over the image's longer side, > 0.
    """

    image: NDArray[np.int64]
    track: NDArray[np.int64]
    xy: FloatArray
    scale: FloatArray


def read_tracks(path: Path, image_row: Mapping[str, int], track_row: Mapping[str, int]) -> OpensfmTracks:
    """The observations of these images that see these tracks; others are no part of the reconstruction.

    Raises:
        IngestError: not such a file, of a version without scales, or broken: a line of other columns, a value
            that is no number, or cannot be.
    """
    images: list[int] = []
    tracks: list[int] = []
    values: list[tuple[float, float, float]] = []
    try:
        with path.open(encoding="utf-8") as file:
            lines = iter(lambda: file.readline(_LONGEST_LINE), "")
            columns = _columns(next(lines, ""), path)
            for image, track, value in _rows(lines, columns, path):
                if image in image_row and track in track_row:
                    images.append(image_row[image])
                    tracks.append(track_row[track])
                    values.append(value)
    except (OSError, UnicodeDecodeError) as error:
        raise IngestError(f"{path}: expected OpenSfM's tracks, cannot be read: {error}") from error
    table = np.array(values, dtype=np.float64).reshape(-1, 3)
    return OpensfmTracks(
        image=np.array(images, dtype=np.int64),
        track=np.array(tracks, dtype=np.int64),
        xy=table[:, :2],
        scale=table[:, 2],
    )


def _columns(header: str, path: Path) -> int:
    version = header.strip().removeprefix(_HEADER)
    if not header.startswith(_HEADER) or version not in _COLUMNS:
        raise IngestError(
            f"{path}: expected {_HEADER}1 or {_HEADER}2 in the first line, found {header[:60].strip()!r}: "
            "other versions have no scales to describe keypoints by; create the tracks by a newer OpenSfM"
        )
    return _COLUMNS[version]


def _rows(
    lines: Iterator[str], columns: int, path: Path
) -> Iterator[tuple[str, str, tuple[float, float, float]]]:
    """Image, track and x, y, scale of each line, checked."""
    for row, line in zip(count(2), lines, strict=False):
        parts = line.rstrip("\r\n").split("\t")
        if len(parts) != columns:
            raise IngestError(
                f"{path}, line {row}: expected {columns} columns, found {len(parts)}: the file is cut "
                "off or broken; copy or export it again"
            )
        image, track, feature = parts[:3]
        if not (track.isdecimal() and feature.isdecimal()):
            raise IngestError(
                f"{path}, line {row}: expected the numbers of a track and a feature, from 0, found "
                f"{track[:40]!r} and {feature[:40]!r}; export the tracks again"
            )
        try:
            x, y, scale = (float(part) for part in parts[3:6])
        except ValueError:
            x = y = scale = math.nan
        if not (abs(x) <= _MOST and abs(y) <= _MOST and 0.0 < scale <= 1.0):  # false for NaN too
            raise IngestError(
                f"{path}, line {row}: expected x and y within -0.5 and 0.5 and a scale in (0, 1], over "
                f"the longer side of the image, found {', '.join(p[:40] for p in parts[3:6])}; export the "
                "tracks again"
            )
        yield image, track, (x, y, scale)


_ONE_FOCAL = ("perspective", "fisheye")
_TWO_FOCALS = ("brown", "radial", "simple_radial", "fisheye_opencv")


def camera_from_opensfm(entry: Mapping[str, Any], where: str) -> Camera:
    """An entry of `cameras` in reconstruction.json.

    Raises:
        IngestError: values that are missing or cannot be, or a lens that maps do not have.
    """
    kind = entry.get("projection_type", "perspective")
    if kind not in (*_ONE_FOCAL, *_TWO_FOCALS):
        raise IngestError(
            f"{where}: expected a lens of {', '.join((*_ONE_FOCAL, *_TWO_FOCALS))}, found {kind!r}; "
            "undistort the images to a simpler camera first"
        )
    width, height = (number(member(entry, name, where), f"{where}, {name}") for name in ("width", "height"))
    size = max(width, height)

    def given(name: str) -> float:
        return number(entry.get(name, 0.0), f"{where}, {name}")

    def required(name: str) -> float:
        return number(member(entry, name, where), f"{where}, {name}")

    k = [given(f"k{i}") for i in range(1, 5)]
    if kind in _ONE_FOCAL:
        focal = required("focal") * size
        model = "RADIAL" if kind == "perspective" else "RADIAL_FISHEYE"
        return _camera(model, width, height, (focal, width / 2.0, height / 2.0, k[0], k[1]), where)
    pinhole = (
        required("focal_x") * size,
        required("focal_y") * size,
        given("c_x") * size + width / 2.0,
        given("c_y") * size + height / 2.0,
    )
    if kind == "fisheye_opencv":
        return _camera("OPENCV_FISHEYE", width, height, (*pinhole, *k), where)
    lens = (*pinhole, k[0], k[1], given("p1"), given("p2"))
    if k[2]:
        return _camera("FULL_OPENCV", width, height, (*lens, k[2], 0.0, 0.0, 0.0), where)
    return _camera("OPENCV", width, height, lens, where)


def _camera(model: str, width: float, height: float, params: tuple[float, ...], where: str) -> Camera:
    try:
        if width != int(width) or height != int(height):
            raise InvalidValueError(f"expected whole pixels, found {width}x{height}")
        return Camera(model=model, width=int(width), height=int(height), params=params)
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}; export the model again") from error
