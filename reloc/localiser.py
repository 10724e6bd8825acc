"""The active maps of one snapshot, indexed and ready to answer."""

import logging
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from featuredb.errors import FeatureDbError, MapNotFoundError, StoreError, UnplacedBesideOthersError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area, join_segments
from featuredb.index.segment import Segment, segment_of
from featuredb.index.segment_files import SegmentFiles
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.lineage import MapLineage
from featuredb.maps.move import placed_map
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database, MapSummary, Snapshot
from featuredb.store.snapshot import full_id
from featuredb.store.tables import BOUNDS
from reloc.localise.candidates import IndexedArea, indexed_together
from reloc.localise.localise import localise
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest, LocaliseResult
from reloc.wire.query import CameraUsed, InMapPose, Lineage

_LOG = logging.getLogger(__name__)
# Maps whose boxes come this close belong to one area: a photo may see both.
_AREA_GAP_M = 300.0
_NAMED = 3  # maps in quarantine that an answer names

_Value = TypeVar("_Value")

_STAND_IN = LocalFrame(latitude_deg=0.0, longitude_deg=3.0, height_m=0.0)


def at_stand_in(unplaced: UnplacedMap) -> FeatureMap:
    """The map at a place that means nothing, whose local frame is the map's own; exactly placed."""
    placement = Placement(
        method="map", local_from_sfm=Sim3.identity(), covariance=np.zeros((7, 7)), residual_rms_m=0.0
    )
    return placed_map(unplaced, placement, _STAND_IN, "unknown")


def in_own_frame(result: LocaliseResult, unplaced: UnplacedMap) -> LocaliseResult:
    """The result of a search of `at_stand_in(unplaced)`, without anything that could be taken for a place."""
    pose = result.pose
    if pose is None:
        return replace(result, runner_up=None)
    turned = quaternion_from_matrix(pose.cam_from_local.rotation)
    in_map = InMapPose(
        map_id=unplaced.map_id,
        metric=unplaced.frame.metric,
        upright=unplaced.frame.upright,
        cam_from_map_xyzw=tuple(turned.tolist()),
        cam_from_map_translation=tuple(pose.cam_from_local.translation.tolist()),
        center=tuple(pose.cam_from_local.center.tolist()),
        covariance=tuple(map(tuple, pose.covariance.tolist())),
        camera=CameraUsed(**asdict(pose.camera), source=pose.camera_source),
        residual_rms_px=pose.residual_rms_px,
    )
    return replace(result, pose=None, in_map=in_map, runner_up=None)


class OnDemand(Generic[_Value]):
    """An area that answers only where it is named: read when somebody first names it, and kept."""

    def __init__(self, write_id: str, read: Callable[[], _Value]) -> None:
        self.write_id = write_id
        self._read = read
        self._lock = threading.Lock()
        self._value: _Value | None = None

    def get(self) -> _Value:
        with self._lock:
            if self._value is None:
                self._value = self._read()
            return self._value

    def __reduce__(self) -> tuple[object, ...]:
        """With its value, which is not kept for that, or with why it cannot be read."""
        try:
            value = self._read() if self._value is None else self._value
        except FeatureDbError as error:
            _LOG.warning("a map that answers only where it is named cannot be read: %s", error)
            return OnDemand, (self.write_id, partial(_unreadable, str(error)))
        return OnDemand, (self.write_id, partial(_given, value))


def _given(value: _Value) -> _Value:
    return value


def _unreadable(message: str) -> Any:
    raise StoreError(message)


_OwnArea = tuple[UnplacedMap, IndexedArea]
_State = tuple[FeatureMap, Segment]  # a bare map, and what is laid out of it


