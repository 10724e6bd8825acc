"""The way in: the telemetry of one file, or the telemetry that belongs to a video.

Tracks of a video file that may hold telemetry are GoPro's metadata and subtitles. Pictures are not read.
"""

import logging
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import av
from av.container import InputContainer
from av.packet import Packet  # generic in its stubs only, hence the quotes
from av.stream import Discard, Stream

from featuredb.errors import TelemetryError, VideoError
from featuredb.video.opening import open_input, opening_of
from featuredb.video.telemetry.formats.csv_table import read_csv
from featuredb.video.telemetry.formats.gpmf import TimedPacket, has_positions, read_gpmf
from featuredb.video.telemetry.formats.gpx import read_gpx
from featuredb.video.telemetry.formats.srt import (
    Subtitle,
    has_times,
    plain_text,
    read_srt,
    telemetry_of_blocks,
)
from featuredb.video.telemetry.formats.srt_fields import looks_like_telemetry
from featuredb.video.telemetry.formats.text import decode_text, read_bytes
from featuredb.video.telemetry.values import MAX_WARNINGS, Telemetry, check_count

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


logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".lrv", ".360")
# Beside a video, best first: subtitles keep the video's own time, the others have to be aligned by a clock.
SIDECAR_SUFFIXES = (".srt", ".gpx", ".csv")
_SNIFFED_BYTES = 65_536


_Candidate = tuple[str, Callable[[], Telemetry]]  # its name, and what reads it


def read_telemetry(path: Path) -> Telemetry:
    """The telemetry of a file: subtitles, GPX, a table, or a video with a track of it.

    What it is, is told by its contents; the suffix counts where they do not tell.

    Raises:
        TelemetryError: it cannot be read, is none of these, or holds no position.
    """
    kind = path.suffix.lower()
    if kind in VIDEO_SUFFIXES:
        tracks = read_tracks(path)
        candidates = _embedded(tracks, path.name)
        if not candidates:
            found = "; ".join(tracks.hints + tracks.damage)
            hint = f" ({found})" if found else ""
            raise TelemetryError(
                f"{path.name}: expected a GPMF track or a drone's subtitles in it, found neither{hint}; give "
                "the drone's .SRT file or a GPX or CSV log"
            )
        return _first_readable(path.name, candidates, [], tracks.damage)
    data = read_bytes(path)
    if not data:
        raise TelemetryError(f"{path.name}: the file is empty; was the recording interrupted?")
    kind = _kind_of(data[:_SNIFFED_BYTES]) or kind
    if kind == ".srt":
        return read_srt(data, path.name)
    if kind == ".gpx":
        return read_gpx(data, path.name)
    if kind in (".csv", ".tsv", ".txt"):
        return read_csv(data, path.name)
    raise TelemetryError(
        f"{path.name}: expected subtitles (.srt), GPX, a table (.csv) or a video "
        f"({', '.join(VIDEO_SUFFIXES)}), found a file that begins with {data[:16]!r}"
    )


def telemetry_of_video(path: Path) -> Telemetry | None:
    """The telemetry that belongs to a video, in it or beside it; None where there is none.

    Looked at in this order; the first that can be read is taken, and the others are named in its warnings:

    1. a GPMF track with positions: it cannot belong to another video, and has many samples a second;
    2. a track of a drone's subtitles, for the first reason;
    3. a file with the video's name and the suffix .srt (any case), which keeps the video's time;
    4. the same with .gpx, then .csv: clock times, still to be aligned with the video.

    Args:
        path: the video, or a folder of its frames (for which only the files beside it count).

    Raises:
        TelemetryError: no such video, or telemetry was found and none of it can be read; says why.
    """
    if not path.exists():
        raise TelemetryError(f"{path}: no such video")
    refused: list[str] = []
    damage: list[str] = []
    candidates: list[_Candidate] = []
    if not path.is_dir():
        try:
            tracks = read_tracks(path)
            candidates += _embedded(tracks, path.name)
            damage = tracks.damage
            for hint in tracks.hints:
                logger.info("%s: %s", path.name, hint)
        except TelemetryError as error:
            refused.append(str(error))
    candidates += _sidecars(path)
    if not candidates:
        if refused:
            raise TelemetryError(refused[0])
        return None
    return _first_readable(path.name, candidates, refused, damage)


def _embedded(tracks: TelemetryTracks, name: str) -> list[_Candidate]:
    """Readers of the tracks that hold telemetry, best first."""
    found: list[_Candidate] = []
    for index, packets in tracks.gpmf.items():
        if has_positions(packets):
            label = f"{name}, GPMF track {index}"
            found.append((label, partial(read_gpmf, packets, label)))
    for index, blocks in tracks.subtitles.items():
        if any(looks_like_telemetry(block.text) for block in blocks):
            label = f"{name}, subtitle track {index}"
            found.append((label, partial(telemetry_of_blocks, blocks, label)))
    return found


def _sidecars(path: Path) -> list[_Candidate]:
    """Readers of the files beside a video that bear its name, best first, without people's talk."""
    try:
        beside = sorted(path.absolute().parent.iterdir())
    except OSError as error:
        raise TelemetryError(f"{path.parent}: cannot be listed ({error.strerror or error})") from error
    stem = path.stem.casefold() if not path.is_dir() else path.name.casefold()
    found: list[_Candidate] = []
    for suffix in SIDECAR_SUFFIXES:
        for file in beside:
            if file.suffix.lower() != suffix or file.stem.casefold() != stem or not file.is_file():
                continue
            if suffix == ".srt" and _is_dialogue(file):
                continue
            found.append((file.name, partial(read_telemetry, file)))
    return found


def _is_dialogue(file: Path) -> bool:
    """Whether subtitles are there that are no telemetry; an unreadable file is left to its reader."""
    try:
        text = decode_text(read_bytes(file)[:_SNIFFED_BYTES])
    except TelemetryError:
        return False
    return has_times(text) and not looks_like_telemetry(text)


def _first_readable(
    name: str, candidates: list[_Candidate], refused: list[str], damage: list[str]
) -> Telemetry:
    """The first candidate that can be read, with what else there was in its warnings."""
    for row, (_, read) in enumerate(candidates):
        try:
            telemetry = read()
        except TelemetryError as error:
            refused.append(str(error))
            continue
        notes = [*damage, *(f"not used: {reason}" for reason in refused)]
        notes += [f"also there, not used: {other}" for other, _ in candidates[row + 1 :]]
        return replace(telemetry, warnings=(*notes, *telemetry.warnings)[:MAX_WARNINGS])
    raise TelemetryError(f"{name}: no telemetry can be read: " + "; ".join(refused))


def _kind_of(start: bytes) -> str:
    """The suffix that the first bytes of a file deserve, "" where they do not tell."""
    text = decode_text(start)
    if text.lstrip()[:5].lower() in ("<?xml", "<gpx ", "<gpx>"):
        return ".gpx"
    if has_times(text) or looks_like_telemetry(text):
        return ".srt"
    return ""
