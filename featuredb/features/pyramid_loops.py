"""A compiled loop that blurs images; import it through `compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled


@compiled
def blur(
    image: NDArray[np.float32], weights: NDArray[np.float32], first: int, end: int, out: NDArray[np.float32]
) -> None:
    """Rows from first to end of an image (h, w) blurred by a symmetric kernel, into those of `out`.

    Beyond its sides the image is mirrored at its outermost pixels.

    Args:
        weights: (r + 1,) of the kernel, from its middle to its end.
    """
    height, width = image.shape
    reach = len(weights) - 1
    line = np.empty(width + 2 * reach, np.float32)
    for y in range(first, end):
        middle = line[reach : reach + width]
        here = image[y]
        for x in range(width):
            middle[x] = weights[0] * here[x]
        for k in range(1, reach + 1):
            above, below = image[_mirrored(y - k, height)], image[_mirrored(y + k, height)]
            weight = weights[k]
            for x in range(width):
                middle[x] += weight * (above[x] + below[x])
        for k in range(1, reach + 1):
            line[reach - k] = middle[_mirrored(-k, width)]
            line[reach + width - 1 + k] = middle[_mirrored(width - 1 + k, width)]
        row = out[y]
        for x in range(width):
            row[x] = weights[0] * middle[x]
        for k in range(1, reach + 1):
            left, right, weight = line[reach - k :], line[reach + k :], weights[k]
            for x in range(width):
                row[x] += weight * (left[x] + right[x])


@compiled
def _mirrored(index: int, count: int) -> int:
    if count == 1:
        return 0
    while index < 0 or index >= count:
        index = -index if index < 0 else 2 * count - 2 - index
    return index
