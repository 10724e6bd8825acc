"""Vertical datums: names are checked, and nothing is converted by assuming zero."""

import pytest

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.datum import HEIGHT_DATUMS, HeightConversion, check_datum, ellipsoidal_height


def test_names_are_checked() -> None:
    assert [check_datum(name) for name in HEIGHT_DATUMS] == list(HEIGHT_DATUMS)
    for name in ("EGM96", "", "geoid", "msl", "wgs84"):
        with pytest.raises(InvalidValueError, match="height datum"):
            check_datum(name)


def test_ellipsoidal_heights_stay() -> None:
    assert ellipsoidal_height(49.0, 8.4, 123.25, "ellipsoidal") == HeightConversion(height_m=123.25)


def test_unknown_datum_is_not_convertible() -> None:
    answer = ellipsoidal_height(49.0, 8.4, 123.25, "unknown")
    assert answer.height_m is None
    assert "unknown" in answer.reason


@pytest.mark.parametrize("datum", ["egm96", "egm2008", "navd88"])
def test_missing_grid_is_said_and_not_guessed(datum: str) -> None:
    answer = ellipsoidal_height(40.0, -105.0, 1600.0, datum, grid_directories=())
    assert answer.height_m is None
    assert "not installed" in answer.reason
    assert "projsync --file us_n" in answer.reason


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="height datum"):
        ellipsoidal_height(49.0, 8.4, 100.0, "sea level")
    with pytest.raises(GeodesyError):
        ellipsoidal_height(149.0, 8.4, 100.0, "ellipsoidal")
    with pytest.raises(InvalidValueError, match="finite"):
        ellipsoidal_height(49.0, 8.4, float("nan"), "ellipsoidal")


def test_an_answer_is_a_height_or_a_reason() -> None:
    for height, reason in ((None, ""), (3.0, "why")):
        with pytest.raises(InvalidValueError):
            HeightConversion(height_m=height, reason=reason)
