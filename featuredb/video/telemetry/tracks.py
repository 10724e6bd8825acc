"""Tracks of a video file that may hold telemetry: GoPro's metadata and subtitles. Pictures are not read."""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import av
from av.container import InputContainer
from av.packet import Packet  # generic in its stubs only, hence the quotes
from av.stream import Discard, Stream

from featuredb.errors import TelemetryError, VideoError
from featuredb.video.opening import open_input, opening_of
from featuredb.video.telemetry.assemble import check_count
from featuredb.video.telemetry.formats.gpmf import TimedPacket
from featuredb.video.telemetry.formats.srt_blocks import Subtitle, plain_text
from featuredb.video.telemetry.formats.text import decode_text

# GPMF is some 10 to 30 kB a second: five hours and more.
MAX_TRACK_BYTES = 512 * 1024 * 1024
# DJI's newer drones describe frames in a track of their own, which is not public and not read here.
_DJI_NAMES = ("dji meta", "cam meta", "djmd")


@dataclass(slots=True)
class TelemetryTracks:
    """What a video holds beside pictures and sound.

    Attributes:
        gpmf: packets of each GPMF track by the index of its stream.
        subtitles: blocks of each track of subtitles likewise.
        hints: what else was found and may interest those who miss telemetry.
    """

    gpmf: dict[int, list[TimedPacket]] = field(default_factory=dict)
    subtitles: dict[int, list[Subtitle]] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)


def read_tracks(path: Path) -> TelemetryTracks:
    """The tracks of a video that may hold telemetry; times are those of the container, as its frames' are.

    Raises:
        TelemetryError: not a video, or more data in such tracks than any recording has.
    """
    try:
        container = open_input(opening_of(path))
    except VideoError as error:
        raise TelemetryError(str(error)) from error
    with container:
        return _read(container, path.name)


def _read(container: InputContainer, name: str) -> TelemetryTracks:
    tracks = TelemetryTracks()
    wanted: list[Stream] = []
    for stream in container.streams:
        if stream.type in ("data", "subtitle") and stream.time_base:
            wanted.append(stream)
        else:
            stream.discard = Discard.all  # its packets are then not even read from the disk
        handler = stream.metadata.get("handler_name", "").strip().lower()
        if stream.type == "data" and any(part in handler for part in _DJI_NAMES):
            tracks.hints.append(
                "a track of DJI's own metadata (djmd), which is not public; switch on subtitles"
            )
    packets: dict[int, list[Packet[Stream]]] = defaultdict(list)
    if wanted:
        size = 0
        try:
            for packet in container.demux(wanted):
                if packet.pts is None or not packet.size:
                    continue
                size += packet.size
                if size > MAX_TRACK_BYTES:
                    raise TelemetryError(
                        f"{name}: more than {MAX_TRACK_BYTES // 2**20} MiB in its data and subtitle tracks; "
                        "no recording has so much telemetry"
                    )
                packets[packet.stream.index].append(packet)
                check_count(len(packets[packet.stream.index]), name)
        except (av.FFmpegError, OSError, ValueError) as error:
            tracks.damage.append(
                f"its tracks cannot be read to the end ({getattr(error, 'strerror', None) or error})"
            )
    for stream in wanted:
        _sort_out(stream, packets[stream.index], tracks)
    return tracks


def _sort_out(stream: Stream, packets: "list[Packet[Stream]]", tracks: TelemetryTracks) -> None:
    if not packets:
        return
    if stream.type == "data":
        # libav does not tell the track's type (gpmd); a GPMF packet begins with a device.
        if bytes(packets[0])[:4] == b"DEVC":
            tracks.gpmf[stream.index] = _timed(packets)
        return
    context = stream.codec_context
    is_mov_text = context is not None and context.name == "mov_text"
    blocks = []
    for packet in packets:
        start, data = _seconds(packet, packet.pts), bytes(packet)
        if is_mov_text:  # two bytes of length, the text, boxes of styles (3GPP TS 26.245, 5.17)
            data = data[2 : 2 + int.from_bytes(data[:2], "big")]
        text = plain_text(decode_text(data).splitlines())
        if text:
            blocks.append(Subtitle(start, text))
    if blocks:
        tracks.subtitles[stream.index] = blocks


def _timed(packets: "list[Packet[Stream]]") -> list[TimedPacket]:
    """Packets with their times; one without a duration lasts until the next, or as long as the one before."""
    starts = [_seconds(packet, packet.pts) for packet in packets]
    durations = [_seconds(packet, packet.duration) for packet in packets]
    for row, duration in enumerate(durations):
        if duration <= 0.0 and len(packets) > 1:
            before = min(row, len(packets) - 2)
            durations[row] = max(0.0, starts[before + 1] - starts[before])
    return [
        TimedPacket(start, duration, bytes(packet))
        for start, duration, packet in zip(starts, durations, packets, strict=True)
    ]


def _seconds(packet: "Packet[Stream]", ticks: int | None) -> float:
    return float((ticks or 0) * packet.time_base)
