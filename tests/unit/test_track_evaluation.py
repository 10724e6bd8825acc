"""What the program that measures tracked films takes for good, and for bad."""

from tools.paper import frame_of
from tools.track_evaluation import film_options


def test_only_one_film_is_cut() -> None:
    assert film_options("cut", 100).cut == (40, 55)
    assert film_options("smooth", 100).cut is None
    assert film_options("jerky", 100).path.style == "jerky"


def test_a_keyframe_is_the_frame_of_its_name() -> None:
    assert (frame_of("film/000123.jpg"), frame_of("000007.jpg")) == (123, 7)
