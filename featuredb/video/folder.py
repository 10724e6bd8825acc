"""A film as a folder of pictures, in the natural order of their names, with times from a file or a rate.

Times come from `timestamps.csv` in the folder, with a heading and at least the columns `file` and `time_s`, a
line for each picture.

Pixels come as stored, as of every other picture file: EXIF orientation is not applied.
"""

import csv
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, VideoError
from featuredb.features.decode import DecodeLimits, decode_gray, decode_rgb, probe
from featuredb.features.exif.read import ExifInfo, read_exif
from featuredb.features.shrink import fitted_size, shrunk
from featuredb.video.film import Video, VideoFrame, VideoInfo, VideoOptions, VideoReport, chosen
from featuredb.video.opening import MAX_FULL_PIXELS, MAX_FULL_SIDE_PX

_T = TypeVar("_T")
_SUFFIXES = frozenset({".jpg", ".jpeg", ".heic", ".heif", ".avif", ".png", ".webp", ".tif", ".tiff", ".bmp"})
_CSV_NAME = "timestamps.csv"
# An uncompressed TIFF of the most pixels has 400 MB.
_LIMITS = DecodeLimits(
    max_bytes=1 << 30, max_pixels=MAX_FULL_PIXELS, max_side_px=MAX_FULL_SIDE_PX, min_side_px=1
)


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key by which frame2 comes before frame10, whatever the case of its letters."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [
        (0, int(part), "") if part[0] in "0123456789" else (1, 0, part.casefold()) for part in parts
    ], name


