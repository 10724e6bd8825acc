"""What an export has written so far, and the formats that give each map a folder."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from featuredb.export.attribution import folder_name
from featuredb.export.job import Exported, ExportJob, size_of, whole_or_nothing
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap

_Kind = TypeVar("_Kind", FeatureMap, AnyMap)


class ExportTally:
    """Counts of the maps that went through; `exported` is their sum with the bytes on disk."""

    def __init__(self) -> None:
        self._maps = self._images = self._points = self._observations = 0

    def add(self, feature_map: AnyMap, *, images: int | None = None) -> None:
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


def folder_for_each(job: ExportJob, maps: Iterable[_Kind], write: Callable[[Path, _Kind], None]) -> Exported:
    """Make `job.out` with a folder for every map, which `write` makes and fills.

    Raises:
        ExportError: there is something at `job.out`; and what `write` raises.
    """
    tally = ExportTally()
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        for feature_map in maps:
            write(part / folder_name(feature_map.map_id), feature_map)
            tally.add(feature_map)
            del feature_map  # or it would stay while the next one is loaded
        return tally.exported(part)
