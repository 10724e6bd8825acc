"""The paper's film: errors of a tracked film by quarters, and which frame a keyframe is."""

import math

import numpy as np
import pytest

from tools.paper import frame_of, track_figures


def test_quarters_of_a_film_and_its_lost_frames() -> None:
    metres = np.concatenate([np.full(10, 0.1), np.full(20, 0.2), np.full(10, 0.3)])
    metres[[3, 25, 39]] = math.nan
    figures = track_figures(metres)
    assert figures["lost"] == 3
    assert (figures["first_m"], figures["last_m"]) == pytest.approx((0.1, 0.3))
    assert figures["last_over_first"] == pytest.approx(3.0)


def test_a_keyframe_is_the_frame_of_its_name() -> None:
    assert (frame_of("film/000123.jpg"), frame_of("000007.jpg")) == (123, 7)
