"""Frames of a film, a folder of pictures, a network stream or a camera, with their times, by one function.

with open_video("flight.mp4", VideoOptions(max_side_px=1600)) as video:
    for frame in video:
        track(frame.gray, frame.time_s)
print(video.report.complaints())
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from numpy.typing import NDArray

from featuredb.errors import VideoError
from featuredb.features.shrink import fitted_size
from featuredb.video.film import Video, VideoFrame, VideoInfo, VideoOptions, VideoReport, chosen
from featuredb.video.folder import open_folder
from featuredb.video.opening import (
    MAX_CODED_PIXELS,
    Decoder,
    Opening,
    Source,
    check_size,
    is_indexed,
    nominal_rate,
    open_input,
    opening_of,
)
from featuredb.video.pixels import PixelReader, clockwise_from_display_matrix

logger = logging.getLogger(__name__)

# An index goes by decoding time, which runs ahead of display by some frames: aim a little before the start.
_SEEK_MARGINS_S = (1.0, 10.0)
# Phones, QuickTime's own atoms, and what libav makes of them; the most specific first.
_MAKE = ("com.apple.quicktime.make", "com.android.manufacturer", "make", "manufacturer")
_MODEL = ("com.apple.quicktime.model", "com.android.model", "model")
# The first survives trimming and export on a phone, and names its time zone.
_CREATION = ("com.apple.quicktime.creationdate", "creation_time", "date")
# Action cameras and drones name themselves only in what they call their stream.
_MAKER_WORDS = {"gopro": "GoPro", "dji": "DJI", "insta360": "Insta360"}
_STREAM_NAMES = ("encoder", "handler_name", "comment")


def open_container(source: Source, options: VideoOptions) -> "ContainerVideo":
    """Open a film and decode its first frame.

    Raises:
        VideoError: it cannot be opened, holds no video that can be decoded, or is of a size or rotation that
            is not taken.
    """
    opening = opening_of(source)
    container = open_input(opening)
    try:
        return _opened(container, opening, options)
    except BaseException:
        container.close()
        raise


def _opened(container: InputContainer, opening: Opening, options: VideoOptions) -> "ContainerVideo":
    stream = _largest_stream(container, opening.name)
    check_size(opening.name, stream.width, stream.height)
    context = stream.codec_context
    # One thread leaves the other cores to the caller, who has more to do, and loses the least of a damaged
    # film: each further one may lose another frame, and delays a live source by a frame.
    context.thread_count = 1
    context.options = {"max_pixels": str(MAX_CODED_PIXELS)}
    tally = VideoReport()
    decoder = Decoder(container, stream, tally, opening.name)
    pictures = decoder.pictures()
    first = next(pictures, None)
    if first is None:
        broken = f"; {tally.undecodable} packets could not be decoded" if tally.undecodable else ""
        raise VideoError(
            f"{opening.name}: no frame of its {stream.codec_context.name} video can be decoded{broken}"
        )
    check_size(opening.name, first[1].width, first[1].height)
    return ContainerVideo(
        info=_info(container, stream, first[1], opening, options),
        container=container,
        decoder=decoder,
        begun=(first, pictures),
        tally=tally,
        expected=_expected(container, stream, first[0]),
        options=options,
    )


class ContainerVideo(Video):
    """An open container whose first frame is decoded; made by `open_container`.

    Args:
        begun: the first frame with its time, and the frames after it.
        expected: number of packets and time of the last frame if the film is whole; None where not known.
    """

    def __init__(
        self,
        *,
        info: VideoInfo,
        container: InputContainer,
        decoder: Decoder,
        begun: tuple[tuple[float, av.VideoFrame], Iterator[tuple[float, av.VideoFrame]]],
        tally: VideoReport,
        expected: tuple[int | None, float | None],
        options: VideoOptions,
    ) -> None:
        super().__init__(info)
        self._container, self._decoder, self._begun = container, decoder, begun
        self._tally, self._expected, self._options = tally, expected, options
        turned = info.rotation_deg in (90, 270)
        size = (info.frame_height, info.frame_width) if turned else (info.frame_width, info.frame_height)
        self._pixels = PixelReader(width=size[0], height=size[1], clockwise_deg=info.rotation_deg)
        picture = begun[0][1]
        self._stored = (picture.width, picture.height, picture.rotation)

    @property
    def report(self) -> VideoReport:
        tally, (packets, end_s) = self._tally, self._expected
        missing, short_by_s = 0, 0.0
        if tally.at_end and packets is not None and self._options.start_s is None:
            missing = max(0, packets - tally.packets)
        if tally.at_end and end_s is not None and tally.last_s is not None:
            short_by_s = max(0.0, end_s - tally.last_s)
        return replace(tally, missing=missing, short_by_s=short_by_s)

    def close(self) -> None:
        self._decoder.stop()
        self._container.close()

    def _frames(self) -> Iterator[VideoFrame]:
        for index, time_s, picture in chosen(self._from_start(), self._options):
            yield self._frame(index, time_s, picture)
        complaints = self.report.complaints()
        if complaints:
            logger.warning("%s: %s", self.info.name, "; ".join(complaints))

    def _from_start(self) -> Iterator[tuple[float, av.VideoFrame]]:
        """Decoded frames with their times, from at or before the asked start."""
        self._decoder.check_open()
        (first_s, first), following = self._begun
        start_s = self._options.start_s
        moved = False
        if start_s is not None and start_s > first_s and not self.info.live and is_indexed(self._container):
            for aim_s in (*(start_s - margin for margin in _SEEK_MARGINS_S), first_s):
                if not self._decoder.seek(max(aim_s, first_s)):
                    continue
                moved = True
                pictures = self._decoder.pictures()
                found = next(pictures, None)
                if found is not None and (found[0] <= start_s or aim_s == first_s):
                    yield found
                    yield from pictures
                    return
        if moved:
            raise VideoError(
                f"{self.info.name}: its index is broken and finds no frame; read it without start_s"
            )
        yield first_s, first
        yield from following

    def _frame(self, index: int, time_s: float, picture: av.VideoFrame) -> VideoFrame:
        stored = (picture.width, picture.height, picture.rotation)
        if stored != self._stored:
            raise VideoError(
                f"{self.info.name}: at {time_s:.3f} s the pictures change from {_said(self._stored)} to "
                f"{_said(stored)}; split the film there, as each part needs a camera of its own"
            )
        gray = _converted(self._pixels.gray, picture, self.info.name)
        self._tally.damaged += picture.is_corrupt
        name, rgb = self.info.name, self._pixels.rgb  # and not the whole film, which frames may outlive
        return VideoFrame(index=index, time_s=time_s, gray=gray, rgb=lambda: _converted(rgb, picture, name))


def _converted(
    convert: Callable[[av.VideoFrame], NDArray[np.uint8]], picture: av.VideoFrame, name: str
) -> NDArray[np.uint8]:
    try:
        return convert(picture)
    except av.FFmpegError as error:
        raise VideoError(
            f"{name}: pictures of the format {picture.format.name}, colour space {picture.colorspace}, "
            "cannot be converted; encode the film again as yuv420p"
        ) from error


def _said(stored: tuple[int, int, int]) -> str:
    return f"{stored[0]}x{stored[1]}" + (f" turned by {-stored[2] % 360}" if stored[2] else "")


def _largest_stream(container: InputContainer, name: str) -> VideoStream:
    """The video itself: not the cover of a sound file, nor the preview that action cameras add."""
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        kinds = sorted({stream.type for stream in container.streams})
        found = (
            f"only {', '.join(kinds)}"
            if kinds
            else "no stream in it; it has no frames, or its index is broken: copy it again"
        )
        raise VideoError(f"{name}: expected a film, found {found}")
    # None without a decoder, whatever its type says.
    decodable = [stream for stream in streams if cast("Any", stream).codec_context is not None]
    if not decodable:
        raise VideoError(f"{name}: there is no decoder for its video; encode it as H.264 or H.265")
    return max(decodable, key=lambda stream: (stream.width * stream.height, -stream.index))


def _duration_s(container: InputContainer, stream: VideoStream) -> float | None:
    """Stated length of the video stream, else of the whole container."""
    if stream.duration and stream.duration > 0 and stream.time_base:
        return float(stream.duration * stream.time_base)
    if container.duration and container.duration > 0:
        return container.duration / av.time_base
    return None


def _expected(
    container: InputContainer, stream: VideoStream, first_s: float
) -> tuple[int | None, float | None]:
    # Only the index of an mp4 lists every frame, and only those that its edit list leaves to be shown.
    packets = len(stream.index_entries) if "mov" in container.format.name.split(",") else None
    duration_s, rate = _duration_s(container, stream), nominal_rate(stream)
    last_s = first_s + duration_s - float(1 / rate) if duration_s and rate else None
    return packets, last_s


def _info(
    container: InputContainer,
    stream: VideoStream,
    first: av.VideoFrame,
    opening: Opening,
    options: VideoOptions,
) -> VideoInfo:
    matrix = cast("Mapping[str, Any]", first.side_data).get("DISPLAYMATRIX")
    clockwise_deg = clockwise_from_display_matrix(None if matrix is None else bytes(matrix), opening.name)
    size = (first.width, first.height)
    if clockwise_deg in (90, 270):
        size = size[::-1]
    frame_size = fitted_size(*size, options.max_side_px)
    texts = {**container.metadata, **stream.metadata}
    tags = {name.lower(): value for name, value in texts.items()}
    said = " ".join(tags.get(name, "") for name in _STREAM_NAMES).lower()
    maker = next((make for word, make in _MAKER_WORDS.items() if word in said), None)
    return VideoInfo(
        name=opening.name,
        width=size[0],
        height=size[1],
        frame_width=frame_size[0],
        frame_height=frame_size[1],
        rotation_deg=clockwise_deg,
        duration_s=None if opening.live else _duration_s(container, stream),
        frame_count=stream.frames if stream.frames > 0 else None,
        creation_time=_creation_time(tags),
        make=_first(tags, _MAKE) or maker,
        model=_first(tags, _MODEL),
        live=opening.live,
    )


def _first(tags: Mapping[str, str], names: tuple[str, ...]) -> str | None:
    return next((value for name in names if (value := tags.get(name, "").strip())), None)


def _creation_time(tags: Mapping[str, str]) -> datetime | None:
    for name in _CREATION:
        try:
            time = datetime.fromisoformat(tags.get(name, "").strip())
        except ValueError:
            continue
        return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
    return None


_DEFAULT = VideoOptions()


def open_video(source: Source, options: VideoOptions = _DEFAULT) -> Video:
    """Open a film to read its frames in display order, upright, with times that increase.

    Times are on the film's own clock: for mp4, mov, mkv and avi that of the container, on which its telemetry
    lies, too; for others (transport streams, cameras) they begin with the source.

    Args:
        source: a film (mp4, mov, mkv, webm, avi, ts), a folder of pictures (see `folder.py`), a camera's
            device or an address (rtsp://, http://, ...).

    Raises:
        VideoError: it cannot be opened, holds no video that can be decoded, or is of a size or rotation that
            is not taken; while frames are read: see `Video`.
    """
    if isinstance(source, str | Path) and Path(source).is_dir():
        return open_folder(Path(source), options)
    return open_container(source, options)
