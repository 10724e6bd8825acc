"""Matches against a plain search in float64, and verification against a known geometry."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap_bridge import verify_pair
from ingest.matching import MatchOptions, mutual_matches

_CAMERA = Camera(model="SIMPLE_RADIAL", width=1600, height=1200, params=(1400.0, 800.0, 600.0, 0.02))


def _descriptors(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    raw = rng.gamma(0.4, 1.0, (count, 128))
    return np.clip(np.rint(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))), 0, 255).astype(np.uint8)


def _plain(a: NDArray[np.uint8], b: NDArray[np.uint8], options: MatchOptions) -> set[tuple[int, int]]:
    chords = np.linalg.norm(a[:, None].astype(float) - b[None].astype(float), axis=2)
    angles = 2 * np.arcsin(chords / 1024)
    found = set()
    for i in range(len(a)):
        j = int(angles[i].argmin())
        ahead, back = np.sort(angles[i]), np.sort(angles[:, j])
        good = int(angles[:, j].argmin()) == i and ahead[0] <= options.max_angle_rad
        if good and ahead[0] < options.max_ratio * ahead[1] and back[0] < options.max_ratio * back[1]:
            found.add((i, j))
    return found


def test_matches_are_those_of_a_plain_search() -> None:
    rng = np.random.default_rng(0)
    a = _descriptors(rng, 300)
    noisy = np.clip(a[50:200] + rng.normal(0, 18, (150, 128)), 0, 255).astype(np.uint8)
    b = np.concatenate([_descriptors(rng, 100), noisy])
    options = MatchOptions()
    found = {(int(i), int(j)) for i, j in mutual_matches(a, b, options)}
    assert found == _plain(a, b, options)
    true = {(50 + k, 100 + k) for k in range(150)}
    assert len(found & true) > 100


def test_repeated_structure_does_not_match() -> None:
    rng = np.random.default_rng(1)
    a = _descriptors(rng, 20)
    assert len(mutual_matches(a, np.concatenate([a, a]), MatchOptions())) == 0


def test_an_image_with_hardly_any_features_matches_nothing() -> None:
    rng = np.random.default_rng(2)
    for count in (0, 1):
        assert mutual_matches(_descriptors(rng, count), _descriptors(rng, 9), MatchOptions()).shape == (0, 2)


def _two_views(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    points = np.column_stack([rng.uniform(-6, 6, (120, 2)), rng.uniform(9, 15, 120)])
    moved = Rigid3.exp([0.02, 0.1, 0.03, -1.5, 0.3, 0.1])
    noise = rng.normal(0, 0.4, (2, 120, 2))
    a, b = _CAMERA.project(points), _CAMERA.project(moved.act(points))
    return (a + noise[0]).astype(np.float32), (b + noise[1]).astype(np.float32)


def test_verification_keeps_true_matches_and_drops_wrong_ones() -> None:
    rng = np.random.default_rng(3)
    xy_a, xy_b = _two_views(rng)
    wrong = rng.permutation(120)[:60]
    matches = np.stack([np.arange(120), np.arange(120)], axis=1).astype(np.uint32)
    matches[wrong, 1] = np.roll(matches[wrong, 1], 1)
    view = verify_pair(_CAMERA, xy_a, _CAMERA, xy_b, matches, focal_known=True, max_error_px=2.0, seed=0)
    kept = {(int(i), int(j)) for i, j in view.inliers}
    true = {(i, i) for i in range(120) if i not in set(wrong.tolist())}
    assert len(kept & true) > 0.95 * len(true)
    assert len(kept - true) <= 3
    again = verify_pair(_CAMERA, xy_a, _CAMERA, xy_b, matches, focal_known=True, max_error_px=2.0, seed=0)
    np.testing.assert_array_equal(view.inliers, again.inliers)


def test_random_matches_are_not_verified() -> None:
    rng = np.random.default_rng(4)
    xy_a, xy_b = _two_views(rng)
    matches = np.stack([np.arange(120), rng.permutation(120)], axis=1).astype(np.uint32)
    view = verify_pair(_CAMERA, xy_a, _CAMERA, xy_b, matches, focal_known=True, max_error_px=2.0, seed=0)
    assert len(view.inliers) < MatchOptions().min_inliers


def test_too_few_matches_for_a_geometry() -> None:
    rng = np.random.default_rng(5)
    xy_a, xy_b = _two_views(rng)
    matches = np.zeros((5, 2), np.uint32)
    view = verify_pair(_CAMERA, xy_a, _CAMERA, xy_b, matches, focal_known=True, max_error_px=2.0, seed=0)
    assert len(view.inliers) == 0
    assert int(view.candidates) == 5
