"""One index over the descriptors of many segments, made of what the one before it had and of what is new."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from featuredb.index.descriptor_index import DescriptorCodes, DescriptorIndex
from featuredb.index.segment import Segment

# Points that are new, or gone, before all are indexed anew. Without lists, a search among so many takes less
# than half of what one in lists takes (`_FEW` of the descriptors' index).
_MOST_APART = 10_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    """An index of its own.

    Attributes:
        segments: what it is of, one after the other.
        start: (s + 1,) rows of the index where they begin.
        shift: (s,) from there to the rows of the whole.
        kept: (s,) which of them the whole has.
    """

    index: DescriptorIndex
    segments: tuple[Segment, ...]
    start: NDArray[np.int64]
    shift: NDArray[np.int64]
    kept: NDArray[np.bool_]

    def search(self, descriptors: NDArray[np.uint8], k: int) -> NDArray[np.int64]:
        """Rows (n, k) of the whole; -1: there are fewer."""
        found = self.index.search(descriptors, k)
        number = np.clip(np.searchsorted(self.start, found, side="right") - 1, 0, len(self.shift) - 1)
        return np.where((found >= 0) & self.kept[number], found + self.shift[number], -1)


class SegmentIndex:
    """Neighbours among the descriptors of segments, one after the other. It never changes."""

    def __init__(self, parts: Sequence[_Part], points: int) -> None:
        self._parts, self._points = tuple(parts), points

    def __len__(self) -> int:
        return self._points

    @classmethod
    def of(cls, segments: Sequence[Segment], before: "SegmentIndex | None" = None) -> Self:
        """Of all segments; of those that the index `before` has, nothing is indexed again."""
        rows = np.cumsum([0, *(len(segment) for segment in segments)])
        row_of = {id(segment): int(row) for segment, row in zip(segments, rows[:-1], strict=True)}
        base = None if before is None else before._parts[0]
        had: set[int] = set() if base is None else {id(segment) for segment in base.segments}
        new = [segment for segment in segments if id(segment) not in had]
        gone = [] if base is None else [s for s in base.segments if id(s) not in row_of]
        if base is None or max(_points(new), _points(gone)) > _MOST_APART:
            return cls([_part(segments, row_of, None)], int(rows[-1]))
        parts = [_part(base.segments, row_of, base.index)]
        return cls([*parts, _part(new, row_of, None)] if new else parts, int(rows[-1]))

    def search(self, descriptors: NDArray[np.uint8], k: int) -> NDArray[np.int64]:
        """Rows (n, m) of near ones to each descriptor (n, 128), among which are the k nearest; -1: none."""
        return np.concatenate([part.search(descriptors, k) for part in self._parts], axis=1)


def _points(segments: Sequence[Segment]) -> int:
    return sum(len(segment) for segment in segments)


def _part(segments: Sequence[Segment], row_of: dict[int, int], index: DescriptorIndex | None) -> _Part:
    if index is None:
        codes = [DescriptorCodes(lists=segment.lists, codes=segment.codes) for segment in segments]
        index = DescriptorIndex.of(DescriptorCodes.joined(codes))
    start = np.cumsum([0, *(len(segment) for segment in segments)])
    row = np.array([row_of.get(id(segment), -1) for segment in segments], dtype=np.int64)
    return _Part(index=index, segments=tuple(segments), start=start, shift=row - start[:-1], kept=row >= 0)
