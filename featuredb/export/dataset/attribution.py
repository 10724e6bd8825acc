"""Who made the photos: `attribution.csv`, a line for each photo of each map."""

import csv
from pathlib import Path

from featuredb.export.selection import licence_of
from featuredb.maps.feature_map import FeatureMap

HEADER = ("map_id", "image", "sha256", "owner", "licence", "capture_time")


class AttributionFile:
    """Written map by map; use it in a `with` block. UTF-8, commas, quotes where they are needed."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(HEADER)

    def add(self, feature_map: FeatureMap) -> None:
        """The lines of a map. A photo's licence is its own, or else its map's."""
        for image in feature_map.images:
            taken = "" if image.capture_time is None else image.capture_time.isoformat()
            self._writer.writerow(
                (
                    *(feature_map.map_id, image.name, image.sha256),
                    *(image.owner, licence_of(image, feature_map), taken),
                )
            )

    def __enter__(self) -> "AttributionFile":
        return self

    def __exit__(self, *failed: object) -> None:
        self._file.close()
