"""Small films whose every frame can be told from its picture, and what their readers should find in them."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from featuredb.video.film import VideoFrame, VideoOptions
from featuredb.video.frames import open_video

WIDTH, HEIGHT = 160, 120
_SEED = 20_240_511
_BLOCK_PX = 8
_SHIFT_PX = 4


def picture(index: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """Frame `index` (h, w, 3) uint8: a window that moves right over fixed random blocks of grey."""
    rng = np.random.default_rng(_SEED)
    blocks = rng.integers(20, 236, (height // _BLOCK_PX + 1, 200), dtype=np.uint8)
    wide = blocks.repeat(_BLOCK_PX, 0).repeat(_BLOCK_PX, 1)
    window = wide[:height, _SHIFT_PX * index : _SHIFT_PX * index + width]
    return np.ascontiguousarray(np.repeat(window[:, :, None], 3, axis=2))


def shown(gray: NDArray[np.uint8], count: int = 60) -> int:
    """Index of the frame that a grey picture of full size shows, by the least difference."""
    differences = [np.abs(picture(i)[:, :, 0].astype(int) - gray).mean() for i in range(count)]
    return int(np.argmin(differences))


def write_film(
    path: Path,
    pictures: Sequence[NDArray[np.uint8]] | None = None,
    *,
    container: str | None = None,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    rate: int = 25,
    group: int = 12,
    times_s: Sequence[float] | None = None,
    options: Mapping[str, str] | None = None,
    container_options: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
    rotation_deg: float | None = None,
    mirrored: bool = False,
    colours: Mapping[str, int] | None = None,
) -> Path:
    """Write a film with PyAV alone, so that our reader is not tested against our writer.

    Args:
        pictures: (h, w, 3) uint8; 12 of `picture` if None.
        container: libav's name of the format; by the suffix if None.
        group: frames from one key frame to the next.
        times_s: times of the frames; at the rate if None.
        rotation_deg: counterclockwise, as PyAV's display matrix counts.
        colours: tags of the stream, e.g. {"colorspace": 1}; frames are converted accordingly.
    """
    frames = [picture(i) for i in range(12)] if pictures is None else list(pictures)
    height, width = frames[0].shape[:2]
    base = Fraction(1, rate) if times_s is None else Fraction(1, 90_000)
    with av.open(str(path), "w", format=container, options=dict(container_options or {})) as out:
        out.metadata.update(tags or {})
        stream: Any = out.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.codec_context.time_base = base
        stream.codec_context.gop_size = group
        stream.codec_context.thread_count = 1
        stream.codec_context.options = dict(options or {})
        for name, value in (colours or {}).items():
            setattr(stream.codec_context, name, value)
        if rotation_deg is not None:
            stream.set_display_rotation(rotation_deg, hflip=mirrored)
        how = {}
        if colours:
            how = {"dst_colorspace": colours["colorspace"], "dst_color_range": colours["color_range"]}
        for index, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(format=pixel_format, threads=1, **how)
            frame.time_base = base
            frame.pts = index if times_s is None else round(times_s[index] * 90_000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def write_sound(path: Path, seconds: float = 0.5) -> Path:
    """A file with sound alone."""
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream("aac", rate=48_000)
        stream.layout = "mono"
        for start in range(0, int(seconds * 48_000), 1024):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = 48_000, start, Fraction(1, 48_000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def overwritten(data: bytes, start: int, length: int, seed: int = 1) -> bytes:
    """The bytes with `length` of them from `start` replaced by random ones."""
    noise = np.random.default_rng(seed).integers(0, 256, length, dtype=np.uint8).tobytes()
    return data[:start] + noise + data[start + length :]


# Containers and codecs of the field: phones and drones, old cameras (MPEG-4 and Motion JPEG in AVI), web.
KINDS: dict[str, dict[str, Any]] = {
    "mp4": {},
    "mov": {},
    "mkv": {},
    "avi": {},  # H.264 with reordered frames, in a container that stores no presentation times
    "ts": {},
    "old.avi": {"codec": "mpeg4", "options": {"b": "4000000"}},
    "b.avi": {"codec": "mpeg4", "options": {"b": "4000000", "bf": "2"}},
    "jpeg.avi": {"codec": "mjpeg", "pixel_format": "yuvj420p"},
    "hevc.mp4": {"codec": "libx265", "options": {"x265-params": "log-level=none:pools=1"}},
    "webm": {"codec": "libvpx-vp9", "options": {"deadline": "realtime", "b": "2000000"}},
}
CONTAINER = {"mkv": "matroska", "ts": "mpegts"}


def film(folder: Path, kind: str, count: int = 30) -> Path:
    """A film of one of KINDS that shows `picture` 0 to count - 1 at 25 frames a second."""
    suffix = kind.rpartition(".")[2]
    return write_film(
        folder / f"film.{suffix}",
        [picture(i) for i in range(count)],
        container=CONTAINER.get(suffix, suffix),
        **KINDS[kind],
    )


def read(source: object, **options: object) -> list[VideoFrame]:
    """All frames that our reader delivers with these options."""
    with open_video(source, VideoOptions(**options)) as video:  # type: ignore[arg-type]
        return list(video)
