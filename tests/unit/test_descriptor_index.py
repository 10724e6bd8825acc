"""Descriptor search against NumPy, in float64, by exhaustion."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.index import descriptor_index
from featuredb.index.descriptor_index import IndexOptions, build_index, load_or_build
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
    fewer, _ = build_index(base, IndexOptions(probes=1)).search(query, 2)
    assert (fewer >= distance).all()
    assert fewer.sum() > distance.sum()  # probes do something


def test_a_kept_index_answers_as_the_built_one(
    large: tuple[NDArray[np.uint8], NDArray[np.uint8]], tmp_path: Path
) -> None:
    base, query = large
    cache = tmp_path / "new" / "folder"
    built = load_or_build(base, "a" * 64, cache)
    (file,) = cache.iterdir()
    stamp = file.stat().st_mtime_ns
    for options in (IndexOptions(), IndexOptions(mmap_from_bytes=1)):
        again = load_or_build(base, "a" * 64, cache, options)
        for one, other in zip(built.search(query, 3), again.search(query, 3), strict=True):
            np.testing.assert_array_equal(one, other)
    assert file.stat().st_mtime_ns == stamp
    assert len(list(cache.iterdir())) == 1
    load_or_build(base, "b" * 64, cache)
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("damage", ["truncated", "foreign", "other", "empty", "folder"])
def test_a_broken_cache_is_rebuilt_with_a_warning(
    large: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    tmp_path: Path,
    damage: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    base, query = large
    load_or_build(base, "a" * 64, tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    if damage == "folder":
        file.unlink()
        file.mkdir()
    elif damage == "other":  # the index of other descriptors under this name
        load_or_build(base[:1500], "b" * 64, tmp_path)
        other = next(p for p in tmp_path.iterdir() if p != file)
        other.replace(file)
    else:
        file.write_bytes({"truncated": whole[:-1000], "foreign": b"%PDF-1.7" * 50, "empty": b""}[damage])
    caplog.clear()
    distance, row = load_or_build(base, "a" * 64, tmp_path).search(query, 1)
    assert "is unusable and is rebuilt" in caplog.text
    np.testing.assert_array_equal(distance, np.take_along_axis(brute_force(query, base), row, axis=1))
    if damage != "folder":
        assert file.read_bytes() == whole
        caplog.clear()
        load_or_build(base, "a" * 64, tmp_path)
        assert caplog.text == ""


def test_a_cache_that_cannot_be_written_costs_time_only(
    large: tuple[NDArray[np.uint8], NDArray[np.uint8]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    base, query = large
    (tmp_path / "file").write_text("not a folder")
    index = load_or_build(base, "a" * 64, tmp_path / "file")
    assert "cannot be kept" in caplog.text
    assert index.search(query, 1)[1].shape == (len(query), 1)
    assert base.shape[1] == DESCRIPTOR_SIZE
