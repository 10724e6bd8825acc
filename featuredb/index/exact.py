"""Exact nearest neighbours by FAISS: 8-bit RootSIFT of pairs of images, and codebooks by k-means.

Squared lengths and inner products of 8-bit integers stay below 2^24, so float32 holds them without error: the
result depends neither on the number of threads nor on the BLAS.
"""

from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


def use_threads(count: int) -> None:
    """Cap the threads of FAISS in this process."""
    faiss.omp_set_num_threads(count)


def nearest(
    queries: NDArray[Any], base: NDArray[Any], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """The `count` rows of `base` (m, d) nearest to each row of `queries` (n, d).

    Returns:
        Squared distances (n, count) float32, rising, and rows of base (n, count) int64; -1 where m < count.
    """
    index = faiss.IndexFlatL2(base.shape[1])
    index.add(base.astype(np.float32))
    squared, rows = index.search(queries.astype(np.float32), count)
    return squared, rows


def kmeans(samples: NDArray[np.float32], clusters: int, seed: int, iterations: int = 10) -> FloatArray:
    """Cluster centres (clusters, d) of samples (n, d) by Lloyd's algorithm with a fixed seed."""
    trainer = faiss.Kmeans(
        samples.shape[1],
        clusters,
        niter=iterations,
        seed=seed,
        min_points_per_centroid=1,
        max_points_per_centroid=1_000_000,
        verbose=False,
    )
    trainer.train(np.ascontiguousarray(samples, dtype=np.float32))
    return np.asarray(trainer.centroids, dtype=np.float64).reshape(clusters, -1)
