"""What an export has written so far."""

from pathlib import Path

from featuredb.export.job import Exported, size_of
from featuredb.maps.feature_map import FeatureMap


class Tally:
    """Counts of the maps that went through; `exported` is their sum with the bytes on disk."""

    def __init__(self) -> None:
        self._maps = self._images = self._points = self._observations = 0

    def add(self, feature_map: FeatureMap, *, images: int | None = None) -> None:
        """Count a map; `images` where not all of its photos were written."""
        self._maps += 1
        self._images += len(feature_map.images) if images is None else images
        self._points += len(feature_map.points)
        self._observations += len(feature_map.observations)

    def exported(self, path: Path) -> Exported:
        """The sums, and the size of what lies at `path`."""
        return Exported(
            maps=self._maps,
            images=self._images,
            points=self._points,
            observations=self._observations,
            bytes=size_of(path),
        )
