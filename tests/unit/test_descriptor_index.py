"""Descriptor search against NumPy, in float64, by exhaustion."""

import pickle

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.index import descriptor_index, distance_loops
from featuredb.index.descriptor_index import DescriptorCodes, DescriptorIndex, squared_distances
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


def found(query: NDArray[np.uint8], base: NDArray[np.uint8], k: int) -> NDArray[np.int64]:
    return DescriptorIndex.of(DescriptorCodes.of(base)).search(query, k)


def test_nearest_is_exact() -> None:
    base = clustered(700)
    query = noisy(np.random.default_rng(1), base[::7], 6.0)
    distance, row = nearest(query, base, 4)
    truth = brute_force(query, base)
    np.testing.assert_array_equal(distance, np.sort(truth, axis=1)[:, :4])
    np.testing.assert_array_equal(np.take_along_axis(truth, row, axis=1), distance)


@pytest.fixture(params=["codes", "lists"], autouse=True)
def _kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """All codes, as of few descriptors, or inverted lists, as of many."""
    if request.param == "lists":
        monkeypatch.setattr(descriptor_index, "_FEW", -1)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_missing_neighbours_are_padded(count: int) -> None:
    base, query = clustered(count + 1)[:count], clustered(5, seed=3)
    distance, row = nearest(query, base, 3)
    assert distance.shape == row.shape == (5, 3)
    assert (row[:, count:] == -1).all()
    assert (row[:, :count] >= 0).all()
    assert (distance[:, count:] > 1e30).all()
    distance, row = nearest(query[:0], base, 3)
    assert distance.shape == row.shape == (0, 3)
    row = found(query, base, 3)
    assert row.shape == (5, 3)
    assert (row[:, count:] == -1).all()
    assert found(query[:0], base, 3).shape == (0, 3)


def test_the_neighbours_are_found_among_the_first_ten() -> None:
    base = clustered(6000)
    query = noisy(np.random.default_rng(5), base[::20], 5.0)
    row = found(query, base, 10)
    truth = brute_force(query, base)
    recall = np.mean((row == np.argmin(truth, axis=1)[:, None]).any(axis=1))
    assert recall >= 0.95
    asker, rank = np.nonzero(row >= 0)
    exact = squared_distances(query, asker, base, row[asker, rank])
    np.testing.assert_array_equal(exact, truth[asker, row[asker, rank]])


@pytest.mark.parametrize("count", [1, 3, 2049])
def test_the_neighbours_are_the_same_for_any_number_of_threads(count: int) -> None:
    base = clustered(3000)
    query = noisy(np.random.default_rng(5), clustered(2100)[:count], 5.0)
    before = cv2.getNumThreads()
    rows = []
    for threads in (1, 4):
        cv2.setNumThreads(threads)
        rows.append(found(query, base, 10))
    cv2.setNumThreads(before)
    np.testing.assert_array_equal(*rows)


def test_distances_are_compiled_once_for_rows_of_any_order() -> None:
    """A worker that compiles is over its time."""
    base = clustered(50)
    rows = np.array(np.nonzero(np.ones((5, 5)))).T
    squared_distances(base, rows[:, 0], base, rows[:, 1])
    squared_distances(np.asfortranarray(base), np.ascontiguousarray(rows[:, 0]), base, rows[:, 1])
    assert len(distance_loops.pair_distances.signatures) == 1


def test_codes_of_parts_are_those_of_the_whole() -> None:
    base = clustered(900)
    parts = [DescriptorCodes.of(base[:500]), DescriptorCodes.of(base[500:])]
    joined, whole = DescriptorCodes.joined(parts), DescriptorCodes.of(base)
    np.testing.assert_array_equal(joined.lists, whole.lists)
    np.testing.assert_array_equal(joined.codes, whole.codes)


def test_an_index_is_the_same_after_it_was_pickled() -> None:
    base = clustered(3000)
    index = DescriptorIndex.of(DescriptorCodes.of(base))
    again = pickle.loads(pickle.dumps(index))
    np.testing.assert_array_equal(again.search(base[:50], 5), index.search(base[:50], 5))
    assert len(again) == len(index) == 3000
