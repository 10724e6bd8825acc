"""How fast a film is read: decoding alone, with grey, with grey made smaller, with colours.

    uv run python tools/video_decode.py FILE [--max-side 1600] [--threads 1] [--frames 300] [--repeat 3]

Frames a second by the clock, and processor time of a frame, of the best of the repeats: other work on the
machine takes from the first and little from the second. Grey is part of the two lines below it.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from featuredb.errors import VideoError
from featuredb.video.frames import VideoInfo, VideoOptions, open_video

_NEVER = sys.maxsize  # as `every`: all frames are decoded, only the first is converted


@dataclass(frozen=True, slots=True, kw_only=True)
class Speed:
    """Of one reading: frames a second by the clock, milliseconds of processor time a frame."""

    frames_per_s: float
    cpu_ms: float


def measure(path: Path, options: VideoOptions, colours: bool, repeat: int) -> Speed:
    """Read the film `repeat` times; the best of each figure."""
    clock, processor = [], []
    for _ in range(repeat):
        with open_video(path, options) as video:
            began, used = time.perf_counter(), time.process_time()
            for frame in video:
                if colours:
                    frame.rgb()
            count = video.report.decoded
            clock.append((time.perf_counter() - began) / count)
            processor.append((time.process_time() - used) / count)
    return Speed(frames_per_s=1.0 / min(clock), cpu_ms=1e3 * min(processor))


def until(info: VideoInfo, frames: int) -> float | None:
    """When the first `frames` frames are over, by the nominal rate; None for the whole film."""
    return frames / info.frame_rate_hz if info.frame_rate_hz else None


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument(
        "--max-side", type=int, default=1600, help="pixels of the smaller frames (%(default)s)"
    )
    parser.add_argument("--threads", type=int, default=1, help="of the decoder (%(default)s)")
    parser.add_argument("--frames", type=int, default=300, help="read about so many (%(default)s)")
    parser.add_argument("--repeat", type=int, default=3, help="readings of each kind (%(default)s)")
    given = parser.parse_args(arguments)
    try:
        with open_video(given.file) as video:
            info = video.info
        full = VideoOptions(threads=given.threads, end_s=until(info, given.frames))
        small = replace(full, max_side_px=given.max_side)
        with open_video(given.file, small) as video:
            size = f"{video.info.frame_width}x{video.info.frame_height}"
        print(f"{info.name}: {info.codec} {info.width}x{info.height}, turned by {info.rotation_deg} degrees")
        for name, options, colours in (
            ("decode", replace(full, every=_NEVER), False),
            ("decode + grey", full, False),
            (f"decode + grey {size}", small, False),
            ("decode + grey + rgb", full, True),
            (f"decode + grey + rgb {size}", small, True),
        ):
            speed = measure(given.file, options, colours, given.repeat)
            print(f"{name:32s} {speed.frames_per_s:8.1f} frames/s {speed.cpu_ms:8.2f} ms CPU a frame")
    except VideoError as error:
        print(f"video_decode: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
