"""Descriptor search against NumPy, in float64, by exhaustion."""

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.index import descriptor_index
from featuredb.index.descriptor_index import build_index
from featuredb.index.nearest import nearest
from tests.support.scenes import noisy, random_descriptors


def brute_force(query: NDArray[np.uint8], base: NDArray[np.uint8]) -> NDArray[np.float64]:
    """All squared distances (n, m), exact."""
    q, b = query.astype(np.float64), base.astype(np.float64)
    return (q**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * q @ b.T


def clustered(count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Descriptors of which dozens resemble each other, as in a town of like windows."""
    rng = np.random.default_rng(seed)
    kinds = random_descriptors(rng, max(count // 30, 1))
    return noisy(rng, kinds[rng.integers(0, len(kinds), count)], 12.0)


def assert_exact(
    distance: NDArray[np.float32], row: NDArray[np.int64], query: NDArray[np.uint8], base: NDArray[np.uint8]
) -> None:
    truth = brute_force(query, base)
    np.testing.assert_array_equal(distance, np.sort(truth, axis=1)[:, : distance.shape[1]])
    np.testing.assert_array_equal(np.take_along_axis(truth, row, axis=1), distance)


def test_small_areas_are_searched_exactly() -> None:
    base = clustered(700)
    query = noisy(np.random.default_rng(1), base[::7], 6.0)
    assert_exact(*build_index(base).search(query, 4), query, base)
    assert_exact(*nearest(query, base, 4), query, base)


@pytest.mark.parametrize("limit", [1, 100_000])
def test_only_the_rows_that_may_be_found_are(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descriptor_index, "_EXHAUSTIVE_LIMIT", limit)
    base = clustered(700)
    among = np.arange(700) % 3 == 1
    query = base[among][:50]
    distance, row = build_index(base).search(query, 4, among)
    assert (distance[:, 0] == 0.0).all()
    assert among[row[row >= 0]].all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_missing_neighbours_are_padded(count: int) -> None:
    base, query = clustered(count + 1)[:count], clustered(5, seed=3)
    for distance, row in (nearest(query, base, 3), build_index(base).search(query, 3)):
        assert distance.shape == row.shape == (5, 3)
        assert (row[:, count:] == -1).all()
        assert (row[:, :count] >= 0).all()
        assert (distance[:, count:] > 1e30).all()
    distance, row = nearest(query[:0], base, 3)
    assert distance.shape == row.shape == (0, 3)


@pytest.fixture(scope="module")
def large() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    base = clustered(6000)
    return base, noisy(np.random.default_rng(5), base[::20], 5.0)


@pytest.fixture(autouse=True)
def low_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inverted lists from 1,000 descriptors on, so that the tests stay small."""
    monkeypatch.setattr(descriptor_index, "_EXHAUSTIVE_LIMIT", 1000)


def test_inverted_lists_find_the_neighbours_with_exact_distances(
    large: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> None:
    base, query = large
    index = build_index(base)
    assert hasattr(index._index, "nprobe")  # it is the other kind of index
    assert len(index) == len(base)
    distance, row = index.search(query, 2)
    truth = brute_force(query, base)
    np.testing.assert_array_equal(distance, np.take_along_axis(truth, row, axis=1))
    recall = np.mean(row[:, 0] == np.argmin(truth, axis=1))
    assert recall >= 0.95
