"""Where a server gets what it answers from: one immutable area at a time, newer ones when they appear."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reloc.localise.candidates import IndexedArea
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest, LocaliseResult
from reloc.wire.server import MapInfo


class LocaliserLike(Protocol):
    """Answers queries from one snapshot; safe to call from several threads."""

    @property
    def snapshot(self) -> int:
        """Version of the database that it answers from."""
        ...

    @property
    def options(self) -> LocaliseOptions:
        """Settings by which it answers."""
        ...

    @property
    def areas(self) -> tuple[IndexedArea, ...]:
        """All areas, of whatever extractor; those whose maps did not change stay the same over reloads."""
        ...

    def localise(self, gray: NDArray[np.uint8], request: LocaliseRequest) -> LocaliseResult:
        """The pose of the image (h, w), or the reason why there is none."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServedArea:
    """What one snapshot offers.

    Attributes:
        localiser: answers the queries.
        maps: the maps it answers from.
    """

    localiser: LocaliserLike
    maps: tuple[MapInfo, ...]

    @property
    def snapshot(self) -> int:
        return self.localiser.snapshot

    @property
    def tiles(self) -> tuple[str, ...]:
        """Tiles that the maps touch, sorted."""
        return tuple(sorted({tile for info in self.maps for tile in info.tiles}))


class AreaSource(Protocol):
    """Loads areas; the server polls `version` and loads when it has changed."""

    def version(self) -> int:
        """The newest version that can be loaded; cheap."""
        ...

    def load(self) -> ServedArea:
        """The newest area; may take seconds. Raises FeatureDbError when it cannot."""
        ...
