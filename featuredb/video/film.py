"""What a film is to its readers: its facts, its frames, how it is read, and what reading it came to."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from types import MappingProxyType
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError, VideoError

_T = TypeVar("_T")
NO_TAGS: Mapping[str, str] = MappingProxyType({})
# Below this a film that ends before its stated length only rounds, or its sound is a little longer.
_SHORT_END_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoOptions:
    """How a film is read.

    Attributes:
        start_s, end_s: only frames with start_s <= time_s < end_s; None for the film's own start and end.
        max_side_px: frames are made smaller so that no side is longer; None for full size.
        fps: frames per second of a folder that has no file of times.
    """

    start_s: float | None = None
    end_s: float | None = None
    max_side_px: int | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        side = self.max_side_px
        if side is not None and (not isinstance(side, int) or side < 1):
            raise InvalidValueError(f"max_side_px: expected a whole number of at least 1, found {side!r}")
        if self.fps is not None and not 0.0 < self.fps < math.inf:
            raise InvalidValueError(f"fps: expected a positive number, found {self.fps!r}")
        bounds = [value for value in (self.start_s, self.end_s) if value is not None]
        if not all(math.isfinite(value) for value in bounds) or (len(bounds) == 2 and bounds[0] >= bounds[1]):
            raise InvalidValueError(
                f"expected a start before the end, in seconds, found start {self.start_s}, end {self.end_s}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """What is known of a film before its frames are read.

    Attributes:
        name: the file's or folder's name, or the URL without its password; for messages.
        width, height: pixels at full size, upright, that is after rotation.
        frame_width, frame_height: pixels of the frames that are delivered; less where max_side_px says so.
        rotation_deg: 0, 90, 180 or 270 degrees by which the stored pictures were turned clockwise.
        duration_s: stated length, or None for live sources and files that do not say.
        frame_count: number of frames that the file's index lists, or None.
        creation_time: when the recording was started by the camera's clock, or None. Said to be UTC, but
            many action cameras write their local time.
        camera_key: by which maps know the lens (featuredb.features.exif), "" where the camera is not named.
        focal_px: by EXIF of a folder's pictures, for the full size; None: not said.
        live: whether the source cannot be read twice or sought in: URLs, devices, pipes.
    """

    name: str
    width: int
    height: int
    frame_width: int
    frame_height: int
    rotation_deg: int = 0
    duration_s: float | None = None
    frame_count: int | None = None
    creation_time: datetime | None = None
    make: str | None = None
    model: str | None = None
    camera_key: str = ""
    focal_px: float | None = None
    live: bool = False

    def no_frames(self) -> VideoError:
        """Of a stretch in which there are none."""
        length = "" if self.duration_s is None else f"; the film is {self.duration_s:.1f} s long"
        return VideoError(f"{self.name}: no frame between the start and the end that were asked for{length}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VideoFrame:
    """One frame, upright.

    Attributes:
        index: 0 for the first frame at or after the start that was asked for, and counting all frames from
            there that could be decoded.
        time_s: seconds on the film's own clock, from the frame's own time stamp.
        gray: (h, w) uint8, 0 black to 255 white, read-only.
        rgb: makes the colours (h, w, 3) uint8, red first, anew at each call, from one thread at a time.
            Raises VideoError where the picture's format cannot be converted, or its file is no longer there.
            Holds on to the decoded picture (1.5 bytes a pixel at full size).
        camera_key: of a picture in a folder of several cameras; "" where the film's own holds.
    """

    index: int
    time_s: float
    gray: NDArray[np.uint8]
    rgb: Callable[[], NDArray[np.uint8]] = field(repr=False)
    camera_key: str = ""

    def __post_init__(self) -> None:
        if self.gray.ndim != 2 or self.gray.dtype != np.uint8 or not self.gray.size:
            raise InvalidValueError(
                f"gray: expected an array (h, w) of uint8, found {self.gray.shape} of {self.gray.dtype}"
            )
        if self.index < 0 or not math.isfinite(self.time_s):
            raise InvalidValueError(
                f"expected an index from 0 and a finite time, found {self.index}, {self.time_s}"
            )
        self.gray.setflags(write=False)


@dataclass(slots=True, kw_only=True)
class VideoReport:
    """What reading a film has come to so far; counted up by its reader, who gives copies away.

    Attributes:
        undecodable: packets (each a frame) that could not be decoded, or are only there in part.
        damaged: frames that were handed out although parts of them are made up.
        out_of_order: frames that were dropped because their time is not after that of the frame before.
        times_guessed: frames without a time, which were given the next one at the nominal rate.
        packets: of the film that were read, whole or not.
        missing: frames that the file's index lists but that are not there; known at the end of whole films.
        short_by_s: how much earlier than the stated length the last frame ends; known at the end, where
            it is more than rounding; sound that runs on counts as length, too.
    """

    undecodable: int = 0
    damaged: int = 0
    out_of_order: int = 0
    times_guessed: int = 0
    last_s: float | None = None
    at_end: bool = False
    packets: int = 0
    missing: int = 0
    short_by_s: float = 0.0

    def complaints(self) -> tuple[str, ...]:
        """What is wrong with the film, in words; nothing where it is whole."""
        said = (
            (self.undecodable, f"{self.undecodable} packets cannot be decoded"),
            (self.damaged, f"{self.damaged} frames are damaged"),
            (self.missing, f"{self.missing} frames of the file's index are missing: it is cut off"),
            (
                self.short_by_s > _SHORT_END_S,
                f"the pictures end {self.short_by_s:.1f} s before the film's stated end",
            ),
            (self.out_of_order, f"{self.out_of_order} frames go back in time and were dropped"),
            (self.times_guessed, f"{self.times_guessed} frames have no time and were given one"),
        )
        return tuple(text for found, text in said if found)


def chosen(timed: Iterable[tuple[float, _T]], options: VideoOptions) -> Iterator[tuple[int, float, _T]]:
    """Those of (time in seconds, something), in order of time, that the options ask for, with their index."""
    index = 0
    for time_s, item in timed:
        if options.start_s is not None and time_s < options.start_s:
            continue
        if options.end_s is not None and time_s >= options.end_s:
            return
        yield index, time_s, item
        index += 1


class Video(ABC):
    """An open film: its facts, its frames once from start to end, and what reading came to.

    A context manager; to be used from one thread. Frames hold decoder memory for their colours until they are
    let go; nothing else grows while a film is read.
    """

    def __init__(self, info: VideoInfo) -> None:
        self.info = info
        self._iterated = False

    @property
    @abstractmethod
    def report(self) -> VideoReport:
        """What reading has come to so far; its last word after the last frame."""

    @abstractmethod
    def close(self) -> None:
        """Let the source go; frames that were read keep their pixels."""

    @abstractmethod
    def _frames(self) -> Iterator[VideoFrame]:
        """The frames that the options ask for."""

    def __iter__(self) -> Iterator[VideoFrame]:
        """Frames in display order, with times that increase.

        Raises:
            VideoError: the source breaks, changes its size or rotation, or was closed.
            InvalidValueError: the film was iterated before.
        """
        if self._iterated:
            raise InvalidValueError(f"{self.info.name}: a film is read once; open it again to read it again")
        self._iterated = True
        return self._frames()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self.close()
