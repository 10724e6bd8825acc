"""Exact nearest neighbours: descriptors of two small sets, and photos that look alike."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

_CHUNK = 1024  # photos that ask at a time: bounds the float32 copies


def nearest(query: NDArray[Any], base: NDArray[Any], k: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The k nearest rows of `base` (m, d) for each row of `query` (n, d), by exhaustion.

    Returns:
        Squared distances (n, k) float32, ascending, infinity where there are fewer than k; rows (n, k)
        int64, -1 where there are fewer.
    """
    shape = (len(query), k)
    if len(query) == 0 or len(base) == 0:
        return np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int64)
    found = min(k, len(base))
    distance, row = knn(query.astype(np.float32), base.astype(np.float32), found)
    if found < k:
        distance = np.pad(distance, ((0, 0), (0, k - found)), constant_values=np.inf)
        row = np.pad(row, ((0, 0), (0, k - found)), constant_values=-1)
    return distance, row


def knn(
    query: NDArray[np.float32], base: NDArray[np.float32], k: int, metric: int = faiss.METRIC_L2
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """FAISS's exhaustive search in one thread: scores (n, k) of a metric, best first, and rows (n, k)."""
    with one_thread():
        score, row = faiss.knn(query, base, k, metric=metric)
    return score, row


def most_similar(vectors: NDArray[np.float16], rows: NDArray[np.int64], k: int) -> NDArray[np.int64]:
    """The k photos most similar to each of some photos by aggregated descriptors, without itself, best first.

    An exhaustive search: 5,000 photos with 4,096 numbers each take seconds, and its share of an ingest's time
    is below one percent up to some 50,000. Photos without any features (zeros) find and are found by none.

    Args:
        vectors: (n, d) of all photos, of unit length.
        rows: (m,) photos that ask.

    Returns:
        Rows (m, k) int64, -1 where there are fewer.
    """
    found = np.full((len(rows), k), -1, np.int64)
    count = min(k + 1, len(vectors))
    if count < 2 or not len(rows):
        return found
    base = vectors.astype(np.float32)
    for start in range(0, len(rows), _CHUNK):
        own = rows[start : start + _CHUNK]
        score, row = knn(base[own], base, count, faiss.METRIC_INNER_PRODUCT)
        for place, (me, near, cosine) in enumerate(zip(own, row, score, strict=True), start=start):
            good = (near != me) & (cosine > 0.0)
            best = near[good][:k]
            found[place, : len(best)] = best
    return found


@contextmanager
def one_thread() -> Iterator[None]:
    """FAISS on one thread in what the calling thread does.

    Its OpenMP and that of its OpenBLAS get into each other's way: two threads take two thirds of the time on
    two idle cores, and three times as long beside other work.
    """
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(before)
