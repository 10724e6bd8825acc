"""Photos that hang on others by little, or may be further off than allowed, are named with their figures."""

from dataclasses import replace

import numpy as np

from ingest.growth.place.drift import PhotoSpread
from ingest.growth.place.refine import loose_photos, weak_photos
from tests.support.posed_models import model_of


def test_photos_that_hang_by_little_are_named_and_held_ones_are_not() -> None:
    model = model_of(range(100), range(50, 150), range(146, 246), range(146, 246))
    weak = weak_photos(model, [], [0])
    assert sorted(weak) == [2, 3]
    assert "4.0 % of its points" in weak[2][1]
    assert weak_photos(model, [], [0, 2]) == {}
    assert sorted(weak_photos(model, [3], [0])) == [2]  # one that is out already is not named again
    assert weak_photos(model_of(range(100), range(50, 150), range(120, 220)), [], [0]) == {}


def test_what_hangs_on_a_photo_that_is_left_out_hangs_on_nothing() -> None:
    model = model_of(range(100), range(50, 150), range(100, 200))
    assert weak_photos(model, [], [0]) == {}
    assert sorted(weak_photos(model, [1], [0])) == [2]


def spread_of(*sigmas_m: float) -> PhotoSpread:
    """Of photos that show their places so surely, NaN where they see nothing."""
    unknown = PhotoSpread.unknown(len(sigmas_m))
    return replace(unknown, shown=np.square(sigmas_m)[:, None, None] * np.eye(7))


def test_photos_beyond_the_bound_are_named() -> None:
    spread = spread_of(0.01, 0.3, 0.2)
    loose = loose_photos(spread, 0.5)
    assert list(loose) == [1]
    assert "what the photo shows may be 0.59 m off, 0.50 m are allowed" in loose[1][1]
    assert loose_photos(spread, 0.6) == {}


def test_photos_that_see_nothing_are_loose_unless_none_was_asked() -> None:
    assert list(loose_photos(spread_of(1e-3, np.nan), 0.5)) == [1]
    assert loose_photos(PhotoSpread.unknown(2), 0.5) == {}
