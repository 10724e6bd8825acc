"""Writes films: H.264 in mp4, which browsers, phones and our own reader play."""

import math
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from featuredb.atomic import atomic_file
from featuredb.errors import InvalidValueError, VideoError
from featuredb.video.film import NO_TAGS

# The ticks of films with times of their own: every usual rate is a whole number of them (29.97 Hz is 2002).
_TICKS_HZ = 60_000
_RATE_ROUNDING_HZ = 1e-3  # 23.976 and 29.97 are rounded by less
_MAX_CRF = 51


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoWriterOptions:
    """How a film is written.

    Attributes:
        crf: x264's constant rate factor, 0 (lossless) to 51.
        preset: x264's preset; slower ones make smaller files of the same quality.
        tags: text tags of the container, e.g. creation_time (ISO 8601) or com.apple.quicktime.model.
    """

    crf: int = 18  # hardly told from the original by eye
    preset: str = "medium"
    tags: Mapping[str, str] = field(default_factory=lambda: NO_TAGS)

    def __post_init__(self) -> None:
        if not 0 <= self.crf <= _MAX_CRF:
            raise InvalidValueError(f"crf: expected 0 to {_MAX_CRF}, found {self.crf}")


_DEFAULT = VideoWriterOptions()


class VideoWriter:
    """Writes one mp4; a context manager.

    The film appears under its name when the block ends well, and not at all when it ends with an error.

    Args:
        path: ends in .mp4; its folder is made, a film of that name is replaced.
        width, height: of every picture, pixels; even numbers, as 4:2:0 halves the colours.
        fps: frames per second, or None where each frame comes with its own time.

    Raises:
        InvalidValueError: another suffix, odd or empty sizes, a rate that is none.
    """

    def __init__(
        self,
        path: Path,
        *,
        width: int,
        height: int,
        fps: float | None,
        options: VideoWriterOptions = _DEFAULT,
    ) -> None:
        if path.suffix.lower() != ".mp4":
            raise InvalidValueError(f"{path}: films are written as mp4; give a name that ends in .mp4")
        if min(width, height) < 2 or width % 2 or height % 2:
            raise InvalidValueError(
                f"{path.name}: expected even sides of at least 2 pixels, found {width}x{height}; cut or "
                "fill up a row or column"
            )
        if fps is not None and not 0.0 < fps < _TICKS_HZ:
            raise InvalidValueError(
                f"{path.name}: expected a positive rate or None, found {fps} frames a second"
            )
        self.path, self.width, self.height, self.options = path, width, height, options
        self._rate = None if fps is None else _exact_rate(fps)
        self._to_yuv = VideoReformatter()
        self._opened = ExitStack()
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._last_stamp: int | None = None

    def __enter__(self) -> Self:
        try:
            with ExitStack() as opened:
                temporary = opened.enter_context(atomic_file(self.path))
                self._container = av.open(
                    str(temporary.absolute()),
                    "w",
                    format="mp4",
                    # The index in front, so that browsers begin before all has come; tags by their own names.
                    options={"movflags": "+faststart+use_metadata_tags"},
                )
                opened.callback(self._close)
                self._stream = self._added_stream(self._container)
                self._opened = opened.pop_all()
        except (av.FFmpegError, OSError, ValueError) as error:
            raise self._failed(error) from error
        return self

    def __exit__(self, *failed: Any) -> None:
        if failed[0] is not None:
            self._opened.__exit__(*failed)
            return
        try:
            with self._opened:
                self._finish()
        except (av.FFmpegError, OSError) as error:
            raise self._failed(error) from error

    def write(self, picture: NDArray[np.uint8], time_s: float | None = None) -> None:
        """Add a frame.

        Args:
            picture: (h, w, 3) uint8, red first, or (h, w) uint8 grey; of full range.
            time_s: seconds from the film's start, from 0 and increasing by at least 1/60000; given if and
                only if the writer has no fps.

        Raises:
            InvalidValueError: another shape or type, a missing, unwanted or not increasing time.
            VideoError: it cannot be encoded or written; or the writer is not open.
        """
        if self._container is None or self._stream is None:
            raise VideoError(f"{self.path.name}: the film is not open; write frames inside the `with` block")
        shapes = ((self.height, self.width), (self.height, self.width, 3))
        if picture.dtype != np.uint8 or picture.shape not in shapes:
            raise InvalidValueError(
                f"{self.path.name}: expected pictures {shapes[0]} or {shapes[1]} of uint8, found "
                f"{picture.shape} of {picture.dtype}"
            )
        stamp = self._stamp(time_s)
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture), format="gray" if picture.ndim == 2 else "rgb24"
        )
        try:
            yuv = self._to_yuv.reformat(
                frame,
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                threads=1,
            )
            yuv.pts, yuv.time_base = stamp, self._time_base
            self._container.mux(self._stream.encode(yuv))
        except (av.FFmpegError, OSError) as error:
            raise self._failed(error) from error
        self._last_stamp = stamp

    @property
    def _time_base(self) -> Fraction:
        return Fraction(1, _TICKS_HZ) if self._rate is None else 1 / self._rate

    def _stamp(self, time_s: float | None) -> int:
        if (time_s is None) != (self._rate is not None):
            wanted = "a time for each frame" if self._rate is None else "no times, as there is a rate"
            raise InvalidValueError(f"{self.path.name}: expected {wanted}, found {time_s}")
        if time_s is None:
            return 0 if self._last_stamp is None else self._last_stamp + 1
        if not math.isfinite(time_s) or time_s < 0:
            raise InvalidValueError(f"{self.path.name}: expected a time from 0, found {time_s}")
        stamp = round(time_s * _TICKS_HZ)
        if self._last_stamp is not None and stamp <= self._last_stamp:
            last_s = self._last_stamp / _TICKS_HZ
            raise InvalidValueError(
                f"{self.path.name}: expected a time after {last_s:.6f} s, found {time_s:.6f} s"
            )
        return stamp

    def _added_stream(self, container: OutputContainer) -> VideoStream:
        container.metadata.update(self.options.tags)
        stream = container.add_stream("libx264", rate=self._rate or 30)
        stream.width, stream.height, stream.pix_fmt = self.width, self.height, "yuv420p"
        context = stream.codec_context
        context.time_base = self._time_base
        context.thread_count = 1  # so that the same frames give the same bytes
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        # x264's macroblock tree reads memory that it has not set (seen with core 165, most often with small
        # pictures): without it the same frames give the same bytes.
        given = {"crf": str(self.options.crf), "preset": self.options.preset, "x264-params": "mbtree=0"}
        if self._rate is None:
            # With frames reordered, uneven times make an mp4 too short: its length is of decoding times.
            given["bf"] = "0"
        context.options = given
        return stream

    def _finish(self) -> None:
        container, stream = self._container, self._stream
        if container is None or stream is None or self._last_stamp is None:
            raise VideoError(f"{self.path}: expected at least one frame, found none; no film was written")
        container.mux(stream.encode(None))
        container.close()
        self._container = None

    def _close(self) -> None:
        """What is open still; what goes wrong here follows from what went wrong before."""
        if self._container is not None:
            with suppress(av.FFmpegError, OSError):
                self._container.close()
        self._container = None

    def _failed(self, error: Exception) -> VideoError:
        reason = getattr(error, "strerror", None) or str(error)
        return VideoError(f"{self.path}: the film cannot be written: {reason}")


def _exact_rate(fps: float) -> Fraction:
    """The rate that a rounded number means: 29.97 is 30000/1001."""
    television = Fraction(round(fps * 1.001) * 1000, 1001)
    if television and abs(fps - television) < _RATE_ROUNDING_HZ:
        return television
    return Fraction(fps).limit_denominator(1001)
