"""Exact nearest neighbours between two small sets of descriptors."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray


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
