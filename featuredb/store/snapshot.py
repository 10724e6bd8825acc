"""One version of a database, for reading. Nothing that is committed later shows in it."""

import itertools
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
from numpy.typing import NDArray

from featuredb.errors import MapNotFoundError, StoreError, UnplacedMapError
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage, MapMethod, MapStatus
from featuredb.maps.lineage import MapLineage, drift_and_budget, trace
from featuredb.maps.place_bounds import PlaceBounds
from featuredb.maps.unplaced_map import AnyMap, NoPlace, OwnFrame, UnplacedMap, UnplacedStatus
from featuredb.store.changes import RETIRED
from featuredb.store.decode import decode_images, decode_map, decode_no_place, frame_of, has_place, of_columns
from featuredb.store.delta import Condition, Table
from featuredb.store.durable.filesystem import read_errors
from featuredb.store.encode import Row, content_digest
from featuredb.store.tables import BOUNDS, CHILD_TABLES, IMAGES, SPECS, UTM_COORDINATES


@dataclass(frozen=True, slots=True, kw_only=True)
class UtmBox:
    """A box in one UTM zone, metres, closed on all sides."""

    min_easting: float
    min_northing: float
    min_height: float
    max_easting: float
    max_northing: float
    max_height: float

    @property
    def middle(self) -> tuple[float, float, float]:
        """Easting, northing, height, metres."""
        return (
            (self.min_easting + self.max_easting) / 2,
            (self.min_northing + self.max_northing) / 2,
            (self.min_height + self.max_height) / 2,
        )

    def touches(self, e0: float, n0: float, e1: float, n1: float) -> bool:
        """Whether the box has a point in e0 <= e <= e1, n0 <= n <= n1, at any height."""
        across = self.min_easting <= e1 and e0 <= self.max_easting
        return across and self.min_northing <= n1 and n0 <= self.max_northing


@dataclass(frozen=True, slots=True, kw_only=True)
class _Summary:
    """A map as its row in `maps` describes it, without its points.

    Attributes:
        write_id: names the child rows; changes with each re-placement, so it is a key for derived artefacts.
        content_digest: SHA-256 of everything but the status.
        status_reason: why it was promoted, quarantined or retired; "" where it has its first status.
    """

    map_id: str
    write_id: str
    content_digest: str
    name: str
    status_reason: str
    created_at: datetime
    images: int
    points: int
    observations: int
    descriptors: int
    extractor_fingerprint: str
    source: str
    licence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSummary(_Summary):
    """A map with a place.

    Attributes:
        box: of the points; None for a map without points.
        residual_rms_m: of the placement, metres.
        drift_m, budget_m: of a map that other maps placed: 95 % bound of its position against its anchors,
            and what growth allowed, metres; None where the placement does not say.
    """

    status: MapStatus
    epsg: int
    height_datum: str
    box: UtmBox | None
    tiles: tuple[str, ...]
    method: MapMethod
    generation: int
    parents: tuple[str, ...]
    residual_rms_m: float
    drift_m: float | None = None
    budget_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class UnplacedSummary(_Summary):
    """A map without a place; attributes as in the map."""

    status: UnplacedStatus
    frame: OwnFrame
    no_place: NoPlace


