"""Opens what libav can open, and says in plain words why something cannot be opened."""

import errno
import re
import stat
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import av
from av.container import InputContainer

from featuredb.errors import VideoError

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
