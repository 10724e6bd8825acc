"""Frames that are read ahead: the same, in the same order, with their errors where they belong."""

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import VideoError
from featuredb.video.film import Video, VideoFrame, VideoReport
from featuredb.video.frames import open_video
from reloc.tracking.track_video import read_ahead
from tests.support.films import film, read


class _Film(Video):
    """Frames of a real film, which breaks after some, and tells how many were read."""

    def __init__(self, path: Path, breaks_after: int = 1000, live: bool = False) -> None:
        with open_video(path) as video:
            super().__init__(replace(video.info, live=live))
            self._known = list(video)
        self._breaks_after, self.read = breaks_after, 0

    @property
    def report(self) -> VideoReport:
        return VideoReport(decoded=self.read)

    def close(self) -> None:
        self._known = []

    def _frames(self) -> Iterator[VideoFrame]:
        for frame in self._known:
            if self.read == self._breaks_after:
                raise VideoError("the film is broken here")
            self.read += 1
            yield frame


@pytest.mark.parametrize("pattern", [(False,), (True,), (False, True, False, False)])
def test_frames_are_those_of_the_film_whenever_they_are_read_ahead(
    tmp_path: Path, pattern: tuple[bool, ...]
) -> None:
    idle = cycle(pattern)
    path = film(tmp_path, "mp4", 50)
    expected = read(path)
    with open_video(path) as video:
        found = []
        for frame in read_ahead(video, lambda: next(idle)):
            found.append(frame)
            # Colours are made here while greys are made there.
            np.testing.assert_array_equal(frame.rgb(), expected[len(found) - 1].rgb())
        report = video.report
    assert [f.time_s for f in found] == [f.time_s for f in expected]
    for frame, same in zip(found, expected, strict=True):
        np.testing.assert_array_equal(frame.gray, same.gray)
    assert not report.complaints()


def test_an_error_comes_after_the_frames_before_it(tmp_path: Path) -> None:
    frames = read_ahead(_Film(film(tmp_path, "mp4"), breaks_after=12))
    for _ in range(12):
        next(frames)
    with pytest.raises(VideoError, match="broken here"):
        next(frames)


@pytest.mark.parametrize(("live", "most"), [(False, 5), (True, 0)])
def test_no_more_are_read_ahead_than_wanted_and_of_a_live_source_none(
    tmp_path: Path, live: bool, most: int
) -> None:
    source = _Film(film(tmp_path, "mp4"), live=live)
    frames = read_ahead(source, most=5)
    next(frames)
    frames.close()
    assert source.read <= 1 + most
    assert sum(1 for _ in read_ahead(_Film(film(tmp_path, "mp4"), live=live), most=5)) == 30


@pytest.mark.parametrize(
    ("width", "height", "most"), [(1280, 720, 24), (3840, 2160, 10), (7680, 4320, 2), (16_384, 8_192, 1)]
)
def test_large_films_are_read_ahead_as_far_as_their_memory_goes(
    tmp_path: Path, width: int, height: int, most: int
) -> None:
    source = _Film(film(tmp_path, "mp4", 40))
    small = (width, height) if width <= 1280 else (1280, 720)
    source.info = replace(
        source.info, width=width, height=height, frame_width=small[0], frame_height=small[1]
    )
    frames, used = read_ahead(source), 12
    for _ in range(used):
        next(frames)
    end = time.monotonic() + 20.0
    while source.read < used + most - 1:  # the last one is in use
        assert time.monotonic() < end
        time.sleep(0.01)
    time.sleep(0.05)
    assert source.read == used + most - 1
    frames.close()


def test_a_film_that_is_left_early_has_no_thread_left(tmp_path: Path) -> None:
    with open_video(film(tmp_path, "mp4")) as video, closing(read_ahead(video)) as frames:
        next(frames)
    assert not [t.name for t in threading.enumerate() if t.name.startswith("decoding")]
