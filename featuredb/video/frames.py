"""Frames of a film, a folder of pictures, a network stream or a camera, with their times, by one function.

with open_video("flight.mp4", VideoOptions(max_side_px=1600)) as video:
    for frame in video:
        track(frame.gray, frame.time_s)
print(video.report.complaints())
"""

from pathlib import Path

from featuredb.video.container import open_container
from featuredb.video.film import Video, VideoOptions
from featuredb.video.folder import open_folder
from featuredb.video.opening import Source

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
