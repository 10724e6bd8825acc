"""Choose the strongest keypoints so that they cover the image."""

import numpy as np
from numpy.typing import NDArray

# 24 x 18 cells: a cell of a 4:3 photo is about square, and 4,000 features are about nine a cell, so that
# a textured corner cannot take all the places while a cell still has a choice.
_COLUMNS, _ROWS = 24, 18


def spread_strongest(
    xy: NDArray[np.float32], response: NDArray[np.float32], width: int, height: int, count: int
) -> NDArray[np.intp]:
    """Rows of at most `count` keypoints, best first.

    Keypoints are ranked inside the cells of a grid by response; the strongest of every cell come first,
    then the second of every cell, and so on, stronger ones first within a round.

    Args:
        xy: (n, 2) pixels. response: (n,). width, height: image size in the same pixels.
    """
    n = len(xy)
    column = np.clip((xy[:, 0] * (_COLUMNS / width)).astype(np.intp), 0, _COLUMNS - 1)
    row = np.clip((xy[:, 1] * (_ROWS / height)).astype(np.intp), 0, _ROWS - 1)
    cell = row * _COLUMNS + column
    by_cell = np.lexsort((-response, cell))
    starts = np.searchsorted(cell[by_cell], np.arange(_COLUMNS * _ROWS))
    rank = np.empty(n, dtype=np.intp)
    rank[by_cell] = np.arange(n) - starts[cell[by_cell]]
    return np.lexsort((-response, rank))[:count]
