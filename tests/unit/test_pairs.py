"""Choice of pairs: what must be there, what must not, and how many."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.feature_map import GeoPrior
from ingest.pairs import PairOptions, aggregate, choose_pairs
from ingest.photo import Photo

_FRAME = LocalFrame(latitude_deg=48.99, longitude_deg=8.41, height_m=100.0)
_NOTHING = np.zeros((0, 128), np.uint8)


def _photo(number: int, east: float | None = None, north: float = 0.0, *, timed: bool = True) -> Photo:
    gps = None
    if east is not None:
        latitude, longitude, height = (float(v) for v in _FRAME.geodetic_from_enu([east, north, 50.0]))
        gps = GeoPrior(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            sigma_horizontal_m=3.0,
            sigma_vertical_m=5.0,
        )
    return Photo(
        name=f"{number:05d}.jpg",
        path=Path(f"{number:05d}.jpg"),
        capture_time=datetime(2026, 1, 1) + timedelta(seconds=number) if timed else None,
        gps=gps,
    )


def _grid(side: int, spacing_m: float = 20.0) -> list[Photo]:
    return [_photo(k, (k % side) * spacing_m, (k // side) * spacing_m) for k in range(side * side)]


def test_a_few_photos_are_matched_exhaustively() -> None:
    pairs = choose_pairs([_photo(k) for k in range(24)], [_NOTHING] * 24, PairOptions())
    assert len(pairs) == 24 * 23 // 2


def test_pairs_grow_linearly() -> None:
    options = PairOptions()
    per_photo = []
    for side in (8, 16, 32):
        photos = _grid(side)
        pairs = choose_pairs(photos, [_NOTHING] * len(photos), options)
        per_photo.append(len(pairs) / len(photos))
    assert max(per_photo) < options.gps_neighbours + options.time_neighbours
    assert per_photo[2] / per_photo[0] < 1.15


def test_neighbours_on_the_ground_are_paired_and_far_ones_are_not() -> None:
    side, spacing = 8, 20.0
    photos = _grid(side, spacing)
    pairs = set(choose_pairs(photos, [_NOTHING] * len(photos), PairOptions(time_neighbours=0)))
    for k in range(side * side):
        if k % side < side - 1:
            assert (k, k + 1) in pairs
        if k // side < side - 1:
            assert (k, k + side) in pairs
    distances = [spacing * np.hypot(i % side - j % side, i // side - j // side) for i, j in pairs]
    assert max(distances) < 5 * spacing


def test_no_pair_beyond_the_radius() -> None:
    near = [_photo(k, 10.0 * k, timed=False) for k in range(20)]
    far = [_photo(100 + k, 10_000.0 + 10.0 * k, timed=False) for k in range(20)]
    pairs = choose_pairs(near + far, [_NOTHING] * 40, PairOptions())
    assert pairs
    assert all((i < 20) == (j < 20) for i, j in pairs)


def test_following_photos_are_paired_whatever_gps_says() -> None:
    photos = [_photo(k, 1_000.0 * k) for k in range(30)]
    pairs = choose_pairs(photos, [_NOTHING] * 30, PairOptions(time_neighbours=1))
    assert pairs == [(k, k + 1) for k in range(29)]


def test_retrieval_pairs_photos_of_one_place() -> None:
    """Ten places, four photos each: descriptors of one place are noisy copies of each other."""
    rng = np.random.default_rng(0)
    descriptors: list[NDArray[np.uint8]] = []
    for _ in range(10):
        words = rng.gamma(0.5, 30.0, (80, 128))
        for _ in range(4):
            noisy = words * rng.lognormal(0.0, 0.15, words.shape)
            length = np.maximum(np.linalg.norm(noisy, axis=1, keepdims=True), 1e-9)
            descriptors.append(np.clip(512 * noisy / length, 0, 255).astype(np.uint8))
    photos = [_photo(k, timed=False) for k in range(40)]
    options = PairOptions(retrieval_neighbours=3, codebook_size=16)
    pairs = set(choose_pairs(photos, descriptors, options))
    wanted = {(i, j) for i in range(40) for j in range(i + 1, 40) if i // 4 == j // 4}
    assert len(wanted & pairs) / len(wanted) > 0.95
    assert len(pairs) <= 40 * 3
    np.testing.assert_allclose(np.linalg.norm(aggregate(descriptors, options), axis=1), 1.0)


def test_photos_without_gps_are_tied_to_those_with() -> None:
    rng = np.random.default_rng(1)
    photos = [_photo(k, 5.0 * k) for k in range(30)] + [_photo(99, timed=False)]
    descriptors = [rng.integers(0, 90, (50, 128)).astype(np.uint8) for _ in range(30)]
    pairs = choose_pairs(photos, [*descriptors, descriptors[7]], PairOptions(codebook_size=8))
    assert (7, 30) in pairs


def test_no_photo_is_paired_with_itself_and_none_twice() -> None:
    photos = [_photo(k, 0.0) for k in range(30)]  # all at one place
    pairs = choose_pairs(photos, [_NOTHING] * 30, PairOptions())
    assert len(set(pairs)) == len(pairs)
    assert all(i < j for i, j in pairs)
