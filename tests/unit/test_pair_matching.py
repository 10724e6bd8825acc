"""Photos matched with each other: the strongest features first, the others where both show the same."""

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from ingest.sfm.matching import MatchOptions, mutual_matches, pair_matches

OPTIONS = MatchOptions(first_features=300)
SIDE = (1600, 1200)


def descriptors(count: int, seed: int) -> NDArray[np.uint8]:
    """As RootSIFT has them: of length 512."""
    found = np.random.default_rng(seed).gamma(0.6, size=(count, 128))
    return (
        np.round(512.0 * found / np.linalg.norm(found, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)
    )


def photo(xy: NDArray[np.float64], of: NDArray[np.uint8]) -> Features:
    count = len(xy)
    return Features(
        xy=xy.astype(np.float32),
        scale=np.ones(count, np.float32),
        angle=np.zeros(count, np.float32),
        response=np.linspace(1.0, 0.5, count, dtype=np.float32),
        descriptors=of,
        width=SIDE[0],
        height=SIDE[1],
        fingerprint="drawn",
    )


def scattered(
    count: int, seed: int, low: tuple[int, int] = (0, 0), high: tuple[int, int] = SIDE
) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(low, high, size=(count, 2))


def overlapping(common: int, others: int) -> tuple[Features, Features]:
    """The right half of the one is the left half of the other."""
    shared, xy = descriptors(common, 1), scattered(common, 2, (800, 0))
    found = []
    for seed, at, low, high in ((3, xy, (0, 0), (800, 1200)), (4, xy - [800, 0], (800, 0), SIDE)):
        of = np.concatenate([shared, descriptors(others, seed)])
        order = np.random.default_rng(seed).permutation(len(of))
        found.append(photo(np.concatenate([at, scattered(others, seed, low, high)])[order], of[order]))
    return found[0], found[1]


def test_what_all_features_have_in_common_is_found_where_both_photos_show_it() -> None:
    a, b = overlapping(common=500, others=1500)
    everything = mutual_matches(a.descriptors, b.descriptors, OPTIONS)
    found = pair_matches(a, b, OPTIONS)
    assert len(everything) >= 490
    assert {tuple(row) for row in found.tolist()} == {tuple(row) for row in everything.tolist()}


def test_the_rest_is_looked_for_in_the_common_part_only() -> None:
    a, b = overlapping(common=500, others=1500)
    far = int(np.flatnonzero(a.xy[:, 0] < 400)[-1])  # shown by the other photo in the place of something else
    near = int(np.flatnonzero(b.xy[:, 0] > 1300)[-1])
    drawn = b.descriptors.copy()
    drawn[near] = a.descriptors[far]
    b = photo(b.xy, drawn)
    assert [far, near] in mutual_matches(a.descriptors, b.descriptors, OPTIONS).tolist()
    assert [far, near] not in pair_matches(a, b, OPTIONS).tolist()


def test_photos_whose_strongest_features_have_nothing_in_common_are_not_matched_further() -> None:
    strong = photo(scattered(300, 5), descriptors(300, 5)), photo(scattered(300, 6), descriptors(300, 6))
    weak, xy = descriptors(500, 7), scattered(500, 8)
    a, b = (photo(np.concatenate([p.xy, xy]), np.concatenate([p.descriptors, weak])) for p in strong)
    assert len(mutual_matches(a.descriptors, b.descriptors, OPTIONS)) >= 490
    assert pair_matches(a, b, OPTIONS).shape == (0, 2)


def test_few_features_are_all_matched() -> None:
    a, b = overlapping(common=5, others=200)  # fewer than would be matched further
    found = pair_matches(a, b, OPTIONS)
    assert found.tolist() == mutual_matches(a.descriptors, b.descriptors, OPTIONS).tolist()
    assert len(found) == 5
