"""Frames that may still be needed: the last one, and those since a keyframe whose answer is awaited."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecentFrame:
    """A frame: its number, its time on the film's clock, and its grey values (h, w) uint8."""

    index: int
    time_s: float
    gray: NDArray[np.uint8]


class RecentFrames:
    """A bounded memory of frames.

    However long an answer takes, its keyframe stays, and the frames since then get sparser, evenly.
    """

    def __init__(self, capacity: int) -> None:
        """
        Args:
            capacity: frames that are kept at most, at least 3.
        """
        self._capacity = max(capacity, 3)
        self._frames: list[RecentFrame] = []

    @property
    def last(self) -> RecentFrame | None:
        """The frame that was added last."""
        return self._frames[-1] if self._frames else None

    def add(self, frame: RecentFrame, keep_from: int | None) -> None:
        """Keep this frame, and of the others those from number `keep_from` on (None: none of them)."""
        kept = [] if keep_from is None else [f for f in self._frames if f.index >= keep_from]
        kept.append(frame)
        if len(kept) > self._capacity:
            # The frame goes whose neighbours are closest together; the first and the last stay.
            gaps = [after.index - before.index for before, after in zip(kept, kept[2:], strict=False)]
            del kept[1 + gaps.index(min(gaps))]
        self._frames = kept

    def since(self, index: int) -> list[RecentFrame]:
        """The frames from number `index` on, in order; none where that one is not kept."""
        found = [f for f in self._frames if f.index >= index]
        return found if found and found[0].index == index else []

    def before(self, index: int) -> list[RecentFrame]:
        """The frames before number `index`, the last first, as far as none is missing between them."""
        found: list[RecentFrame] = []
        for frame in reversed([f for f in self._frames if f.index < index]):
            if frame.index != index - 1 - len(found):
                break
            found.append(frame)
        return found

    def __len__(self) -> int:
        return len(self._frames)
