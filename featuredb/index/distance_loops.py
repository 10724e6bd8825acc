"""A compiled loop over pairs of descriptors; import it through `compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled


@compiled
def pair_distances(
    first: NDArray[np.uint8], rows: NDArray[np.int64], second: NDArray[np.uint8], squared: NDArray[np.float32]
) -> None:
    """Squared distances (m,) of rows (m,) of `first` (n, 128) to the rows of `second` (m, 128), exact."""
    for pair in range(len(rows)):
        one, other = first[rows[pair]], second[pair]
        total = np.int32(0)
        for k in range(len(one)):
            difference = np.int32(one[k]) - np.int32(other[k])
            total += difference * difference
        squared[pair] = total
