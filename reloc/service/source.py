"""Where a server gets what it answers from: one immutable area at a time, newer ones when they appear."""

from dataclasses import dataclass

from featuredb.export.selection import degrees_around, touches
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
        return self._bbox is None or touches(summary, self._bbox)


def map_info(summary: MapSummary) -> MapInfo:
    """A map's summary as the wire says it."""
    same = [name for name in MapInfo.model_fields if name not in ("bounds", "tiles")]
    around = degrees_around(summary)
    return MapInfo(
        **{name: getattr(summary, name) for name in same},
        bounds=None
        if around is None
        else BoundingBox(**dict(zip(BoundingBox.model_fields, around, strict=True))),
        tiles=tuple(f"{summary.epsg}-{tile}" for tile in summary.tiles),
    )