class Snapshot:
    """Maps as of one version of the table `maps`.

    Attributes:
        version: number of that version; what an answer names as its snapshot.
        timestamp: when it was committed, UTC.
    """

    def __init__(
        self, *, version: int, timestamp: datetime, rows: list[Row], children: Mapping[str, Table]
    ) -> None:
        self.version = version
        self.timestamp = timestamp
        self._rows = {row["map_id"]: row for row in rows}
        self._children = children

    def any_maps(self, *, include_retired: bool = False) -> list[MapSummary | UnplacedSummary]:
        """All maps, oldest first."""
        return [self.get_any(row["map_id"]) for row in self._oldest_first(include_retired)]

    def retired_alike(self, maps: Iterable[AnyMap]) -> dict[str, str]:
        """Why those of some maps are retired that were with the same content, by id."""
        rows = {map_id: row for map_id, row in self._rows.items() if row["status"] == RETIRED}
        return {
            m.map_id: rows[m.map_id]["status_reason"]
            for m in maps
            if m.map_id in rows and rows[m.map_id]["content_digest"] == content_digest(m)
        }

    def maps_of_photos(self, digests: Collection[str]) -> dict[str, set[str]]:
        """SHA-256 of those of some photos that maps have, by map; without retired maps."""
        alive = {row["write_id"]: map_id for map_id, row in self._rows.items() if row["status"] != RETIRED}
        where: Condition = ("sha256", "in", sorted(digests))
        found: dict[str, set[str]] = {}
        for batch in self._read(IMAGES, where, "the maps'", ["write_id", "sha256"]) if digests else ():
            for row in batch.to_pylist():
                if row["write_id"] in alive:
                    found.setdefault(alive[row["write_id"]], set()).add(row["sha256"])
        return found

    def maps(self, *, include_retired: bool = False) -> list[MapSummary]:
        """Those of `any_maps` with a place."""
        return [_summary(row) for row in self._oldest_first(include_retired) if has_place(row)]

    def unplaced_maps(self, *, include_retired: bool = False) -> list[UnplacedSummary]:
        """Those without."""
        return [_unplaced_summary(row) for row in self._oldest_first(include_retired) if not has_place(row)]

    def _oldest_first(self, include_retired: bool) -> list[Row]:
        rows = [row for row in self._rows.values() if include_retired or row["status"] != RETIRED]
        return sorted(rows, key=lambda r: (r["created_at"], r["map_id"]))

    def get(self, map_id: str) -> MapSummary:
        """The summary of one map with a place, retired or not.

        Raises:
            MapNotFoundError: the snapshot has no such map.
            UnplacedMapError: it has no place.
        """
        found = self.get_any(map_id)
        if isinstance(found, MapSummary):
            return found
        ways = "; ".join(found.no_place.ways) or "docs/anchoring.md has the ways"
        raise UnplacedMapError(
            f"map {map_id} has no place on Earth ({found.no_place.reason}), and this needs one; {ways}"
        )

    def place_bounds(self) -> dict[str, PlaceBounds]:
        """What holds 95 % of the errors of each placement, by map, at the middle of the map's cameras."""
        middles = self.camera_middles()
        return {
            map_id: PlaceBounds.of(
                np.reshape(row["placement_covariance"], (7, 7)), middles.get(map_id, np.zeros(3))
            )
            for map_id, row in self._rows.items()
            if has_place(row)
        }

    def camera_middles(self) -> dict[str, FloatArray]:
        """Medians (3,), by UTM's axes, of the placed maps' camera centres, in their local frames, metres.

        Not of the points: a few far ones move the middle of those by hundreds of metres.

        Raises:
            StoreError: photos' rows are unreadable.
        """
        own: Condition = ("write_id", "in", [r["write_id"] for r in self._rows.values() if has_place(r)])
        columns = ["write_id", *UTM_COORDINATES]
        batches = self._read(IMAGES, own, "where they were taken:", columns)
        found = pa.Table.from_batches(batches, pa.schema([SPECS[IMAGES].schema.field(c) for c in columns]))
        utm = np.column_stack([found[name].to_numpy() for name in UTM_COORDINATES])
        grouped = _grouped(found["write_id"])
        medians = {}
        for map_id, row in self._rows.items():
            if has_place(row) and row["write_id"] in grouped:
                middle = np.median(utm[grouped[row["write_id"]]], axis=0)
                medians[map_id] = frame_of(row).enu_from_utm(middle, row["epsg"])
        return medians

    def get_any(self, map_id: str) -> MapSummary | UnplacedSummary:
        """The summary of one map, retired or not.

        Raises:
            MapNotFoundError: the snapshot has no such map.
        """
        row = self._row(map_id)
        return _summary(row) if has_place(row) else _unplaced_summary(row)

    def find(self, start: str, *, include_retired: bool = False) -> MapSummary | UnplacedSummary:
        """The map of this id, or the only one whose id begins so.

        Raises:
            MapNotFoundError: there is none, or several begin so.
        """
        ids = [row["map_id"] for row in self._oldest_first(include_retired)]
        kind = "map" if include_retired else "live map"
        none = f"snapshot {self.version} has no {kind} {start}; `featuredb maps` lists what there is"
        return self.get_any(full_id(start, ids, "maps", MapNotFoundError, none))

    def lineages(self) -> dict[str, MapLineage]:
        """What each map of the snapshot stands on, retired ones included, by id."""
        known = {m.map_id: m for m in self.maps(include_retired=True)}
        return {map_id: trace(map_id, known) for map_id in known}

    def maps_in(self, epsg: int, e0: float, n0: float, e1: float, n1: float) -> list[MapSummary]:
        """Maps of one UTM zone, not retired, whose box touches e0 <= e <= e1, n0 <= n <= n1 (metres)."""
        return [m for m in self.maps() if m.epsg == epsg and m.box and m.box.touches(e0, n0, e1, n1)]

    def load_map(self, map_id: str) -> FeatureMap:
        """The map with a place exactly as it was committed; only its status may differ.

        Raises:
            MapNotFoundError, UnplacedMapError: as `get`.
            StoreError: rows are missing or unreadable.
        """
        loaded = self.load_any(self.get(map_id).map_id)
        assert isinstance(loaded, FeatureMap)
        return loaded

    def load_bare(self, map_id: str) -> FeatureMap:
        """The map with a place, without its images, points and observations (`FeatureMap.bare`).

        Raises:
            MapNotFoundError, UnplacedMapError, StoreError: as `load_map`.
        """
        row = self._row(self.get(map_id).map_id)
        bare = {**row, "images": 0, "points": 0, "observations": 0}
        loaded = decode_map(bare, dict.fromkeys(CHILD_TABLES, ()))
        assert isinstance(loaded, FeatureMap)
        return loaded.bare()

    def images_of(self, map_ids: Collection[str]) -> dict[str, tuple[MapImage, ...]]:
        """Images of maps, by map, in their order.

        Raises:
            MapNotFoundError, StoreError: as `load_any`.
        """
        rows = [self._row(map_id) for map_id in map_ids]
        own: Condition = ("write_id", "in", [row["write_id"] for row in rows])
        found = self._read(IMAGES, own, "the maps'") if rows else []
        table = pa.Table.from_batches(found, SPECS[IMAGES].schema).combine_chunks()
        grouped = _grouped(table["write_id"])
        none = np.zeros(0, np.int64)
        return {
            row["map_id"]: decode_images(
                table.take(grouped.get(row["write_id"], none)).to_batches(), row["images"]
            )
            for row in rows
        }

    def load_unplaced(self, map_id: str) -> UnplacedMap:
        """The map without a place exactly as it was committed; only its status may differ.

        Raises:
            MapNotFoundError, StoreError: as `load_any`; and where the map has a place.
        """
        loaded = self.load_any(map_id)
        if isinstance(loaded, FeatureMap):
            raise MapNotFoundError(f"map {map_id} has a place; expected one without")
        return loaded

    def load_any(self, map_id: str) -> AnyMap:
        """The map, with a place or without, exactly as it was committed; only its status may differ.

        Raises:
            MapNotFoundError: the snapshot has no such map.
            StoreError: rows are missing or unreadable.
        """
        row = self._row(map_id)
        own: Condition = ("write_id", "=", row["write_id"])
        whose = f"map {map_id}: its"
        return decode_map(row, {name: self._read(name, own, whose) for name in CHILD_TABLES})

    def dataset(self, table: str, *, include_retired: bool = True) -> ds.Dataset:
        """The child rows that this snapshot sees, as an Arrow dataset that reads when asked."""
        write_ids = [
            row["write_id"] for row in self._rows.values() if include_retired or row["status"] != RETIRED
        ]
        return self._children[table].dataset([("write_id", "in", write_ids)])

    def rows(self) -> list[Row]:
        """All rows of `maps`, as dictionaries."""
        return list(self._rows.values())

    def _row(self, map_id: str) -> Row:
        if map_id not in self._rows:
            raise MapNotFoundError(
                f"snapshot {self.version} has no map {map_id}; `featuredb maps` lists what there is"
            )
        return self._rows[map_id]

    def _read(
        self, table: str, where: Condition, whose: str, columns: list[str] | None = None
    ) -> list[pa.RecordBatch]:
        """Rows of one child table, from the few files that can hold them."""
        child = self._children[table]
        with read_errors(f"cannot read {whose} {table}"):
            try:
                found = child.dataset([where]).to_table(columns, use_threads=False)
            except FileNotFoundError:
                # Compacted and vacuumed since this snapshot was taken: the same rows, in newer files.
                child.refresh()
                found = child.dataset([where]).to_table(columns, use_threads=False)
        batches: list[pa.RecordBatch] = found.to_batches()
        return batches


