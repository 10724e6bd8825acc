"""Packets of a film to pictures in display order with times that increase, past what is broken.

A packet that cannot be decoded is counted and left out, and decoding goes on with the next. What PyAV does
not do by itself, and is done here:

- It asks libav to make up missing presentation times, and for AVI, which stores none, gets those of decoding
  order: wrong wherever a codec reorders. There the decoding times are taken, less the decoder's delay.
- An empty packet in the middle of a file (a repeated frame of AVI) would end decoding, as it means "flush".
- After its container is closed, going on with a demuxer reads freed memory: `stop` ends it before.
"""

from collections.abc import Iterator
from fractions import Fraction

import av
from av.container import InputContainer
from av.video.stream import VideoStream

from featuredb.errors import VideoError
from featuredb.video.film import VideoReport

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