def open_folder(folder: Path, options: VideoOptions) -> "FolderVideo":
    """Open a folder of pictures.

    Raises:
        VideoError: no pictures or no times, times that do not belong to the pictures, a broken first picture.
    """
    try:
        names = [path.name for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    except OSError as error:
        raise VideoError(f"{folder}: the folder cannot be read: {error.strerror or error}") from error
    names = sorted((name for name in names if not name.startswith(".")), key=natural_key)
    if not names:
        raise VideoError(f"{folder}: expected pictures ({', '.join(sorted(_SUFFIXES))}), found none")
    return FolderVideo(folder, _timed(folder, names, options.fps), options)


class FolderVideo(Video):
    """An open folder; made by `open_folder`.

    Args:
        timed: (time in seconds, name), in order of time.
    """

    def __init__(self, folder: Path, timed: list[tuple[float, str]], options: VideoOptions) -> None:
        self._folder, self._timed, self._options = folder, timed, options
        self._size = self._stored_size(timed[0][1])
        frame_width, frame_height = fitted_size(*self._size, options.max_side_px)
        self._report = VideoReport()
        self._closed = False
        length_s = timed[-1][0] - timed[0][0]
        rate = (len(timed) - 1) / length_s if length_s > 0 else options.fps
        told = [self._exif_of(timed[i][1]) for i in sorted({0, len(timed) // 2, len(timed) - 1})]
        self._several_cameras = len({exif.camera_key for exif in told}) > 1
        exif = ExifInfo() if self._several_cameras else told[0]
        super().__init__(
            VideoInfo(
                name=folder.name or str(folder),
                width=self._size[0],
                height=self._size[1],
                frame_width=frame_width,
                frame_height=frame_height,
                duration_s=len(timed) / rate if rate else None,
                frame_count=len(timed),
                make=exif.make or None,
                model=exif.model or None,
                camera_key=exif.camera_key,
                focal_px=exif.focal_px,
            )
        )

    @property
    def report(self) -> VideoReport:
        return replace(self._report)

    def close(self) -> None:
        self._closed = True

    def _frames(self) -> Iterator[VideoFrame]:
        for index, time_s, name in chosen(self._timed, self._options):
            if self._closed:
                raise VideoError(f"{self.info.name} is closed; read its frames inside the `with` block")
            size = self._stored_size(name)
            if size != self._size:
                raise VideoError(
                    f"{self.info.name}: {name} has {size[0]}x{size[1]} pixels, but {self._timed[0][1]} has "
                    f"{self._size[0]}x{self._size[1]}; put pictures of another size in a folder of their own"
                )
            yield self._frame(index, time_s, name)
        self._report.at_end = self._options.end_s is None

    def _frame(self, index: int, time_s: float, name: str) -> VideoFrame:
        gray = self._pixels(decode_gray, name)
        self._report.last_s = time_s
        return VideoFrame(
            index=index,
            time_s=time_s,
            gray=gray,
            rgb=lambda: self._pixels(decode_rgb, name),
            camera_key=self._exif_of(name).camera_key if self._several_cameras else "",
        )

    def _pixels(
        self, decode: Callable[[Path, DecodeLimits], NDArray[np.uint8]], name: str
    ) -> NDArray[np.uint8]:
        return shrunk(self._read(decode, name), self._options.max_side_px)

    def _stored_size(self, name: str) -> tuple[int, int]:
        header = self._read(probe, name)
        return header.width, header.height

    def _read(self, read: Callable[[Path, DecodeLimits], _T], name: str) -> _T:
        """What `read` makes of a picture's file."""
        try:
            return read(self._folder / name, _LIMITS)
        except ImageError as error:
            raise VideoError(f"{self._folder.name}: the picture {name} cannot be read: {error}") from error

    def _exif_of(self, name: str) -> ExifInfo:
        """What a picture says of its camera."""
        try:
            return read_exif((self._folder / name).read_bytes())
        except OSError:
            return ExifInfo()  # whoever comes to that picture says what is wrong with it


def _timed(folder: Path, names: list[str], fps: float | None) -> list[tuple[float, str]]:
    """(time in seconds, name) in order of time, which must be that of the names unless a table says more."""
    table = folder / _CSV_NAME
    if table.is_file():
        timed = sorted(_from_table(table, names))
    elif fps is not None:
        return [(index / fps, name) for index, name in enumerate(names)]
    else:
        raise VideoError(
            f"{folder}: expected the times of its {len(names)} pictures, found none; put a {_CSV_NAME} "
            "(columns file,time_s) beside them, or give their rate by --fps"
        )
    for (before_s, before), (time_s, name) in pairwise(timed):
        if time_s <= before_s:
            raise VideoError(
                f"{folder}: expected times that increase, found {before_s:g} s for {before} and {time_s:g} s "
                f"for {name}"
            )
    return timed


def _from_table(path: Path, names: list[str]) -> list[tuple[float, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise VideoError(f"{path}: the times cannot be read: {error}") from error
    rows = csv.DictReader(text.splitlines())
    columns = [column.strip() for column in rows.fieldnames or ()]
    rows.fieldnames = columns
    if not {"file", "time_s"} <= set(columns):
        raise VideoError(f"{path}: expected a heading with the columns file and time_s, found {columns}")
    times: dict[str, float] = {}
    for row in rows:
        name = (row["file"] or "").strip()
        if name in times:
            raise VideoError(f"{path}: line {rows.line_num}: {name} is there twice")
        told = (row["time_s"] or "").strip()
        try:
            times[name] = float(told)
        except ValueError:
            times[name] = math.nan
        if not math.isfinite(times[name]):
            raise VideoError(f"{path}: line {rows.line_num}: expected a time in seconds, found {told!r}")
    without = [name for name in names if name not in times]
    unknown = sorted(set(times) - set(names), key=natural_key)
    if without or unknown:
        raise VideoError(
            f"{path}: expected a line for each of the {len(names)} pictures; without a time: "
            f"{_some(without)}; not in the folder: {_some(unknown)}"
        )
    return [(times[name], name) for name in names]


def _some(names: list[str]) -> str:
    said = ", ".join(names[:5]) or "none"
    return said + (f" and {len(names) - 5} more" if len(names) > 5 else "")
