"""Choice of pairs: what must be there, what must not, and how many."""

import itertools
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.feature_map import GeoPrior
from ingest.photos.photo import Photo
from ingest.sfm.far_pairs import far_pairs
from ingest.sfm.pairs import PairOptions, choose_pairs, more_pairs
from tools.train_vocabulary import train_vocabulary

_FRAME = LocalFrame(latitude_deg=48.99, longitude_deg=8.41, height_m=100.0)


def _photo(
    number: int,
    east: float | None = None,
    north: float = 0.0,
    *,
    timed: bool = True,
    sigma_m: float = 3.0,
    owner: str = "",
) -> Photo:
    gps = None
    if east is not None:
        latitude, longitude, height = (float(v) for v in _FRAME.geodetic_from_enu([east, north, 50.0]))
        gps = GeoPrior(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            sigma_horizontal_m=sigma_m,
            sigma_vertical_m=5.0,
        )
    return Photo(
        name=f"{number:05d}.jpg",
        path=Path(f"{number:05d}.jpg"),
        capture_time=datetime(2026, 1, 1) + timedelta(seconds=number) if timed else None,
        gps=gps,
        owner=owner,
    )


def _grid(side: int, spacing_m: float = 20.0) -> list[Photo]:
    return [_photo(k, (k % side) * spacing_m, (k // side) * spacing_m) for k in range(side * side)]


def test_a_few_photos_are_matched_exhaustively() -> None:
    pairs = choose_pairs([_photo(k) for k in range(24)], None, PairOptions())
    assert len(pairs) == 24 * 23 // 2


def test_pairs_grow_linearly() -> None:
    options = PairOptions()
    per_photo = []
    for side in (8, 16, 32):
        photos = _grid(side)
        pairs = choose_pairs(photos, None, options)
        per_photo.append(len(pairs) / len(photos))
    assert max(per_photo) < options.gps_neighbours + options.time_neighbours
    assert per_photo[2] / per_photo[0] < 1.15


def test_neighbours_on_the_ground_are_paired_and_far_ones_are_not() -> None:
    side, spacing = 8, 20.0
    photos = _grid(side, spacing)
    pairs = set(choose_pairs(photos, None, PairOptions(time_neighbours=0)))
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
    pairs = choose_pairs(near + far, None, PairOptions())
    assert pairs
    assert all((i < 20) == (j < 20) for i, j in pairs)


def test_following_photos_are_paired_whatever_gps_says() -> None:
    photos = [_photo(k, 1_000.0 * k) for k in range(30)]
    pairs = choose_pairs(photos, None, PairOptions(time_neighbours=1))
    assert pairs == [(k, k + 1) for k in range(29)]


def _vectors(places: int, photos: int, seed: int = 0) -> NDArray[np.float16]:
    """Unit vectors of `photos` photos of each of some places; those of one place are noisy copies."""
    rng = np.random.default_rng(seed)
    at = np.repeat(rng.normal(size=(places, 64)), photos, axis=0)
    noisy = at + 0.3 * rng.normal(size=at.shape)
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True), dtype=np.float16)


def test_retrieval_pairs_photos_of_one_place() -> None:
    photos = [_photo(k, timed=False) for k in range(40)]
    pairs = choose_pairs(photos, _vectors(10, 4), PairOptions(retrieval_neighbours=3))
    assert pairs == [(i, j) for i in range(40) for j in range(i + 1, 40) if i // 4 == j // 4]


def test_photos_without_gps_are_tied_to_those_with() -> None:
    photos = [_photo(k, 5.0 * k) for k in range(30)] + [_photo(99, timed=False)]
    vectors = _vectors(31, 1)
    vectors[30] = vectors[7]
    assert (7, 30) in choose_pairs(photos, vectors, PairOptions(retrieval_neighbours=1))


def test_a_position_that_is_wrong_by_kilometres_is_no_obstacle() -> None:
    """Each place is a street of its own; one photo of each says that it is elsewhere."""
    photos = [
        _photo(k, 1_000.0 * (k // 4 + (37 if k % 4 == 3 else 0)), timed=False, sigma_m=sigma_m)
        for k, sigma_m in zip(range(40), itertools.cycle([4.0, 30.0]), strict=False)
    ]
    pairs = set(choose_pairs(photos, _vectors(10, 4), PairOptions(retrieval_neighbours=3, look_neighbours=3)))
    assert all((4 * place + k, 4 * place + 3) in pairs for place in range(10) for k in range(3))


def test_rough_positions_choose_by_look_within_their_reach() -> None:
    """Two hundred photos on one square: the nearest by a position of 30 m tell nothing."""
    rng = np.random.default_rng(3)
    photos = [_photo(k, *rng.normal(0.0, 40.0, 2).tolist(), timed=False, sigma_m=30.0) for k in range(200)]
    options = PairOptions(retrieval_neighbours=0, gps_neighbours=3)
    pairs = set(choose_pairs(photos, _vectors(50, 4), options))
    wanted = {(i, j) for i in range(200) for j in range(i + 1, 200) if i // 4 == j // 4}
    assert wanted <= pairs
    assert len(pairs) <= 200 * 3
    # Without their looks there is nothing better than the nearest.
    assert len(wanted & set(choose_pairs(photos, None, options))) < 0.2 * len(wanted)


def test_positions_are_believed_within_twice_their_deviation() -> None:
    photos = [
        _photo(k, 500.0 * k, timed=False, sigma_m=sigma) for k, sigma in enumerate([5.0] * 25 + [150.0])
    ]
    pairs = choose_pairs(photos, None, PairOptions())
    assert pairs == [(24, 25)]  # 500 m apart, 300 m of reach and twice 150 m


def test_time_ties_photos_of_one_owner_only() -> None:
    photos = [_photo(k, timed=True, owner="ab"[k % 2]) for k in range(30)]
    pairs = choose_pairs(photos, None, PairOptions(time_neighbours=1))
    assert pairs == [(k, k + 2) for k in range(28)]


def test_a_photo_that_all_find_similar_is_matched_with_a_bounded_number() -> None:
    vectors = _vectors(200, 1)
    vectors[17] = np.float16(1.0 / 8.0)  # alike to none
    blank = vectors + np.float16(0.5) * vectors[17]
    blank /= np.linalg.norm(blank.astype(np.float32), axis=1, keepdims=True)
    photos = [_photo(k, timed=False) for k in range(200)]
    pairs = choose_pairs(photos, blank, PairOptions(pairs_per_photo=20))
    degree = np.bincount(np.array(pairs).ravel(), minlength=200)
    assert degree.max() == 20
    assert degree.min() >= 1


def test_photos_that_overlap_the_same_others_are_tried_next() -> None:
    chain = {(k, k + 1): 100 for k in range(29)} | {(0, 2): 30}
    found = more_pairs(30, chain, [*chain, (5, 7)], PairOptions())
    assert set(found) == {(k, k + 2) for k in range(1, 28) if k != 5} | {(0, 3)}
    assert more_pairs(20, chain, chain, PairOptions()) == []  # all pairs were matched anyway


def test_a_vocabulary_tells_places_apart_and_is_the_same_every_time() -> None:
    rng = np.random.default_rng(0)
    photos = []
    for _ in range(10):
        words = rng.gamma(0.5, 30.0, (80, 128))
        for _ in range(4):
            noisy = words * rng.lognormal(0.0, 0.15, words.shape)
            length = np.maximum(np.linalg.norm(noisy, axis=1, keepdims=True), 1e-9)
            photos.append(np.clip(512 * noisy / length, 0, 255).astype(np.uint8))
    vocabulary = train_vocabulary(photos, words=16, dimensions=32)
    assert train_vocabulary(photos, words=16, dimensions=32).digest == vocabulary.digest
    assert train_vocabulary(photos, words=16, dimensions=32, seed=1).digest != vocabulary.digest
    vectors = np.array([vocabulary.aggregate(p) for p in photos])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-6)
    cosines = vectors @ vectors.T
    np.fill_diagonal(cosines, -1.0)
    assert [k // 4 for k in np.argmax(cosines, axis=1)] == [k // 4 for k in range(40)]
    assert not vocabulary.aggregate(np.zeros((0, 128), np.uint8)).any()


def test_no_photo_is_paired_with_itself_and_none_twice() -> None:
    photos = [_photo(k, 0.0) for k in range(30)]  # all at one place
    pairs = choose_pairs(photos, None, PairOptions())
    assert len(set(pairs)) == len(pairs)
    assert all(i < j for i, j in pairs)


def test_keyframes_look_beyond_their_own_shot() -> None:
    """Two films along one street: each keyframe is most like its neighbours in its own film."""
    photos = [replace(_photo(k, timed=False), film=film, camera_key=film) for film in "ab" for k in range(20)]
    street = _vectors(20, 1).astype(np.float64)
    street += 0.9 * np.roll(street, 1, axis=0)
    own = [street + 2.0 * _vectors(1, 1, seed) for seed in (1, 2)]
    vectors = np.concatenate([v / np.linalg.norm(v, axis=1, keepdims=True) for v in own]).astype(np.float16)
    options = PairOptions(retrieval_neighbours=2, other_shots=1, time_neighbours=1)
    pairs = choose_pairs(photos, vectors, options)
    assert {(k, k + 20) for k in range(20)} <= set(pairs)
    assert {(k, k + 1) for k in range(19)} <= set(pairs)
    assert not {(k, k + 20) for k in range(20)} & set(
        choose_pairs(photos, vectors, replace(options, other_shots=0))
    )


def _overlapping(side: int) -> dict[tuple[int, int], int]:
    """Verified matches of a grid's photos with those up to two rows and columns away."""
    return {
        (i, j): 300 // max(abs(i % side - j % side), abs(i // side - j // side))
        for i, j in itertools.combinations(range(side * side), 2)
        if max(abs(i % side - j % side), abs(i // side - j // side)) <= 2
    }


def test_pairs_that_look_alike_far_apart_go() -> None:
    right = _overlapping(12)
    alike = {(0, 140): 90, (3, 130): 40, (15, 143): 25}  # 200 m and more
    assert far_pairs(_grid(12), right | alike) == alike.keys()


def test_a_photo_with_a_wrong_position_keeps_its_pairs() -> None:
    photos = _grid(12)
    photos[30] = _photo(30, 9000.0, -4000.0)
    right = _overlapping(12)
    assert not far_pairs(photos, right)
    assert far_pairs(photos, right | {(0, 140): 90}) == {(0, 140)}


def test_positions_that_are_all_wrong_cost_no_photo_more_than_half() -> None:
    rng = np.random.default_rng(0)
    photos = [_photo(k, *rng.uniform(0.0, 2000.0, 2).tolist()) for k in range(144)]
    inliers = _overlapping(12)
    total, lost = np.zeros(144), np.zeros(144)
    far = far_pairs(photos, inliers)
    for pair, count in inliers.items():
        total[list(pair)] += count
        lost[list(pair)] += count * (pair in far)
    assert (lost <= 0.5 * total).all()


def test_photos_of_few_pairs_and_without_positions_keep_them() -> None:
    apart = {(0, 11): 100, (11, 143): 100}  # each is all that one of its photos has
    assert not far_pairs(_grid(12), apart)
    untagged = [_photo(k) for k in range(144)]
    assert not far_pairs(untagged, _overlapping(12) | {(0, 140): 90})
