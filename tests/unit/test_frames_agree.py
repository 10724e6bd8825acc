"""Which frames send a map to the same place."""

import numpy as np
import pytest

from featuredb.geometry.sim3 import Sim3
from ingest.register.anchor.frames import LoneFrame, frames_that_agree


def lone(image_id: int, east_m: float = 0.0, turn_rad: float = 0.0) -> LoneFrame:
    points = np.random.default_rng(image_id).uniform([-20, -20, 0], [20, 20, 5], (50, 3))
    sim = Sim3.exp([0.0, 0.0, 0.0, turn_rad, east_m, 0.0, 8.0])
    return LoneFrame(image_id=image_id, new_from_old=sim, points=points, distance_m=50.0)


def test_frames_within_the_bend_of_a_map_agree() -> None:
    found = frames_that_agree([lone(1), lone(2, 0.4), lone(3, -0.5)])
    assert found.agreeing == (1, 2, 3)
    assert found.apart_m[1, 2] == pytest.approx((0.4, 1.5), abs=1e-6)


def test_the_majority_outvotes_a_wrong_frame() -> None:
    found = frames_that_agree([lone(1), lone(2, 12.0), lone(3, 0.3)])
    assert found.agreeing == (1, 3)
    metres, allowed = found.apart_m[1, 2]
    assert metres > allowed


def test_two_that_disagree_carry_nothing() -> None:
    assert frames_that_agree([lone(1), lone(2, 12.0)]).agreeing == ()
    four = [lone(1), lone(2), lone(3, 12.0), lone(4, 12.0)]
    assert frames_that_agree(four).agreeing == ()


def test_a_turn_is_a_disagreement_too() -> None:
    # 10 degrees at up to 28 m from the middle: 2.7 m in the median.
    assert frames_that_agree([lone(1), lone(2, turn_rad=0.17)]).agreeing == ()


def test_a_chain_in_which_the_ends_disagree_keeps_the_closer_pair() -> None:
    found = frames_that_agree([lone(1), lone(2, 1.0), lone(3, 2.2)])
    assert found.agreeing == (1, 2)


def test_one_frame_agrees_with_itself_and_none_is_none() -> None:
    assert frames_that_agree([lone(4)]).agreeing == (4,)
    assert frames_that_agree([]).agreeing == ()
