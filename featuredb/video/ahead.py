"""Frames of a film, decoded in a thread of their own where who uses them has a core to spare.

Libav decodes outside Python's lock. Decoding always and beside everything else does not pay on two cores:
what else runs there gets later. So the user says when, frame by frame:

    with open_video("flight.mp4") as video, ReadAhead(video) as film:
        for frame in film:
            track(frame.gray, frame.time_s)
            if not busy():
                film.read_on(4)
"""

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

from featuredb.errors import InvalidValueError
from featuredb.video.film import Video, VideoFrame, VideoInfo

# Of pictures that wait, for their greys and, as 4:2:0, their colours: at 3840x2160 ten frames.
_MOST_BYTES = 1 << 27


class ReadAhead:
    """The frames of an open film, in order; what goes wrong as they are read is raised at its frame.

    A context manager, to be left before the film is closed; to be used from one thread. The film's `report`
    knows of frames that were read ahead. Live sources are not: what they show now is wanted.
    """

    def __init__(self, video: Video, most: int = 24) -> None:
        """
        Args:
            most: frames that are decoded before they are used; fewer of large films, for their memory.
        """
        if most < 1:
            raise InvalidValueError(f"most: expected 1 frame or more to be read ahead, found {most}")
        self._frames: Iterator[VideoFrame] | None = None
        self._video, self._most = video, 0 if video.info.live else min(most, _fitting(video.info))
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        self._ahead: deque[Future[VideoFrame | None]] = deque()
        self._seconds = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def seconds(self) -> float:
        """That decoding has taken, ahead or not."""
        return self._seconds

    def read_on(self, frames: int) -> None:
        """Decode so many more frames in the background, up to `most` not yet used; none before the first."""
        if self._frames is None:
            return
        for _ in range(min(frames, self._most - len(self._ahead))):
            self._ahead.append(self._pool.submit(self._next))

    def __iter__(self) -> Iterator[VideoFrame]:
        """The film's frames; once, as of the film itself.

        Raises:
            VideoError, InvalidValueError: see `Video.__iter__`.
        """
        self._frames = iter(self._video)
        while True:
            # Nothing is decoded elsewhere where nothing is waited for: frames stay in order.
            frame = self._ahead.popleft().result() if self._ahead else self._next()
            if frame is None:
                return
            yield frame

    def _next(self) -> VideoFrame | None:
        assert self._frames is not None
        began = time.perf_counter()
        try:
            return next(self._frames, None)
        finally:
            self._seconds += time.perf_counter() - began


def _fitting(info: VideoInfo) -> int:
    """Frames that fit into the memory that they may take, one at least."""
    each = info.frame_width * info.frame_height + 3 * info.width * info.height // 2
    return max(1, _MOST_BYTES // each)
