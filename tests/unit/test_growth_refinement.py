"""Photos that hang on others by little are named with their figures."""

from ingest.growth.place.refine import weak_photos
from tests.support.posed_models import model_of


def test_photos_that_hang_by_little_are_named_and_held_ones_are_not() -> None:
    model = model_of(range(100), range(50, 150), range(146, 246), range(146, 246))
    weak = weak_photos(model, [], [0])
    assert sorted(weak) == [2, 3]
    assert "4.0 % of its points" in weak[2]
    assert weak_photos(model, [], [0, 2]) == {}
    assert sorted(weak_photos(model, [3], [0])) == [2]  # one that is out already is not named again
    assert weak_photos(model_of(range(100), range(50, 150), range(120, 220)), [], [0]) == {}


def test_what_hangs_on_a_photo_that_is_left_out_hangs_on_nothing() -> None:
    model = model_of(range(100), range(50, 150), range(100, 200))
    assert weak_photos(model, [], [0]) == {}
    assert sorted(weak_photos(model, [1], [0])) == [2]
