"""Ways in words: length and wind."""

import pytest

from featuredb.geo.words import way_words


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ((50_000.0, 0.0), "50.0 km to the east"),
        ((-30.0, 40.0), "50 m to the north-west"),
        ((0.0, -999.6), "1000 m to the south"),
        ((-1e4, 100.0), "10.0 km to the west"),
        ((-1.0, 1e4), "10.0 km to the north"),
    ],
)
def test_a_way_has_a_length_and_a_wind(way: tuple[float, float], words: str) -> None:
    assert way_words(*way) == words