class Localiser:
    """Answers queries from one snapshot of a database, which never changes; threads may share it."""

    def __init__(
        self,
        loaded: Mapping[tuple[str, ...], IndexedArea],  # by what they are made of, sorted write ids of maps
        options: LocaliseOptions,
        snapshot: int,
        lineages: Mapping[str, MapLineage],  # by map id, as are the others
        unplaced: Mapping[str, OnDemand[_OwnArea]],
        provisional: Mapping[str, OnDemand[IndexedArea]],
    ) -> None:
        self._loaded = loaded
        self.options, self.snapshot = options, snapshot
        # Of the snapshot, not of an area: an area that is taken over may hang on maps that have changed.
        self._lineages = lineages
        self._unplaced, self._provisional = unplaced, provisional
        self._states: dict[str, _State] = {}

    @property
    def areas(self) -> tuple[IndexedArea, ...]:
        """All, of whatever extractor; those whose maps did not change stay the same over reloads."""
        return tuple(self._loaded.values())

    @classmethod
    def open(
        cls,
        database: Database,
        options: LocaliseOptions | None = None,
        as_of: int | datetime | None = None,  # None: the newest
        *,
        previous: "Localiser | None" = None,  # areas that have not changed since are taken over from it
        served: Callable[[MapSummary], bool] = lambda summary: True,  # which maps with a place are there
        also: Collection[str] = (),  # quarantined maps that take part as if they were active: a trial
        instead: Mapping[str, FeatureMap] | None = None,  # by id, states not yet committed: a trial, too
    ) -> "Localiser":
        """Load and index the active maps of a snapshot.

        Maps in quarantine that are placed by positions alone answer where they are named.

        Raises:
            StoreError: the database cannot be read.
        """
        options = options or LocaliseOptions()
        snapshot = database.snapshot(as_of)
        placed = [m for m in snapshot.maps() if served(m)]
        taken = [m for m in placed if m.status == "active" or m.map_id in also]
        active = [m for m in taken if m.descriptors and m.box]
        before = previous or cls({}, options, 0, {}, {}, {})
        known, states = before._loaded, dict(before._states)
        loaded: dict[tuple[str, ...], Area] = {}
        trial = instead or {}
        files = SegmentFiles(database.url)
        for group in _group(active):
            key = tuple(sorted(f"trial {m.map_id}" if m.map_id in trial else m.write_id for m in group))
            tried = any(m.map_id in trial for m in group)
            if key in known and not tried:
                loaded[key] = known[key].area
            else:
                loaded[key] = _load(files, snapshot, group, states, trial)
        had = {d.write_id: d for d in before._unplaced.values()}
        unplaced = {
            m.map_id: had.get(m.write_id) or OnDemand(m.write_id, partial(_own_area, snapshot, m.map_id))
            for m in snapshot.unplaced_maps()
            if m.descriptors
        }
        held = {d.write_id: d for d in before._provisional.values()}
        provisional = {
            m.map_id: held.get(m.write_id)
            or OnDemand(m.write_id, partial(_load_alone, database.url, snapshot, m))
            for m in placed
            if m.status == "quarantined" and m.method == "gps" and m.map_id not in also and m.descriptors
        }
        indexed = dict(zip(loaded, indexed_together(list(loaded.values()), before.areas), strict=True))
        files.settle()
        made = cls(indexed, options, snapshot.version, snapshot.lineages(), unplaced, provisional)
        made._states = {m.write_id: states[m.write_id] for m in active if m.write_id in states}
        return made

    def __getstate__(self) -> dict[str, object]:
        """Without what only the next one needs."""
        return {**self.__dict__, "_states": {}}

    def areas_of(self, map_ids: tuple[str, ...] | None) -> list[IndexedArea]:
        """All areas, or those of the maps named by id or first letters, of which only these are searched.

        Raises:
            MapNotFoundError: the snapshot serves no such map.
        """
        if map_ids is None:
            return list(self.areas)
        wanted = set(self._full_ids(map_ids, self._placed_ids()))
        ids_of = [{m.map_id for m in indexed.area.maps} for indexed in self.areas]
        chosen = [
            indexed if ids <= wanted else indexed.only(wanted)
            for indexed, ids in zip(self.areas, ids_of, strict=True)
            if ids & wanted
        ]
        return chosen + [
            self._provisional[map_id].get() for map_id in sorted(wanted & self._provisional.keys())
        ]

    def _placed_ids(self) -> set[str]:
        return {m.map_id for indexed in self.areas for m in indexed.area.maps} | self._provisional.keys()

    def _full_ids(self, map_ids: Iterable[str], served: Collection[str]) -> list[str]:
        """The ids that are meant, by themselves or by their first letters. Raises MapNotFoundError."""
        none = f"snapshot {self.snapshot} serves no map %s; `featuredb maps` lists what there is"
        return [full_id(start, served, "maps", MapNotFoundError, none % start) for start in map_ids]

    def own_area_of(self, map_ids: tuple[str, ...] | None) -> _OwnArea | None:
        """The map without a place that is named alone, and its area, whose local frame is the map's own.

        Whoever asks for it has to word every pose in the map's frame: the area's place means nothing.

        Raises:
            MapNotFoundError: the snapshot serves no such map.
            UnplacedBesideOthersError: it is named beside others.
        """
        ids = self._full_ids(map_ids or (), self._placed_ids() | self._unplaced.keys())
        named = [m for m in ids if m in self._unplaced]
        if not named:
            return None
        if len(set(ids)) > 1:
            raise UnplacedBesideOthersError(
                f"map {named[0]} has no place: expected it to be named alone, since its answers are in a "
                f"frame of its own, found {', '.join(ids)}"
            )
        return self._unplaced[named[0]].get()

    def localise(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, size: tuple[int, int] | None = None
    ) -> LocaliseResult:
        """Pose of the image (h, w) uint8, or the reason why there is none.

        Args:
            size: width and height of the image, where `gray` is smaller, as for `extract`.

        Raises:
            MapNotFoundError: the request names maps that the snapshot does not serve.
            UnplacedBesideOthersError: it names a map without a place beside others.
            IncompatibleExtractorError: all maps are of another extractor.
            ImageError: not a usable image.
        """
        own = self.own_area_of(request.map_ids)
        if own is not None:
            unplaced, area = own
            told = replace(request, prior=None, own_position=None, beyond=None, map_ids=None)
            return in_own_frame(localise(gray, told, [area], self.options, self.snapshot, size), unplaced)
        areas = self.areas_of(request.map_ids)
        found = localise(gray, request, areas, self.options, self.snapshot, size)
        if found.reason == "NO_COVERAGE" and request.map_ids is None and self._provisional:
            named = ", ".join(sorted(self._provisional)[:_NAMED])
            detail = f"{found.detail}; maps in quarantine answer only where they are named, {named}"
            return replace(found, detail=detail)
        return self._with_lineage(found)

    def _with_lineage(self, result: LocaliseResult) -> LocaliseResult:
        """The result of one of the areas, with the chain to its anchors for each map that answered."""
        if result.pose is None:
            return result
        names = ("steps", "anchors", "drift_m", "budget_m")
        told = tuple(
            Lineage(**dict(entry) | {name: getattr(self._lineages[entry.map_id], name) for name in names})
            for entry in result.pose.lineage
        )
        return replace(result, pose=replace(result.pose, lineage=told))


