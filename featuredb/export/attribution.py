"""Whose photos an export is made of: a table that goes with every export, as licences ask."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from featuredb.export.job import write_csv
from featuredb.export.selection import licence_of
from featuredb.maps.unplaced_map import AnyMap

ATTRIBUTION = "attribution.csv"


class Attribution(NamedTuple):
    """One photo: who made it, under which licence it was given ("" where nobody has said)."""

    map_id: str
    image: str
    sha256: str
    owner: str
    licence: str
    capture_time: str
    source: str


def attribution_of(feature_map: AnyMap) -> list[Attribution]:
    """A row for every photo of the map, in the map's order."""
    return [
        Attribution(
            map_id=feature_map.map_id,
            image=image.name,
            sha256=image.sha256,
            owner=image.owner,
            licence=licence_of(image, feature_map),
            capture_time="" if image.capture_time is None else image.capture_time.isoformat(),
            source=feature_map.source,
        )
        for image in feature_map.images
    ]


def write_attribution(folder: Path, rows: Iterable[Attribution]) -> None:
    """The table of the photos in a folder."""
    write_csv(folder / ATTRIBUTION, Attribution._fields, rows)
