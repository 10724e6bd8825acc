"""The paper's rows: errors of a tracked film by quarters, and which frame a keyframe is."""

import math

import numpy as np
import pytest

from tools.paper import film_lines, frame_of, track_figures


def test_quarters_of_a_film_and_its_lost_frames() -> None:
    metres = np.concatenate([np.full(10, 0.1), np.full(20, 0.2), np.full(10, 0.3)])
    metres[[3, 25, 39]] = math.nan
    figures = track_figures(metres)
    assert figures["lost"] == 3
    assert (figures["first_m"], figures["last_m"]) == pytest.approx((0.1, 0.3))
    assert figures["last_over_first"] == pytest.approx(3.0)
    more = {"adjusted_m": 0.05, "rate_hz": 40.0, "frame_s": 5.0, "projection_s": 0.4, "keyframes": 30}
    rows = {line.what: line for line in film_lines(figures | more | {"made_s": 100.0}, 40)}
    assert rows["tracked centres over 40 frames"].ours.startswith("0.200 m mean, 0.30 m at most, 3 lost")
    assert rows["the same, from a bundle adjustment"].paper == "0.4 m"


def test_a_keyframe_is_the_frame_of_its_name() -> None:
    assert (frame_of("film/000123.jpg"), frame_of("000007.jpg")) == (123, 7)
