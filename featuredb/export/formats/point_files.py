"""What files of points have in common: one for each zone and height datum, and a list of the maps."""

from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ExportError
from featuredb.export.job import Attribution, attribution_of, write_attribution, write_csv
from featuredb.geo.crs.wkt import utm_wkt
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, PointColumns
from featuredb.maps.move import full_covariances
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store.snapshot import MapSummary

MAPS_TABLE = "maps.csv"
_MAP_COLUMNS = ("map_index", "map_id", "name", "file", "epsg", "height_datum", "points", "licence")


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """The points that share a file: those of one UTM zone and one height datum.

    Attributes:
        low, high: corners of a box around all of them, easting, northing, height in metres.
        day: when the newest of the maps was made.
    """

    epsg: int
    height_datum: str
    low: FloatArray
    high: FloatArray
    day: date

    @property
    def name(self) -> str:
        """Of its file, without the ending."""
        return f"epsg{self.epsg}_{self.height_datum}"

    @property
    def wkt(self) -> str:
        """Its reference system."""
        return utm_wkt(self.epsg, self.height_datum)


def zones_of(maps: list[MapSummary]) -> dict[tuple[int, str], Zone]:
    """The zones of maps that have points, by EPSG code and datum.

    Raises:
        ExportError: none of them has points.
    """
    groups: dict[tuple[int, str], list[MapSummary]] = defaultdict(list)
    for summary in maps:
        if summary.box is not None:
            groups[summary.epsg, summary.height_datum].append(summary)
    if not groups:
        raise ExportError("expected maps with points, found none with any among those selected")
    zones = {}
    for (epsg, datum), members in sorted(groups.items()):
        boxes = [m.box for m in members if m.box is not None]
        zones[epsg, datum] = Zone(
            epsg=epsg,
            height_datum=datum,
            low=np.min([(b.min_easting, b.min_northing, b.min_height) for b in boxes], axis=0),
            high=np.max([(b.max_easting, b.max_northing, b.max_height) for b in boxes], axis=0),
            day=max(m.created_at for m in members).astimezone(UTC).date(),
        )
    return zones


def sigma_m(points: PointColumns) -> NDArray[np.float32]:
    """(n,) standard deviation of each point in its worst direction, relative to the map's gauge.

    Metres; own units of a map without a place.
    """
    largest = np.linalg.eigvalsh(full_covariances(points.covariance))[:, -1]
    return np.asarray(np.sqrt(np.maximum(largest, 0.0)), np.float32)


class MapList:
    """The tables beside the points: which number is which map, and whose photos they are made of."""

    def __init__(self) -> None:
        self._rows: list[tuple[object, ...]] = []
        self._photos: list[Attribution] = []

    def add(self, feature_map: AnyMap, file: str) -> int:
        """The map's number, which its points carry."""
        index = len(self._rows)
        attribution = attribution_of(feature_map)
        licences = "; ".join(sorted({row.licence for row in attribution if row.licence}))
        points = len(feature_map.points)
        place: tuple[object, object] = ("", "")
        if isinstance(feature_map, FeatureMap):
            place = feature_map.epsg, feature_map.height_datum
        row = (index, feature_map.map_id, feature_map.name, file if points else "", *place, points, licences)
        self._rows.append(row)
        self._photos.extend(attribution)
        return index

    def write(self, folder: Path) -> None:
        """Both tables as CSV."""
        write_csv(folder / MAPS_TABLE, _MAP_COLUMNS, self._rows)
        write_attribution(folder, self._photos)
