"""Maps of a database adjusted together, and committed in one commit."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from featuredb.errors import InvalidValueError
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database, MapSummary, Snapshot
from ingest.growth.graph.joint.adjust import JointAdjustment, adjust_together
from ingest.growth.graph.map_graph import place_of
from ingest.growth.graph.replacing import ask_persons_canaries
from ingest.growth.map_places import growth_of, with_growth
from ingest.growth.values import Edge

# Their places were measured by more than photos.
_MEASURED = ("lidar", "gcp")


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseAdjustment:
    """What became of the maps.

    Attributes:
        reason: None, the adjustment's, or CANARY; nothing was committed where there is one.
        version: of the database since; -1 where nothing was committed.
        descendants: maps that joined because they hang on those that were named.
        flagged: maps that are quarantined now, because they hang on a moved one and could not join.
    """

    reason: str | None
    message: str
    adjustment: JointAdjustment
    version: int = -1
    descendants: tuple[str, ...] = ()
    flagged: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            **self.adjustment.as_json(),
            "reason": self.reason,
            "message": self.message,
            "version": self.version,
            "descendants": list(self.descendants),
            "flagged": list(self.flagged),
        }


def adjust_maps(
    database: Database, named: Sequence[str], *, free: Collection[str] = (), dry_run: bool = False
) -> DatabaseAdjustment:
    """Adjust active maps together, with all active maps that hang on them, held by the parents of them all.

    Args:
        named: ids or their first letters.
        free: anchors, likewise, that may move although LiDAR or control points placed them; others are held.

    Raises:
        InvalidValueError: fewer than two maps, one that is not active, several extractors or datums.
        ConflictError: someone else changed one of the maps meanwhile; nothing has changed.
        MapNotFoundError: no live map of that id, or several that begin so.
        StoreError
    """
    snapshot = database.snapshot()
    live = {m.map_id: m for m in snapshot.maps() if m.status != "retired"}
    active = {name: m for name, m in live.items() if m.status == "active"}
    chosen = [_active(snapshot, name) for name in named]
    wanted = [m for m in _with_descendants(live, chosen) if m in active]
    free_ids = {_active(snapshot, name) for name in free}
    held = {m for m in wanted if active[m].method in _MEASURED and not active[m].parents} - free_ids
    # Parents that are not named hold their children, too: else these would drift away from them.
    parents = sorted({p for m in wanted for p in active[m].parents if p in active} - set(wanted))
    held |= set(parents)
    maps = [snapshot.load_map(m) for m in (*parents, *wanted)]
    found = adjust_together(maps, held, free=free_ids)
    told = DatabaseAdjustment(
        reason=found.reason,
        message=found.message,
        adjustment=found,
        descendants=tuple(m for m in wanted if m not in chosen),
    )
    if found.reason is not None:
        return told
    new = _with_overlaps(found.maps, [m for m in maps if m.map_id in held])
    canaries = ask_persons_canaries(database, {m.map_id: m for m in new})
    if canaries.regressions:
        return replace(told, reason="CANARY", message=f"nothing is moved: {canaries.message}")
    if dry_run:
        return told
    ids = [m.map_id for m in new]
    results = database.commit_maps(new, replaces=ids, based_on={m: active[m].write_id for m in ids})
    flagged = tuple(sorted({m for result in results for m in result.flagged}))
    return replace(told, version=max(result.version for result in results), flagged=flagged)


def _active(snapshot: Snapshot, name: str) -> str:
    found = snapshot.find(name)
    if found.status != "active":
        raise InvalidValueError(f"expected an active map, found {found.map_id}, which is {found.status}")
    return found.map_id


def _with_descendants(live: Mapping[str, MapSummary], chosen: Sequence[str]) -> list[str]:
    """The maps and what hangs on them, by generation: a child left behind would hang where nothing is."""
    wanted = set(chosen)
    while more := {m for m, e in live.items() if m not in wanted and wanted & set(e.parents)}:
        wanted |= more
    return sorted(wanted, key=lambda m: (live[m].generation, -live[m].images, m))


def _with_overlaps(maps: Sequence[FeatureMap], held: Sequence[FeatureMap]) -> list[FeatureMap]:
    """The maps with what growth has measured between them and the held ones as it is now: they agree.

    Overlaps with others are forgotten, until they are measured again.
    """
    places = {m.map_id: place_of(m) for m in (*maps, *held)}
    new = []
    for feature_map in maps:
        known = growth_of(feature_map.placement.evidence).get("edges")
        if known is None:
            new.append(feature_map)
            continue
        edges = [
            replace(e, place=places[e.map_id], other_from_map=Sim3.identity())
            if e.map_id in places
            else replace(e, place="")
            for e in map(Edge.from_json, known)
        ]
        new.append(with_growth(feature_map, edges=[e.as_json() for e in edges]))
    return new
