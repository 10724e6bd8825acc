"""Arrays of several segments as if they were one; nothing is copied but what is asked for."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

_Scalar = TypeVar("_Scalar", bound=np.generic)


class Stacked(Generic[_Scalar]):
    """The same attribute (n_i, ...) of several objects, as if it were one array of all their rows.

    Nothing is copied but the rows that are asked for.
    """

    def __init__(self, owners: Sequence[object], name: str) -> None:
        self._owners, self._name = tuple(owners), name
        self._parts: list[NDArray[_Scalar]] = [getattr(owner, name) for owner in self._owners]
        self._starts = np.cumsum([0, *(len(part) for part in self._parts)])
        self._dtype: Any = self._parts[0].dtype

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._owners, self._name)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, rows: NDArray[np.integer]) -> NDArray[_Scalar]:
        """Rows, in any shape: (..., *shape of a row)."""
        if len(self._parts) == 1 and (not rows.size or rows.min() >= 0):
            return self._of(0, rows)
        flat = np.ravel(rows)
        if len(flat) and not 0 <= flat.min() <= flat.max() < len(self):
            raise IndexError(f"expected rows from 0 to {len(self) - 1}, found {flat.min()} to {flat.max()}")
        part = np.searchsorted(self._starts, flat, side="right") - 1
        first = int(part[0]) if len(part) else 0
        if not (part != first).any():
            return self._of(first, rows - self._starts[first])
        like: Any = self._parts[0]
        taken = np.empty((len(flat), *like.shape[1:]), self._dtype)
        order = np.argsort(part, kind="stable")
        ends = np.searchsorted(part[order], np.arange(len(self._parts) + 1))
        for number in np.flatnonzero(np.diff(ends)):
            mine = order[ends[number] : ends[number + 1]]
            taken[mine] = self._of(int(number), flat[mine] - self._starts[number])
        return taken.reshape(*np.shape(rows), *like.shape[1:])

    def _of(self, number: int, rows: NDArray[np.integer] | slice) -> NDArray[_Scalar]:
        """Rows of one of the objects."""
        return np.asarray(self._parts[number][rows])

    def whole(self) -> NDArray[_Scalar]:
        """All rows, copied."""
        return np.concatenate([self._of(k, slice(None)) for k in range(len(self._parts))])


class Moved(Stacked[np.float64]):
    """Stacked points or directions (n_i, 3) in one frame for all: moved where they are asked for."""

    def __init__(
        self, owners: Sequence[object], name: str, turns: FloatArray, shifts: FloatArray | None = None
    ) -> None:
        """
        Args:
            turns, shifts: (m, 3, 3) and (m, 3) from the frames of the owners to this one.
        """
        super().__init__(owners, name)
        self._dtype = np.float64
        self.turns, self._shifts = turns, shifts

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._owners, self._name, self.turns, self._shifts)

    def _of(self, number: int, rows: NDArray[np.integer] | slice) -> FloatArray:
        turned = self._parts[number][rows].astype(np.float64) @ self.turns[number].T
        return turned if self._shifts is None else np.asarray(turned + self._shifts[number])
