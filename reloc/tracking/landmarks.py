"""The points that are followed from frame to frame, spread over the picture."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Known points with the pixels in which the last frame shows them.

    Attributes:
        rows: (n,) of the area's points, none twice.
        points: (n, 3) metres in the area's frame.
        pixels: (n, 2) in the last frame.
        born: (n,) number of the keyframe that matched them.
    """

    rows: NDArray[np.int64]
    points: FloatArray
    pixels: FloatArray
    born: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Landmarks":
        """Some of them."""
        return Landmarks(
            rows=self.rows[chosen],
            points=self.points[chosen],
            pixels=self.pixels[chosen],
            born=self.born[chosen],
        )

    def joined(self, newer: "Landmarks") -> "Landmarks":
        """Both; of a point that is in both the newer one, whose pixel is a fresh match."""
        old = self.take(~np.isin(self.rows, newer.rows))
        return Landmarks(
            rows=np.concatenate([newer.rows, old.rows]),
            points=np.concatenate([newer.points, old.points]),
            pixels=np.concatenate([newer.pixels, old.pixels]),
            born=np.concatenate([newer.born, old.born]),
        )

    def spread(self, count: int, columns: int, rows: int, width: int, height: int) -> "Landmarks":
        """At most `count`, in turns from the cells of a grid, the newest of a cell first."""
        if len(self) <= count:
            return self
        column = np.clip((self.pixels[:, 0] * columns / width).astype(np.int64), 0, columns - 1)
        row = np.clip((self.pixels[:, 1] * rows / height).astype(np.int64), 0, rows - 1)
        cell = row * columns + column
        order = np.lexsort((np.arange(len(self)), -self.born, cell))
        starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
        turn = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
        chosen = order[np.argsort(turn, kind="stable")[:count]]
        return self.take(np.sort(chosen))
