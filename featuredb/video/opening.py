"""Opens what libav can open, and says in plain words why something cannot be opened.

Packets of a film to pictures in display order with times that increase, past what is broken.

A packet that cannot be decoded is counted and left out, and decoding goes on with the next. What PyAV does
not do by itself, and is done here:

- It asks libav to make up missing presentation times, and for AVI, which stores none, gets those of decoding
  order: wrong wherever a codec reorders. There the decoding times are taken, less the decoder's delay.
- An empty packet in the middle of a file (a repeated frame of AVI) would end decoding, as it means "flush".
- After its container is closed, going on with a demuxer reads freed memory: `stop` ends it before.
"""

import errno
import re
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import av
from av.container import InputContainer
from av.video.stream import VideoStream

from featuredb.errors import VideoError
from featuredb.video.film import VideoReport

# A file is taken for a film by its contents. Without this list, a playlist or a script that somebody named
# .mp4 would make libav open other files and addresses on its behalf.
_FILE_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"
_FILE_FORMATS_SAID = "mp4, mov, mkv, webm, avi or ts"
_SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "rtmps", "rtp", "srt", "tcp", "udp")
# What an address may lead on to (a playlist's segments, RTSP's streams): the network, no local files.
_OF_NETWORK = {"protocol_whitelist": ",".join((*_SCHEMES, "tls", "crypto", "httpproxy"))}
_OF_FILES = {"format_whitelist": _FILE_FORMATS, "protocol_whitelist": "file"}
_TIMEOUT_S = 10.0  # that a URL or a device may be silent, when it is opened and between its packets
# Larger films are refused before anything is allocated for them. Panoramic cameras reach 11520x5760; a frame
# of the most pixels takes 200 MB as 4:2:0.
MAX_FULL_SIDE_PX, MAX_FULL_PIXELS = 16_384, 16_384 * 8_192
_BLOCK_PX = 128  # of AV1 and its like; half of it in H.265
# Of a coded picture, which ends in whole blocks; libav allocates nothing for larger ones.
MAX_CODED_PIXELS = MAX_FULL_PIXELS + 2 * _BLOCK_PX * MAX_FULL_SIDE_PX

Source = str | Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """How a source is handed to libav.

    Attributes:
        name: for messages, without password.
        target: the address or path that `av.open` takes.
        input_format: libav's name of the format where it cannot tell itself, or None.
        live: whether it is read once from its start, with a timeout.
    """

    name: str
    target: str
    input_options: dict[str, str]
    live: bool
    path: Path | None = None
    input_format: str | None = None


def opening_of(source: Source) -> Opening:
    """Where a source is and how it is opened; nothing is opened yet.

    Raises:
        VideoError: no such file, not a regular file, or an address of an unknown kind.
    """
    if isinstance(source, str) and re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", source):
        return _address(source)
    return _file_or_device(Path(source))


def _address(url: str) -> Opening:
    parts = urlsplit(url)
    name = url if "@" not in parts.netloc else url.replace(parts.netloc, parts.netloc.rpartition("@")[2], 1)
    if parts.scheme not in _SCHEMES:
        raise VideoError(
            f"{name}: expected a path, or an address of one of {', '.join(_SCHEMES)}, found {parts.scheme}://"
        )
    # Over UDP a lost datagram smears the picture until the next key frame.
    over = {"rtsp_transport": "tcp"} if parts.scheme in ("rtsp", "rtsps") else {}
    return Opening(name=name, target=url, input_options=_OF_NETWORK | over, live=True)


