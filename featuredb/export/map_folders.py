"""What the formats share that give each map a folder."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from featuredb.export.attribution import folder_name
from featuredb.export.job import Exported, ExportJob, whole_or_nothing
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap

_Kind = TypeVar("_Kind", FeatureMap, AnyMap)


def folder_for_each(job: ExportJob, maps: Iterable[_Kind], write: Callable[[Path, _Kind], None]) -> Exported:
    """Make `job.out` with a folder for every map, which `write` makes and fills.

    Raises:
        ExportError: there is something at `job.out`; and what `write` raises.
    """
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        for feature_map in maps:
            write(part / folder_name(feature_map.map_id), feature_map)
            del feature_map  # or it would stay while the next one is loaded
        return job.exported(part)
