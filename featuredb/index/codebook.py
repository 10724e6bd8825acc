"""Codebooks of visual words, by FAISS' k-means; and its threads."""

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


def use_threads(count: int) -> None:
    """Cap the threads of FAISS in what the calling thread does."""
    faiss.omp_set_num_threads(count)


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