def full_id(start: str, ids: Collection[str], what: str, error: type[StoreError], none: str) -> str:
    """The id that is meant by itself, or by its first letters if no other begins so.

    Raises:
        StoreError: of the class `error`; there is no such id, as `none` says, or several begin so.
    """
    found = [start] if start in ids else [i for i in ids if start and i.startswith(start)]
    if len(found) > 1:
        some = ", ".join(sorted(found)[:4])
        raise error(f"{start}: {len(found)} {what} begin so ({some}); write more of the id")
    if not found:
        raise error(none)
    return found[0]


def _grouped(column: pa.ChunkedArray) -> dict[str, NDArray[np.int64]]:
    """Rows of each of the values of a column of text."""
    encoded = column.combine_chunks().dictionary_encode()
    group = encoded.indices.to_numpy()
    order = np.argsort(group, kind="stable")
    ends = np.searchsorted(group[order], np.arange(len(encoded.dictionary) + 1))
    return {
        value: order[start:end]
        for value, (start, end) in zip(encoded.dictionary.to_pylist(), itertools.pairwise(ends), strict=True)
    }


def _unplaced_summary(row: Row) -> UnplacedSummary:
    frame = OwnFrame(metric=row["frame_is_metric"], upright=row["frame_is_upright"])
    return of_columns(UnplacedSummary, {**row, "frame": frame, "no_place": decode_no_place(row)})


def _summary(row: Row) -> MapSummary:
    drift_m, budget_m = drift_and_budget(json.loads(row["placement_evidence"]))
    values = {
        "box": None if row[BOUNDS[0]] is None else of_columns(UtmBox, row),
        "tiles": tuple(row["tiles"]),
        "parents": tuple(row["parents"]),
        "drift_m": drift_m,
        "budget_m": budget_m,
    }
    return of_columns(MapSummary, {**row, **values})