def _file_or_device(path: Path) -> Opening:
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise VideoError(f"{path}: the film cannot be opened: {reason}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)):
        raise VideoError(f"{path}: expected a film, a folder of pictures, a pipe or a camera's device")
    regular, device = stat.S_ISREG(mode), stat.S_ISCHR(mode)
    return Opening(
        name=path.name if regular else str(path),
        # Without the scheme a name like "tcp:2.mp4" would be taken for an address.
        target=str(path) if device else f"file:{path.absolute()}",
        path=path if regular else None,
        input_format="v4l2" if device else None,
        input_options={} if device else _OF_FILES,
        live=not regular,
    )


def check_size(name: str, width: int, height: int) -> None:
    """Refuse what is too large to be meant; a size of 0 is one that only the first frame tells.

    Raises:
        VideoError: it is.
    """
    if max(width, height) > MAX_FULL_SIDE_PX or width * height > MAX_FULL_PIXELS:
        raise VideoError(
            f"{name}: its pictures have {width}x{height} pixels, the limit is {MAX_FULL_SIDE_PX} a side and "
            f"{MAX_FULL_PIXELS / 1e6:.0f} million; make it smaller, unless it is broken"
        )


def open_input(opening: Opening) -> InputContainer:
    """The open container.

    Raises:
        VideoError: it cannot be opened, in words that say why.
    """
    try:
        return av.open(
            opening.target,
            "r",
            format=opening.input_format,
            # For libav's own look at the first frames; the decoder is given the same.
            options={"max_pixels": str(MAX_CODED_PIXELS)},
            container_options=opening.input_options,
            metadata_errors="replace",  # a camera's odd bytes in a tag are no reason to refuse its film
            # A timeout makes libav ask Python again and again, which a file is not worth.
            timeout=_TIMEOUT_S if opening.live else None,
        )
    except (av.FFmpegError, OSError, ValueError) as error:
        raise _refusal(opening, error) from error


def _refusal(opening: Opening, error: Exception) -> VideoError:
    name = opening.name
    # A format that is not in the list is invalid data, or an invalid argument where its suffix names it.
    if opening.path is not None and (
        isinstance(error, av.InvalidDataError) or getattr(error, "errno", None) == errno.EINVAL
    ):
        return VideoError(f"{name}: {_what_it_is(opening.path)}")
    if isinstance(error, av.error.ExitError):
        return VideoError(
            f"{name}: nothing came within {_TIMEOUT_S:g} s; check that the source sends and can be reached"
        )
    if isinstance(error, av.InvalidDataError):
        return VideoError(
            f"{name}: what came is not a film that can be read; expected {_FILE_FORMATS_SAID} or a camera's "
            "stream (an mp4 or mov that cannot be sought in needs its index in front: `-movflags +faststart`)"
        )
    reason = getattr(error, "strerror", None) or str(error)
    hint = "" if opening.live else "; if it opens elsewhere, copy it again, else its header is broken"
    return VideoError(f"{name}: the film cannot be opened: {reason}{hint}")


def _what_it_is(path: Path) -> str:
    """Why libav finds no film in a file."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
            boxes = _box_names(file)
    except OSError as error:
        return f"the film cannot be read: {error.strerror or error}"
    if not head:
        return "the file is empty; copy it again"
    if boxes and "moov" not in boxes:
        return (
            f"an mp4 or mov without its index: found the boxes {', '.join(boxes)}, no moov. The recording or "
            "the copy broke off; copy it again, or have the index rebuilt (untrunc)"
        )
    if boxes:
        return "an mp4 or mov whose index is broken; copy it again"
    return f"expected {_FILE_FORMATS_SAID}, found a file that begins with {head!r}"


def _box_names(file: Any) -> list[str]:
    """Names of the top-level boxes of an ISO base media file (ISO 14496-12, 4.2); empty if it is none."""
    names: list[str] = []
    at = 0
    while len(names) < 64:
        file.seek(at)
        header = file.read(16)
        if len(header) < 8 or not re.fullmatch(rb"[A-Za-z0-9 ]{4}", header[4:8]):
            break
        size = struct.unpack_from(">I", header)[0]
        if size == 1 and len(header) == 16:
            size = struct.unpack_from(">Q", header, 8)[0]
        names.append(header[4:8].decode("ascii").strip())
        if size < 8:
            break
        at += size
    return names if names and names[0] in ("ftyp", "moov", "mdat", "wide", "free", "skip") else []


# Their time line starts at 0 and their index finds key frames. Others start at any time (a transport stream's
# own clock, a camera's uptime), and libav's search in a transport stream ends behind the frame it looks for.
_INDEXED = frozenset({"mov", "matroska", "avi"})
# High-speed cameras write up to 1000 frames a second; what says more gives its tick, not its rate.
_MAX_RATE_HZ = 1000.0
# A stream in which nothing can be decoded for that long (minutes) will not come right.
_MAX_UNDECODABLE_IN_A_ROW = 5_000
# A broken place of the container costs one or two of these; a file full of them is not worth reading.
_MAX_READ_ERRORS_IN_A_ROW = 20
# One or two frames swap times in films with sloppy clocks; a clock that was set back stays behind.
_MAX_BACKWARD_IN_A_ROW = 250


def is_indexed(container: InputContainer) -> bool:
    """Whether its time line starts at 0 and its index finds key frames."""
    return not _INDEXED.isdisjoint(container.format.name.split(","))


def nominal_rate(stream: VideoStream) -> Fraction | None:
    """Frames per second, or None."""
    for rate in (stream.average_rate, stream.guessed_rate):
        if rate and 0 < rate <= _MAX_RATE_HZ:
            return rate
    return None


class Decoder:
    """Decodes one stream of an open container; to be used from one thread.

    Raises:
        VideoError: the stream does not say what its time stamps count.
    """

    def __init__(self, container: InputContainer, stream: VideoStream, tally: VideoReport, name: str) -> None:
        if not stream.time_base:
            raise VideoError(f"{name}: its video has no time base; copy it into an mp4 or mkv")
        self._container, self._stream, self._tally, self._name = container, stream, tally, name
        self._time_base, rate = stream.time_base, nominal_rate(stream)
        self._interval_s = float(1 / rate) if rate else None
        starts_anywhere = not is_indexed(container) and container.start_time is not None
        # What the stamps say at the film's start.
        self._origin_s = Fraction(container.start_time, av.time_base) if starts_anywhere else Fraction(0)
        # AVI stores no presentation times. Its decoding times only count its packets: frames that a broken
        # place swallows shift those behind them.
        self._decoding_order = container.format.name == "avi"
        # Gaps in a transport stream's counters mark packets that mostly decode; elsewhere the mark means that
        # the file ends within the packet, and with several threads such a packet takes its neighbours along.
        self._skip_marked = "mpegts" not in container.format.name.split(",")
        self._stopped = False

    def stop(self) -> None:
        """End decoding for good; must be called before the container is closed."""
        self._stopped = True

    def check_open(self) -> None:
        """Refuse to go on after `stop`.

        Raises:
            VideoError: it was stopped.
        """
        if self._stopped:
            raise VideoError(f"{self._name} is closed; read its frames inside the `with` block")

    def seek(self, time_s: float) -> bool:
        """Go to a key frame at or before `time_s` where the container can; whether it could.

        The next `pictures` start there. Where the index is wrong they may start later.
        """
        self.check_open()
        try:
            stamp = round((Fraction(time_s) + self._origin_s) / self._time_base)
            self._container.seek(stamp, stream=self._stream)
        except (av.FFmpegError, OverflowError):
            return False
        return True

    def pictures(self) -> Iterator[tuple[float, av.VideoFrame]]:
        """(time in seconds, picture) in order of time from where the container stands.

        Raises:
            VideoError: the source fails, falls silent or has nothing to decode, or its clock goes back.
        """
        last_s: float | None = None
        backward = 0
        for picture in self._decoded():
            time_s = self._time_s(picture)
            if time_s is None and last_s is not None and self._interval_s is not None:
                time_s = last_s + self._interval_s
                # The last frames of an AVI come when no packet is left to name their time: the next one.
                self._tally.times_guessed += not self._decoding_order
            if time_s is None and last_s is None:
                time_s = 0.0
                self._tally.times_guessed += 1
            if time_s is None or (last_s is not None and time_s <= last_s):
                self._tally.out_of_order += 1
                backward += 1
                if backward > _MAX_BACKWARD_IN_A_ROW:
                    raise VideoError(
                        f"{self._name}: the times of {backward} frames stay at or behind {last_s:.3f} s, as "
                        "of a clock that was set back; split the film there, or open the live source again"
                    )
                continue
            backward = 0
            last_s = self._tally.last_s = time_s
            yield time_s, picture

    def _time_s(self, picture: av.VideoFrame) -> float | None:
        """The picture's own time on the film's clock, or None where it has none."""
        stamp = picture.pts
        if self._decoding_order:  # the decoder reorders by some frames, in which AVI counts
            delay_frames = self._stream.codec_context.reorder_depth
            stamp = None if picture.dts is None else picture.dts - delay_frames
        return None if stamp is None else float(stamp * self._time_base - self._origin_s)

    def _decoded(self) -> Iterator[av.VideoFrame]:
        failed = 0
        for packet in self._packets():
            if self._skip_marked and packet.is_corrupt:
                self._tally.undecodable += 1
                continue
            try:
                pictures = packet.decode()
            except av.FFmpegError:
                self._tally.undecodable += 1
                failed += 1
                if failed > _MAX_UNDECODABLE_IN_A_ROW:
                    raise VideoError(
                        f"{self._name}: none of {failed} packets in a row could be decoded; the stream is "
                        "broken or needs a decoder that is not there"
                    ) from None
                continue
            failed = 0 if pictures else failed
            for picture in pictures:
                self.check_open()
                yield picture

    def _packets(self) -> "Iterator[av.Packet[VideoStream]]":  # generic in the stubs only
        """Packets of the stream and at its end one that flushes the decoder, past broken places."""
        errors = 0
        while True:
            self.check_open()
            demuxed = self._container.demux(self._stream)
            while True:
                self.check_open()
                try:
                    packet = next(demuxed)
                except StopIteration:
                    self._tally.at_end = True
                    return
                except av.InvalidDataError as error:
                    errors += 1
                    if errors > _MAX_READ_ERRORS_IN_A_ROW:
                        raise VideoError(
                            f"{self._name}: the container is broken after {self._said_last()}; copy it again"
                        ) from error
                    break
                except (av.FFmpegError, OSError) as error:
                    raise VideoError(
                        f"{self._name}: reading failed after {self._said_last()}: {_reason(error)}"
                    ) from error
                if packet.size:
                    errors = 0
                    self._tally.packets += 1
                elif packet.dts is not None:
                    continue
                yield packet

    def _said_last(self) -> str:
        last_s = self._tally.last_s
        return "no frame at all" if last_s is None else f"the frame at {last_s:.3f} s"


def _reason(error: Exception) -> str:
    if isinstance(error, av.error.ExitError):
        return "nothing came within the timeout; check the camera and the network"
    return getattr(error, "strerror", None) or str(error)
