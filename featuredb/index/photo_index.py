"""Photos that look alike, among many, by their aggregated descriptors."""

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.index.nearest import knn

_CHUNK = 1024  # queries at a time: bounds the float32 copies


def most_similar(vectors: NDArray[np.float16], rows: NDArray[np.int64], k: int) -> NDArray[np.int64]:
    """The k photos most similar to each of some photos, without themselves, best first.

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
