"""Observations of OpenSfM's `tracks.csv`: image, track, feature, x, y, scale, colour; tab-separated."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError
from featuredb.geometry.arrays import FloatArray

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
    for number, line in zip(count(2), lines, strict=False):
        parts = line.rstrip("\r\n").split("\t")
        if len(parts) != columns:
            raise IngestError(
                f"{path}, line {number}: expected {columns} columns, found {len(parts)}: the file is cut "
                "off or broken; copy or export it again"
            )
        image, track, feature = parts[:3]
        if not (track.isdecimal() and feature.isdecimal()):
            raise IngestError(
                f"{path}, line {number}: expected the numbers of a track and a feature, from 0, found "
                f"{track[:40]!r} and {feature[:40]!r}; export the tracks again"
            )
        try:
            x, y, scale = (float(part) for part in parts[3:6])
        except ValueError:
            x = y = scale = math.nan
        if not (abs(x) <= _MOST and abs(y) <= _MOST and 0.0 < scale <= 1.0):  # false for NaN too
            raise IngestError(
                f"{path}, line {number}: expected x and y within -0.5 and 0.5 and a scale in (0, 1], over "
                f"the longer side of the image, found {', '.join(p[:40] for p in parts[3:6])}; export the "
                "tracks again"
            )
        yield image, track, (x, y, scale)
