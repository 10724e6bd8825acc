"""What the program that measures tracked films takes for good, and for bad."""

import cv2
import numpy as np

from tools.drawn_layer import marks_of
from tools.track_evaluation import film_options
from tools.video_map import frame_of


def test_only_one_film_is_cut() -> None:
    assert film_options("cut", 100).cut == (40, 55)
    assert film_options("smooth", 100).cut is None
    assert film_options("jerky", 100).path.style == "jerky"


def test_a_keyframe_is_the_frame_of_its_name() -> None:
    assert (frame_of("film/000123.jpg"), frame_of("000007.jpg")) == (123, 7)


def test_marks_are_as_far_from_their_places_as_they_were_drawn() -> None:
    """The ring around (100.5, 80.5) is drawn 3 px to the right; where (200, 40) belongs nothing is."""
    changed = np.zeros((160, 320, 3), np.uint8)
    cv2.circle(changed, (103, 80), 4, (200, 200, 200), 1, cv2.LINE_AA)
    pixels = np.array([[100.5, 80.5], [200.0, 40.0], [np.nan, np.nan]])
    (off,), stray = marks_of(changed.max(axis=2).astype(float), pixels)
    assert abs(off - 3.0) < 0.1
    assert stray == 0
    cv2.circle(changed, (250, 120), 4, (200, 200, 200), 1, cv2.LINE_AA)
    assert marks_of(changed.max(axis=2).astype(float), pixels)[1] == 1