def _own_area(snapshot: Snapshot, map_id: str) -> _OwnArea:
    """A map without a place, and its area at the stand-in."""
    unplaced = snapshot.load_unplaced(map_id)
    indexed = IndexedArea.of([at_stand_in(unplaced)])
    return replace(unplaced, observations=unplaced.observations.none()), indexed


def _load(
    files: SegmentFiles,
    snapshot: Snapshot,
    group: Sequence[MapSummary],
    states: dict[str, _State],
    instead: Mapping[str, FeatureMap],
) -> Area:
    """The area of some maps; `states`, by write id: what was laid out before, and what is now, too."""

    def state(summary: MapSummary) -> _State:
        map_id, write_id = summary.map_id, summary.write_id
        if map_id in instead:
            return instead[map_id].bare(), segment_of(instead[map_id])
        if write_id not in states:
            segment = files.get(write_id, lambda: segment_of(snapshot.load_map(map_id)))
            states[write_id] = snapshot.load_bare(map_id), segment
        return states[write_id]

    chosen = [state(m) for m in group]
    area = join_segments([bare for bare, _ in chosen], [segment for _, segment in chosen])
    points, images = len(area.points), len(area.image_map)
    _LOG.info("area of %d maps: %d points, %d images", len(group), points, images)
    return area


def _load_alone(url: str, snapshot: Snapshot, summary: MapSummary) -> IndexedArea:
    files = SegmentFiles(url)
    indexed = indexed_together([_load(files, snapshot, [summary], {}, {})])[0]
    files.settle()
    return indexed


def _group(maps: Sequence[MapSummary]) -> list[list[MapSummary]]:
    """Maps whose boxes come within _AREA_GAP_M of each other, directly or through others.

    Maps of one group share an extractor and a height datum: heights of different datums do not mix. Boxes are
    compared as spheres around their middles in one Cartesian frame, across zone borders.
    """
    if not maps:
        return []
    boxes = np.array([[getattr(m.box, name) for name in BOUNDS] for m in maps]).reshape(-1, 2, 3)
    middle, radius = boxes.mean(axis=1), 0.5 * np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1)
    zone = np.array([m.epsg for m in maps])
    east, north, up = middle[0].tolist()
    frame = LocalFrame.from_utm(east, north, up, maps[0].epsg)
    place = np.empty_like(middle)
    for epsg in np.unique(zone):
        place[zone == epsg] = frame.enu_from_utm(middle[zone == epsg], int(epsg))
    # Of two maps that are near each other, the larger one finds the other within twice its own radius.
    found = cKDTree(place).query_ball_point(place, 2.0 * radius + _AREA_GAP_M)
    rows = np.repeat(np.arange(len(maps)), [len(others) for others in found])
    columns = np.concatenate(found).astype(np.int64)
    gap = np.linalg.norm(place[rows] - place[columns], axis=1) - radius[rows] - radius[columns]
    kind = np.array([f"{m.extractor_fingerprint} {m.height_datum}" for m in maps])
    near = (gap < _AREA_GAP_M) & (kind[rows] == kind[columns])
    graph = coo_array((np.ones(near.sum()), (rows[near], columns[near])), shape=(len(maps), len(maps)))
    count, label = connected_components(graph, directed=False)
    groups: list[list[MapSummary]] = [[] for _ in range(count)]
    for summary, of in zip(maps, label, strict=True):
        groups[of].append(summary)
    return groups
