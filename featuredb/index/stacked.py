"""Rows of arrays that stay where they are, in mapped files for example, and are taken on demand."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)


class Stacked(Generic[_Scalar]):
    """The same attribute (n_i, ...) of several objects, as if it were one array of all their rows.

    Nothing is copied but the rows that are asked for.
    """

    def __init__(self, owners: Sequence[object], name: str) -> None:
        self._owners, self._name = tuple(owners), name
        self._parts: list[NDArray[_Scalar]] = [getattr(owner, name) for owner in self._owners]
        self._starts = np.cumsum([0, *(len(part) for part in self._parts)])

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._owners, self._name)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, rows: NDArray[np.integer]) -> NDArray[_Scalar]:
        """Rows, in any shape: (..., *shape of a row)."""
        if len(self._parts) == 1 and (not rows.size or rows.min() >= 0):
            return np.asarray(self._parts[0][rows])
        flat = np.ravel(rows)
        if len(flat) and not 0 <= flat.min() <= flat.max() < len(self):
            raise IndexError(f"expected rows from 0 to {len(self) - 1}, found {flat.min()} to {flat.max()}")
        part = np.searchsorted(self._starts, flat, side="right") - 1
        first = int(part[0]) if len(part) else 0
        if not (part != first).any():
            return np.asarray(self._parts[first][rows - self._starts[first]])
        like: Any = self._parts[0]
        taken = np.empty((len(flat), *like.shape[1:]), like.dtype)
        order = np.argsort(part, kind="stable")
        ends = np.searchsorted(part[order], np.arange(len(self._parts) + 1))
        for number in np.flatnonzero(np.diff(ends)):
            mine = order[ends[number] : ends[number + 1]]
            taken[mine] = self._parts[number][flat[mine] - self._starts[number]]
        return taken.reshape(*np.shape(rows), *like.shape[1:])

    def whole(self) -> NDArray[_Scalar]:
        """All rows, copied."""
        return np.concatenate(self._parts)
