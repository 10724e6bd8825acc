"""Tiles: names, bounds, boxes and refusals by hand; the partition's laws are in the property tests."""

import numpy as np
import pytest

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.tiles import TILE_SIZE_M, tile_bounds, tile_of, tiles_touching


def test_names_and_bounds_by_hand() -> None:
    assert TILE_SIZE_M == 512.0
    names = tile_of(np.array([[512.0 * 1262 + 1, 512.0 * 10604 + 2, 100.0], [0.0, 0.0, 0.0]]))
    assert names.tolist() == ["E001262_N010604", "E000000_N000000"]
    assert tile_bounds("E001262_N010604") == (646144.0, 5429248.0, 646656.0, 5429760.0)


def test_tiles_are_half_open() -> None:
    below = np.nextafter(646144.0, 0.0)
    names = tile_of([[646144.0, 5429248.0], [below, 5429248.0], [646144.0, np.nextafter(5429248.0, 0.0)]])
    assert names.tolist() == ["E001262_N010604", "E001261_N010604", "E001262_N010603"]


def test_south_of_the_equator_in_a_northern_zone() -> None:
    assert tile_of([[500000.0, -0.1], [500000.0, -513.0]]).tolist() == ["E000976_N-00001", "E000976_N-00002"]
    assert tile_bounds("E000976_N-00001") == (499712.0, -512.0, 500224.0, 0.0)


def test_boxes() -> None:
    assert tiles_touching(10.0, 10.0, 10.0, 10.0) == ["E000000_N000000"]
    assert tiles_touching(10.0, 500.0, 600.0, 520.0) == [
        "E000000_N000000",
        "E000000_N000001",
        "E000001_N000000",
        "E000001_N000001",
    ]
    # The box is closed: a point on its upper edge belongs to the next tile.
    assert tiles_touching(0.0, 0.0, 512.0, 511.0) == ["E000000_N000000", "E000001_N000000"]


@pytest.mark.parametrize(
    "tile",
    [
        "",
        "E001262",
        "E1262_N10604",
        "E001262_N010604 ",
        "N010604_E001262",
        "E-001262_N010604",
        "e001262_n010604",
    ],
)
def test_other_names_are_refused(tile: str) -> None:
    with pytest.raises(InvalidValueError, match="tile's name"):
        tile_bounds(tile)


def test_bad_points_and_boxes_are_refused() -> None:
    for bad in (np.zeros(3), np.zeros((2, 1)), np.zeros((2, 4)), [[np.nan, 0.0]], [[np.inf, 0.0]]):
        with pytest.raises(InvalidValueError, match="tiles"):
            tile_of(bad)
    with pytest.raises(GeodesyError, match="no UTM"):
        tile_of([[1e12, 0.0]])
    with pytest.raises(InvalidValueError, match="minimum easting"):
        tiles_touching(600.0, 0.0, 10.0, 100.0)
    with pytest.raises(InvalidValueError, match="smaller area"):
        tiles_touching(0.0, 0.0, 1e6, 1e7)


def test_no_points_no_tiles() -> None:
    assert tile_of(np.empty((0, 3))).shape == (0,)
