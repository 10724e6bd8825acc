"""A new anchor re-places what was grown: overlaps measured, graph solved, all maps moved in one commit."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import covariance_in_frame, in_frame, move_map
from featuredb.store import Database, Snapshot
from featuredb.store.canaries import list_canaries
from featuredb.store.commits import write_time
from ingest.growth.asked_before import recall, remember
from ingest.growth.graph.map_graph import OWN, PlacedMap, holds, place_key, placed_maps, solve_maps
from ingest.growth.graph.pose_graph import GraphSolution
from ingest.growth.map_places import drift_m, growth_of, inflated, places_of, with_growth, with_overlaps
from ingest.growth.place.map_images import measure_overlap
from ingest.growth.trust.canaries import CanaryRun, check_known
from ingest.growth.trust.promotion import PARENT_MOVED
from ingest.growth.values import Edge
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
_LEAST_MOVE_M = 0.01  # anchors that would move by less stay where they are
_GAP_M = 5.0  # boxes of a grown map and a new anchor that come this close are looked at for an overlap
_SAME_M = 1e-6  # an answer that moves by less was not touched


@dataclass(frozen=True, slots=True, kw_only=True)
class MovedMap:
    """A map that was placed anew.

    Attributes:
        move_m: largest way of a corner of its points' box.
        drift_before_m, drift_m: bound on its drift against its anchors; None: was not known.
    """

    map_id: str
    move_m: float
    drift_before_m: float | None
    drift_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Replacement:
    """What became of the grown maps around new anchors.

    Attributes:
        reason: None, the pose graph's, or CANARY; where there is one, nothing was committed.
        version: of the database since, or -1. moved: all maps that were committed anew.
        left_out: overlaps that contradict the rest.
        flagged: maps that are quarantined now: they hang on a moved one by no overlap that holds.
    """

    reason: str | None
    message: str
    version: int = -1
    moved: tuple[MovedMap, ...] = ()
    left_out: tuple[str, ...] = ()
    flagged: tuple[str, ...] = ()


def replace_descendants(database: Database, work: Path, *, budget_m: float) -> Replacement | None:
    """Look for new anchors and anchors placed anew around grown maps, re-place the maps by them; or None.

    Raises:
        ConflictError: someone else changed one of the maps meanwhile; nothing has changed.
        StoreError
    """
    snapshot = database.snapshot()
    maps = placed_maps(snapshot)
    edges = _measured(snapshot, maps, overlaps_to_measure(maps), work)
    if not edges:
        return None
    frame = maps[min(edges)].frame
    solution = solve_maps(maps, edges, frame)
    told = Replacement(
        reason=solution.reason, message=solution.message, left_out=tuple(map(" - ".join, solution.left_out))
    )
    if solution.reason is not None:
        return told
    moved, reports = _moved(snapshot, maps, edges, solution, frame, budget_m)
    canaries = ask_persons_canaries(database, {m.map_id: m for m in moved})
    if canaries.regressions:
        return replace(told, reason="CANARY", message=f"nothing is moved: {canaries.gate.message}")
    ids = [m.map_id for m in moved]
    results = database.commit_maps(
        moved, replaces=ids, based_on={map_id: maps[map_id].summary.write_id for map_id in ids}
    )
    return replace(
        told,
        message=f"{len(moved)} maps placed anew: {solution.message}",
        version=max(r.version for r in results),
        moved=tuple(reports),
        flagged=tuple(sorted({m for r in results for m in r.flagged})),
    )


def overlaps_to_measure(maps: Mapping[str, PlacedMap]) -> list[tuple[str, str]]:
    """Pairs of a grown map and a map that may hold it: parents placed anew, and anchors that came later."""
    pairs: set[tuple[str, str]] = set()
    anchors = [m for m in maps.values() if m.is_anchor and m.summary.status == "active"]
    for map_id, me in maps.items():
        if me.is_anchor:
            continue
        places = {edge.map_id: edge.place for edge in me.edges}
        pairs |= {(map_id, m) for m, place in places.items() if m in maps and maps[m].place != place}
        for anchor in anchors:
            later = write_time(anchor.summary.write_id) > write_time(me.summary.write_id)
            if anchor.summary.map_id in places or not later or not len(me.corners) or not len(anchor.corners):
                continue
            box, other = me.corners[:, :2], me.frame.enu_from(anchor.frame).act(anchor.corners)[:, :2]
            apart = (other.min(axis=0) - box.max(axis=0), box.min(axis=0) - other.max(axis=0))
            if np.max(apart) <= _GAP_M:
                pairs.add((map_id, anchor.summary.map_id))
    return sorted(pairs)


def _measured(
    snapshot: Snapshot, maps: Mapping[str, PlacedMap], wanted: Sequence[tuple[str, str]], work: Path
) -> dict[str, list[Edge]]:
    """New overlaps by the map that has them; what was looked for is kept in the work folder."""
    load = cache(snapshot.load_map)
    edges: dict[str, list[Edge]] = {}
    for map_id, other_id in wanted:
        about, places = f"{map_id} {other_id}", f"{maps[map_id].place} {maps[other_id].place}"
        said = recall(work, "overlaps", about, places)
        if said is None:
            found = measure_overlap(load(map_id), load(other_id))
            edge = replace(found, place=maps[other_id].place).as_json() if isinstance(found, Edge) else None
            said = {"edge": edge}
            remember(work, "overlaps", about, said, places)
            _LOG.info("overlap %s - %s: %s", map_id, other_id, "measured" if edge else found)
        if said["edge"] is not None:
            edges.setdefault(map_id, []).append(Edge.from_json(said["edge"]))
    return edges


def _moved(
    snapshot: Snapshot,
    maps: Mapping[str, PlacedMap],
    new_edges: Mapping[str, Sequence[Edge]],
    solution: GraphSolution,
    frame: LocalFrame,
    budget_m: float,
) -> tuple[list[FeatureMap], list[MovedMap]]:
    """The maps at their new places, and what is said of each."""
    moved: dict[str, FeatureMap] = {}
    ways_m: dict[str, float] = {}
    corrections: dict[str, Sim3] = {}
    for map_id, correction in solution.corrections.items():
        before = maps[map_id]
        own = in_frame(correction, frame, before.frame)
        corners = before.corners if len(before.corners) else np.zeros((1, 3))
        ways_m[map_id] = float(np.linalg.norm(own.act(corners) - corners, axis=1).max())
        if before.is_anchor and ways_m[map_id] < _LEAST_MOVE_M:
            own = Sim3.identity()
        else:
            covariance = covariance_in_frame(solution.covariance[map_id], frame, before.frame)
            there = move_map(snapshot.load_map(map_id), own, covariance=covariance)
            moved[map_id] = there if before.is_anchor else inflated(there)
        corrections[map_id] = own
    places = {m: maps[m].place for m in solution.corrections}
    places |= {m: place_key(there.frame, there.placement) for m, there in moved.items()}
    new, reports = [], []
    for map_id, feature_map in moved.items():
        before = maps[map_id]
        edges = []
        for edge in (*(e for e in before.edges if holds(maps, e)), *new_edges.get(map_id, ())):
            if (map_id, edge.map_id) not in solution.left_out and edge.map_id in corrections:
                other = in_frame(corrections[edge.map_id], maps[edge.map_id].frame, before.frame)
                now = edge.carried(other, corrections[map_id])
                edges.append(replace(now, place=places[edge.map_id]))
        finished, drift = _with_evidence(feature_map, before, edges, solution, frame, budget_m)
        # Active maps stay so; those that were quarantined for their parent's sake are active again.
        again = PARENT_MOVED in before.summary.status_reason and drift <= budget_m
        active = before.summary.status == "active" or again
        new.append(replace(finished, status="active" if active else "quarantined"))
        told = {"move_m": round(ways_m[map_id], 4), "drift_m": round(drift, 4)}
        drifted = growth_of(before.placement.evidence).get("drift_m")
        reports.append(MovedMap(map_id=map_id, drift_before_m=drifted, **told))
    return _with_generations(new, maps), reports


def ask_persons_canaries(database: Database, new: Mapping[str, FeatureMap]) -> CanaryRun:
    """The known queries that a person vouches for, before and after maps move.

    An answer that is wrong afterwards must at least have come much nearer: before, the new anchor answered
    already, and may have been as wrong.
    """
    known = [canary for canary in list_canaries(database) if canary.origin == "person"]
    if not known:
        return CanaryRun(checks=(), note="no known queries")
    before = Localiser.open(database)
    after = Localiser.open(database, previous=before, instead=new)
    checks = []
    for check in (check_known(database, canary, before, after) for canary in known):
        untouched = abs(check.error_m - check.error_before_m) < _SAME_M
        nearer = check.before == "moved" and check.error_m <= 0.5 * check.error_before_m
        if not (check.regression or untouched or nearer) and check.after in ("moved", "found"):
            check = replace(check, regression=f"{check.error_m:.2f} m off, once the maps have moved")
        checks.append(check)
    return CanaryRun(checks=tuple(checks), note="known queries")


def _with_evidence(
    feature_map: FeatureMap,
    before: PlacedMap,
    edges: list[Edge],
    solution: GraphSolution,
    frame: LocalFrame,
    budget_m: float,
) -> tuple[FeatureMap, float]:
    """The moved map with its drift, overlaps and parents; and its drift."""
    map_id, own = feature_map.map_id, feature_map.frame
    relative = covariance_in_frame(solution.covariance_relative[map_id], frame, own)
    if before.is_anchor:
        first = before.own_place
        total = in_frame(solution.corrections[map_id], frame, own) @ first.other_from_map.inverse()
        placed = {"covariance": first.covariance.ravel().tolist(), "present_from_own": total.log().tolist()}
        return with_growth(feature_map, **{OWN: placed}), drift_m(relative, places_of(feature_map))
    noted, drift = with_overlaps(feature_map, relative, edges, budget_m)
    held, was = [edge.map_id for edge in edges], before.summary.parents
    # Only anchors join the parents: a map never becomes its own ancestor.
    parents = tuple(dict.fromkeys([*(m for m in was if m in held), *held])) or was
    return replace(noted, parents=parents), drift


def _with_generations(new: list[FeatureMap], maps: Mapping[str, PlacedMap]) -> list[FeatureMap]:
    generation = {m: placed.summary.generation for m, placed in maps.items()}
    parents = {m.map_id: m.parents for m in new if m.parents}
    for _ in range(len(new)):
        for map_id, of in parents.items():
            generation[map_id] = 1 + max(generation.get(p, 0) for p in of)
    return [replace(m, generation=generation[m.map_id]) for m in new]
