"""Where a server gets what it answers from: one immutable area at a time, newer ones when they appear."""

from dataclasses import dataclass

import numpy as np

from featuredb.geo.utm import geodetic_from_utm
from featuredb.store import Database, MapSummary
from reloc.localiser import Localiser
from reloc.wire.server import BoundingBox, MapInfo


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServedArea:
    """What one snapshot offers: what answers the queries, and the maps that it answers from."""

    localiser: Localiser
    maps: tuple[MapInfo, ...]

    @property
    def snapshot(self) -> int:
        return self.localiser.snapshot

    @property
    def bounds(self) -> BoundingBox | None:
        """Around all maps; None without any."""
        boxes = [info.bounds for info in self.maps if info.bounds is not None]
        if not boxes:
            return None
        return BoundingBox(
            west=min(box.west for box in boxes),
            south=min(box.south for box in boxes),
            east=max(box.east for box in boxes),
            north=max(box.north for box in boxes),
        )

    @property
    def tiles(self) -> tuple[str, ...]:
        """Tiles that the maps touch, sorted."""
        return tuple(sorted({tile for info in self.maps for tile in info.tiles}))


class DatabaseSource:
    """Loads areas of a database; the server polls `version` and loads when it has changed."""

    def __init__(self, database: Database, bbox: tuple[float, float, float, float] | None = None) -> None:
        """`bbox`: west, south, east and north in degrees; only maps that touch it are loaded."""
        self._database, self._bbox = database, bbox
        self._previous: Localiser | None = None

    def version(self) -> int:
        """Number of the newest snapshot: one look at the table's log."""
        return self._database.poll_version()

    def load(self) -> ServedArea:
        """Localiser and maps of one and the same snapshot.

        Raises:
            FeatureDbError: the store cannot be read, or maps do not fit together.
        """
        localiser = Localiser.open(self._database, previous=self._previous, served=self._serves)
        self._previous = localiser
        snapshot = self._database.snapshot(localiser.snapshot)
        active = [m for m in snapshot.maps() if m.status == "active" and self._serves(m)]
        return ServedArea(localiser=localiser, maps=tuple(map_info(summary) for summary in active))

    def _serves(self, summary: MapSummary) -> bool:
        if self._bbox is None:
            return True
        bounds, (west, south, east, north) = _bounds(summary), self._bbox
        if bounds is None:
            return False
        return bounds.west <= east and bounds.east >= west and bounds.south <= north and bounds.north >= south


def map_info(summary: MapSummary) -> MapInfo:
    """A map's summary as the wire says it."""
    same = [name for name in MapInfo.model_fields if name not in ("bounds", "tiles")]
    return MapInfo(
        **{name: getattr(summary, name) for name in same},
        bounds=_bounds(summary),
        tiles=tuple(f"{summary.epsg}-{tile}" for tile in summary.tiles),
    )


def _bounds(summary: MapSummary) -> BoundingBox | None:
    """Degrees around the map's box: those of its corners, which grid lines curve off by centimetres."""
    box = summary.box
    if box is None:
        return None
    corners = [
        (easting, northing, 0.0)
        for easting in (box.min_easting, box.max_easting)
        for northing in (box.min_northing, box.max_northing)
    ]
    lat_lon_h = geodetic_from_utm(np.array(corners), summary.epsg)
    south, west = (float(v) for v in lat_lon_h[:, :2].min(axis=0))
    north, east = (float(v) for v in lat_lon_h[:, :2].max(axis=0))
    return BoundingBox(west=west, south=south, east=east, north=north)
