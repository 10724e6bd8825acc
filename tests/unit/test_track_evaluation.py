"""What the program that measures tracked films takes for good, and for bad."""

from tools.track_evaluation import film_options


def test_only_one_film_is_cut() -> None:
    assert film_options("cut", "short", 1, 100).cut == (40, 55)
    assert film_options("smooth", "short", 1, 100).cut is None
    assert film_options("jerky", "short", 1, 100).path.style == "jerky"
