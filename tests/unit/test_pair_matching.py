"""Photos matched with each other: the strongest features first, the others along their epipolar lines."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import TwoView
from ingest.sfm.pair_geometry import MatchOptions, guided_matches, mutual_matches, pair_geometry

OPTIONS = MatchOptions(first_features=300)
SIDE = (1600, 1200)
CAMERA = Camera.from_focal(*SIDE, 1500.0)


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


def pairs_of(view: TwoView) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in view.inliers}


def verified(a: Features, b: Features) -> TwoView:
    return pair_geometry(a, b, (CAMERA, CAMERA), True, OPTIONS)


def test_what_all_features_have_in_common_is_found_where_both_photos_show_it() -> None:
    a, b = overlapping(common=500, others=1500)
    everything = mutual_matches(a.descriptors, b.descriptors, OPTIONS)
    assert len(everything) >= 490
    assert pairs_of(verified(a, b)) == {tuple(row) for row in everything.tolist()}


def test_the_rest_is_looked_for_along_the_epipolar_lines_of_the_first() -> None:
    a, b = overlapping(common=500, others=1500)
    first = pair_geometry(a, b, (CAMERA, CAMERA), True, replace(OPTIONS, first_features=2000))
    shared = first.inliers[b.xy[first.inliers[:, 1], 1] < 300][-1]
    moved = b.xy.copy()
    moved[shared[1]] += [0.0, 600.0]  # across its line, which is a row of pixels
    b = replace(b, xy=moved)
    assert shared.tolist() in mutual_matches(a.descriptors, b.descriptors, OPTIONS).tolist()
    assert shared.tolist() not in guided_matches(a, b, first, (CAMERA, CAMERA), OPTIONS).tolist()
    moved[shared[1]] -= [0.0, 590.0]  # within the band
    b = replace(b, xy=moved)
    assert shared.tolist() in guided_matches(a, b, first, (CAMERA, CAMERA), OPTIONS).tolist()


def test_photos_whose_strongest_features_have_nothing_in_common_are_not_matched_further() -> None:
    strong = photo(scattered(300, 5), descriptors(300, 5)), photo(scattered(300, 6), descriptors(300, 6))
    weak, xy = descriptors(500, 7), scattered(500, 8)
    a, b = (photo(np.concatenate([p.xy, xy]), np.concatenate([p.descriptors, weak])) for p in strong)
    assert len(mutual_matches(a.descriptors, b.descriptors, OPTIONS)) >= 490
    assert not pairs_of(verified(a, b))


def test_few_features_are_all_matched() -> None:
    a, b = overlapping(common=30, others=200)  # fewer than would be matched further
    everything = mutual_matches(a.descriptors, b.descriptors, OPTIONS)
    assert pairs_of(verified(a, b)) == {tuple(row) for row in everything.tolist()}
    assert len(everything) == 30
