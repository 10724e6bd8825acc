"""Films of strangers: shots, titles, black and frozen frames, and films that are none."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.video.film import VideoFrame
from ingest.video.films import Films, find_films, make_films
from ingest.video.motion import FrameKind, measure_motion
from ingest.video.stills import StillsOptions
from tests.support.films import picture, write_film

_WIDTH, _HEIGHT = 320, 240


def _scene(shot: int, frame: int) -> NDArray[np.uint8]:
    """Two places: the window over the blocks, and the same turned upside down, over others."""
    if shot == 0:
        return picture(frame, _WIDTH, _HEIGHT)
    return np.ascontiguousarray(picture(120 + frame, _WIDTH, _HEIGHT)[::-1])


def _title(text: str) -> NDArray[np.uint8]:
    page = np.full((_HEIGHT, _WIDTH, 3), 24, np.uint8)
    return np.asarray(cv2.putText(page, text, (40, 130), cv2.FONT_HERSHEY_DUPLEX, 1.2, (250, 250, 250), 2))


def _edited() -> list[NDArray[np.uint8]]:
    """A title, a shot, black, the same shot going on, a cut, another shot that freezes."""
    return [
        *[_title("A FILM")] * 5,
        *(_scene(0, k) for k in range(12)),
        *[np.zeros((_HEIGHT, _WIDTH, 3), np.uint8)] * 3,
        *(_scene(0, k) for k in range(12, 24)),
        *(_scene(1, k) for k in range(14)),
        *[_scene(1, 13)] * 6,
    ]


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Films:
    folder = tmp_path_factory.mktemp("strangers")
    write_film(folder / "edited.mkv", _edited(), options={"crf": "12"})
    write_film(folder / "other.mp4", [_scene(0, k) for k in range(30)])
    (folder / "broken.mp4").write_bytes(b"no film")
    (folder / "notes.txt").write_text("of the editor")
    paths, notes = find_films([folder, folder / "other.mp4"])
    assert [path.name for path in paths] == ["broken.mp4", "edited.mkv", "other.mp4"]
    assert "1 files are no films by their names" in notes[0]
    return make_films(paths, lambda _: None, folder / "work", StillsOptions())


def test_films_are_split_at_cuts_and_every_frame_is_accounted_for(films: Films) -> None:
    _, edited, other = films.outcomes
    first, second = edited.shots
    assert (first.frames, second.frames) == (32, 20)
    assert first.dropped["title"] == 5
    assert first.dropped["black"] == 3
    assert second.dropped["frozen"] == 6
    for shot in (*edited.shots, *other.shots):
        assert shot.frames == len(shot.keyframes) + sum(shot.dropped.values())
    # Nothing before the title's end, and nothing of the freeze.
    frames = [int(Path(name).stem) for name in (*first.keyframes, *second.keyframes)]
    assert min(frames) >= 5
    assert max(frames) <= 45
    assert not {17, 18, 19} & set(frames)


def test_a_film_that_cannot_be_read_is_named_and_stops_no_other(films: Films) -> None:
    broken, edited, other = films.outcomes
    assert (broken.status, broken.name) == ("refused", "broken")
    assert "found a file that begins with b'no film'" in broken.reason
    there = {str(file.relative_to(films.folder)) for file in films.folder.rglob("*.jpg")}
    assert there == {name for film in (edited, other) for shot in film.shots for name in shot.keyframes}


def test_a_cut_is_found_under_a_logo() -> None:
    """Its corners stay where they are across the cut."""
    logo = np.random.default_rng(5).integers(0, 2, (10, 24), dtype=np.uint8).repeat(4, 0).repeat(4, 1) * 255

    def frame(number: int, page: NDArray[np.uint8]) -> VideoFrame:
        gray = page[:, :, 0].copy()
        gray[190:230, 210:306] = logo
        return VideoFrame(index=number, time_s=number / 25.0, gray=gray, rgb=lambda: page)

    pages = [_scene(k // 8, k) for k in range(16)]
    motion = measure_motion([frame(k, page) for k, page in enumerate(pages)])
    assert np.flatnonzero(motion.cut).tolist() == [0, 8]
    assert set(motion.kind.tolist()) == {FrameKind.PICTURE}
