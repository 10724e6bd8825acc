"""Watermarks and copies, told from photos of one place by the way their matches move."""

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.maps.feature_map import GeoPrior
from ingest.photos.duplicates import MAX_BITS, copies_of, near_duplicates
from ingest.photos.photo import Photo
from ingest.sfm.matching import Matched
from ingest.sfm.overlays import is_copy, without_overlay

_SIZE = (1600, 1200)


def _spread(count: int, seed: int, size: tuple[int, int] = _SIZE) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(0, size, (count, 2)).astype(np.float32)


def _pairs(count: int) -> NDArray[np.uint32]:
    return np.stack([np.arange(count), np.arange(count)], axis=1).astype(np.uint32)


def test_a_watermark_is_dropped_and_the_rest_stays() -> None:
    scene = _spread(60, 0)
    mark = np.array([1400, 1130], np.float32) + _spread(30, 1, (150, 40))
    a = np.concatenate([scene, mark])
    b = np.concatenate([scene + np.float32([35, -12]), mark + np.float32(0.4)])
    kept = without_overlay(a, b, _SIZE, _SIZE, _pairs(90))
    assert kept[:, 0].tolist() == list(range(60))


def test_photos_that_share_a_watermark_only_share_nothing() -> None:
    mark = np.array([1400, 1130], np.float32) + _spread(80, 1, (150, 40))
    assert not len(without_overlay(mark, mark, _SIZE, _SIZE, _pairs(80)))


def test_a_camera_that_stands_still_keeps_its_matches() -> None:
    scene = _spread(200, 2)
    assert len(without_overlay(scene, scene + np.float32(0.3), _SIZE, _SIZE, _pairs(200))) == 200


def test_nothing_stands_still_between_photos_of_two_sizes() -> None:
    mark = _spread(80, 1, (150, 40))
    assert len(without_overlay(mark, mark, _SIZE, (800, 600), _pairs(80))) == 80


@pytest.mark.parametrize(
    ("scale", "shift", "size"),
    [(1.0, (0.0, 0.0), _SIZE), (0.5, (0.0, 0.0), (800, 600)), (1.0, (-160.0, -90.0), (1280, 1020)),
     (0.6, (40.0, 40.0), (1040, 800))],
    ids=["the same", "half the size", "cut", "framed"],
)  # fmt: skip
def test_copies_are_told(scale: float, shift: tuple[float, float], size: tuple[int, int]) -> None:
    a = _spread(400, 3).astype(np.float64)
    noise = np.random.default_rng(4).normal(0, 0.4, a.shape)
    b = scale * a + shift + noise
    seen = ((b > 0) & (b < size)).all(axis=1)
    assert is_copy(a[seen], b[seen], _SIZE, size)


@pytest.mark.parametrize("kind", ["neighbour on flat ground", "turned", "relief", "few"])
def test_neighbours_are_no_copies(kind: str) -> None:
    a = _spread(30 if kind == "few" else 400, 5).astype(np.float64)
    b = a.copy()
    if kind == "neighbour on flat ground":
        b = a + np.array([320.0, 0.0])  # 80 % of overlap
    elif kind == "turned":
        turn = np.radians(3.0)
        b = (a - 600) @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + 600
    elif kind == "relief":
        b = a + np.random.default_rng(6).normal(0, 8, a.shape)
    seen = ((b > 0) & (b < _SIZE)).all(axis=1)
    assert not is_copy(a[seen], b[seen], _SIZE, _SIZE)


def _photo(name: str, owner: str, width: int = 1600, **more: object) -> Photo:
    return Photo(name=name, path=Path(name), width=width, height=width * 3 // 4, owner=owner, **more)  # type: ignore[arg-type]


def test_of_copies_by_several_owners_the_largest_is_kept() -> None:
    photos = [
        _photo("a", "ann"),
        _photo("b", "bob", 2000),
        _photo("c", "cy"),
        _photo("d", "ann"),
        _photo("e", "ann"),
    ]
    matched = Matched(inliers={}, files={}, copies=frozenset({(0, 1), (0, 2), (3, 4)}))
    assert copies_of(photos, matched) == {0: 1, 2: 1}  # ann may stand still


def _gps(latitude: float) -> GeoPrior:
    return GeoPrior(
        latitude_deg=latitude, longitude_deg=8.0, height_m=None, sigma_horizontal_m=30, sigma_vertical_m=30
    )


def test_an_upload_with_another_place_and_time_is_still_a_copy() -> None:
    hashes = ["00" * 32, "00" * 31 + "07"]
    for hint in (True, False):
        photos = [
            _photo("a", "ann", gps=_gps(48.0), gps_is_hint=hint, capture_time=datetime(2026, 1, 1)),
            _photo("b", "bob", gps=_gps(48.1), gps_is_hint=hint, capture_time=datetime(2026, 2, 1)),
        ]
        found = near_duplicates(photos, hashes)
        assert found == ({"b": ("a", 3)} if hint else {})


def test_near_duplicates_are_those_of_an_exhaustive_search() -> None:
    rng = np.random.default_rng(7)
    bits = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    for k in range(0, 300, 3):  # every third is the one before with some bits turned
        flips = np.zeros(256, np.uint8)
        flips[rng.choice(256, rng.integers(0, 40), replace=False)] = 1
        bits[k] = bits[k - 1] ^ np.packbits(flips)
    photos = [_photo(f"{k:03d}", "ann") for k in range(300)]
    found = near_duplicates(photos, [b.tobytes().hex() for b in bits])
    kept: list[int] = []
    wanted = {}
    for i in range(300):
        near = [(int(np.bitwise_count(bits[i] ^ bits[k]).sum()), k) for k in kept]
        best = min(near, default=(999, -1))
        if best[0] <= MAX_BITS:
            wanted[photos[i].name] = (photos[best[1]].name, best[0])
        else:
            kept.append(i)
    assert found == wanted
    assert 40 < len(wanted) < 80
