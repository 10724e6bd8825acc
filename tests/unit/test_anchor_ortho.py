"""A picture from above is found by its edges in one of other brightness, and its mirror image is not."""

import cv2
import numpy as np
import pytest

from ingest.register.anchor.start import from_ortho
from ingest.register.anchor.start.from_ortho import best_place
from ingest.register.anchor.start.ortho import FloatImage, OrthoPicture

_SIDE, _CELL_M = 220, 1.1
_TURN, _SIZE_M = np.radians(131.0), 0.62  # of the cells of the map's picture
_AT = np.array([128.0, 104.0])  # its middle on the scan, cells


def _town(seed: int) -> FloatImage:
    """Ground, streets and roofs, each of a brightness of its own."""
    rng = np.random.default_rng(seed)
    picture = np.full((_SIDE, _SIDE), 90.0, np.float32)
    for _ in range(9):
        start, end = rng.integers(0, _SIDE, (2, 2))
        cv2.line(picture, start.tolist(), end.tolist(), float(rng.uniform(20, 60)), 5)
    for _ in range(60):
        center, size = rng.uniform(0, _SIDE, 2).tolist(), rng.uniform(8, 22, 2).tolist()
        roof = cv2.boxPoints((center, size, float(rng.uniform(0, 90))))
        cv2.fillPoly(picture, [np.round(roof).astype(np.int32)], float(rng.uniform(100, 250)))
    return picture


def _picture(gray: FloatImage, cell: float) -> OrthoPicture:
    valid = np.ones(gray.shape, np.bool_)
    return OrthoPicture(
        gray=gray, valid=valid, height=np.zeros(gray.shape), corner=np.array([40.0, -7.0]), cell=cell
    )


def _of_photos(town: FloatImage, side: int = 130) -> OrthoPicture:
    """A part of the town turned and in finer cells, bright where the scan is dark and in between."""
    cos, sin = np.cos(_TURN) * _SIZE_M / _CELL_M, np.sin(_TURN) * _SIZE_M / _CELL_M
    turn = np.array([[cos, -sin], [sin, cos]])
    whole = np.column_stack([turn, _AT - turn @ [side / 2, side / 2]])
    whole[:, 2] += turn @ [0.5, 0.5] - 0.5  # OpenCV's half pixel
    part = cv2.warpAffine(town, whole, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    noise = np.random.default_rng(5).normal(0.0, 4.0, part.shape)
    return _picture(np.asarray(np.abs(part - 140.0) + noise, np.float32), cell=0.3)


@pytest.fixture(autouse=True)
def _few_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(from_ortho, "_LEAST_SHARE", 0.25)
    monkeypatch.setattr(from_ortho, "_SIZE_STEP", 0.09)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_picture_is_found_by_its_edges(seed: int) -> None:
    town = _town(seed)
    found = best_place(_of_photos(town), _picture(town, _CELL_M))
    assert found is not None
    assert found.over_chance > 1.5 * found.elsewhere
    assert found.size == pytest.approx(_SIZE_M, rel=0.04)
    assert np.degrees(found.turn) % 360.0 == pytest.approx(131.0, abs=3.0)
    assert np.linalg.norm(found.middle - ([40.0, -7.0] + _AT * _CELL_M)) < 3.0


def test_a_mirrored_picture_is_not_found() -> None:
    town = _town(1)
    found = best_place(_of_photos(town).mirrored(), _picture(town, _CELL_M))
    assert found is not None
    assert found.over_chance < found.elsewhere


def test_a_picture_that_is_larger_than_the_scan_fits_nowhere() -> None:
    town = _town(1)
    assert best_place(_of_photos(town), _picture(np.ascontiguousarray(town[:40, :]), _CELL_M)) is None
