"""A new anchor re-places what was grown: overlaps measured, graph solved, all maps moved in one commit."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapStatus
from featuredb.maps.lineage import GROWTH
from featuredb.maps.move import covariance_in_frame, in_frame, move_map
from featuredb.store import Database, Snapshot
from featuredb.store.canaries import list_canaries
from ingest.growth.graph.map_graph import (
    OWN,
    PlacedMap,
    StoredEdge,
    family,
    graph_edges,
    graph_nodes,
    in_graph,
    place_of,
    placed_maps,
)
from ingest.growth.graph.new_overlaps import NewOverlaps, measure_new, overlaps_to_measure
from ingest.growth.graph.pose_graph import GraphSolution, PoseGraphOptions, solve_pose_graph
from ingest.growth.map_places import drift_m, growth_of, inflated, places_of
from ingest.growth.place.overlaps import OverlapOptions
from ingest.growth.trust.canaries import CanaryCheck, CanaryOptions, CanaryRun, check_known
from reloc.localiser import Localiser

# Said of maps whose parent was placed anew, see featuredb.store.changes.
_FLAG = "was placed anew"
_SAME_M = 1e-6  # an answer that moves by less was not touched


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplaceOptions:
    """How maps are re-placed.

    Attributes:
        gap_m: boxes of a grown map and a new anchor that come this close are looked at for an overlap.
        min_move_m: anchors that would move by less stay where they are, and maps are not committed anew.
    """

    gap_m: float = 5.0
    min_move_m: float = 0.01
    canaries: CanaryOptions = field(default_factory=CanaryOptions)
    overlap: OverlapOptions = field(default_factory=OverlapOptions)
    graph: PoseGraphOptions = field(default_factory=PoseGraphOptions)


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
        reason: None, the pose graph's, or CANARY; `message` for people. Nothing was committed where there
            is one.
        version: of the database since; -1 where nothing was committed.
        moved: all maps that were committed anew.
        measured: what was said of each new overlap, "map - anchor: ...".
        left_out: overlaps that contradict the rest.
        flagged: maps that are quarantined now, because they hang on a moved one by no overlap that holds.
    """

    reason: str | None
    message: str
    version: int = -1
    moved: tuple[MovedMap, ...] = ()
    measured: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    flagged: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "reason": self.reason,
            "message": self.message,
            "version": self.version,
            "moved": [
                {
                    "map_id": m.map_id,
                    "move_m": round(m.move_m, 4),
                    "drift_before_m": m.drift_before_m,
                    "drift_m": round(m.drift_m, 4),
                }
                for m in self.moved
            ],
            "measured": list(self.measured),
            "left_out": list(self.left_out),
            "flagged": list(self.flagged),
        }


def replace_descendants(
    database: Database, work: Path, options: ReplaceOptions | None = None, *, budget_m: float
) -> Replacement | None:
    """Look for new anchors and anchors placed anew around grown maps, and re-place the maps by them.

    Returns:
        None where there is nothing new.

    Raises:
        ConflictError: someone else changed one of the maps meanwhile; nothing has changed.
        StoreError
    """
    options = options or ReplaceOptions()
    snapshot = database.snapshot()
    maps = placed_maps(snapshot)
    wanted = overlaps_to_measure(maps, options.gap_m)
    if not wanted:
        return None
    measured = measure_new(snapshot, maps, wanted, work, options.overlap)
    if not measured.edges:
        return None
    members = _members(maps, measured)
    frame = next(maps[m].frame for m in members if maps[m].is_anchor)
    solution = _solve(maps, members, measured, frame, options)
    left_out = tuple(str(fit.edge) for fit in solution.left_out)
    if solution.reason is not None:
        return Replacement(
            reason=solution.reason, message=solution.message, measured=measured.notes, left_out=left_out
        )
    return _commit(database, snapshot, maps, measured, solution, frame, options, budget_m)


def _members(maps: Mapping[str, PlacedMap], measured: NewOverlaps) -> list[str]:
    """All maps that the new overlaps have a say in."""
    pairs = [(m, e.map_id) for m, placed in maps.items() for e in placed.edges if _holds(maps, e)]
    pairs += [(m, e.map_id) for m, edges in measured.edges.items() for e in edges]
    return sorted(family(maps, pairs, measured.edges))


def _holds(maps: Mapping[str, PlacedMap], edge: StoredEdge) -> bool:
    return edge.map_id in maps and maps[edge.map_id].place == edge.place


def _solve(
    maps: Mapping[str, PlacedMap],
    members: list[str],
    measured: NewOverlaps,
    frame: LocalFrame,
    options: ReplaceOptions,
) -> GraphSolution:
    known = [edge for _, edge in graph_edges(maps, members, frame)]
    new = [in_graph(m, e, maps[m].frame, frame) for m, edges in measured.edges.items() for e in edges]
    return solve_pose_graph(graph_nodes(maps, members, frame), [*known, *new], options.graph)


def _commit(
    database: Database,
    snapshot: Snapshot,
    maps: Mapping[str, PlacedMap],
    measured: NewOverlaps,
    solution: GraphSolution,
    frame: LocalFrame,
    options: ReplaceOptions,
    budget_m: float,
) -> Replacement:
    moved: dict[str, FeatureMap] = {}
    ways: dict[str, float] = {}
    corrections: dict[str, Sim3] = {}
    for map_id, correction in solution.corrections.items():
        own = in_frame(correction, frame, maps[map_id].frame)
        ways[map_id] = _way(own, maps[map_id].corners)
        if maps[map_id].is_anchor and ways[map_id] < options.min_move_m:
            own = Sim3.identity()
        else:
            covariance = covariance_in_frame(solution.covariance[map_id], frame, maps[map_id].frame)
            there = move_map(snapshot.load_map(map_id), own, covariance=covariance)
            moved[map_id] = there if maps[map_id].is_anchor else inflated(there)
        corrections[map_id] = own
    places = {m: place_of(moved[m]) if m in moved else maps[m].place for m in solution.corrections}
    contradicting = {(fit.edge.a, fit.edge.b) for fit in solution.left_out}
    new, reports = [], []
    for map_id, feature_map in moved.items():
        edges = [
            _carried(e, map_id, maps, corrections, places)
            for e in [*(e for e in maps[map_id].edges if _holds(maps, e)), *measured.edges.get(map_id, [])]
            if (map_id, e.map_id) not in contradicting and e.map_id in corrections
        ]
        finished, drift = _with_evidence(feature_map, maps[map_id], edges, solution, frame, budget_m)
        finished = replace(finished, status=_status(maps[map_id], drift, budget_m))
        new.append(finished)
        before = growth_of(maps[map_id].evidence).get("drift_m")
        reports.append(MovedMap(map_id=map_id, move_m=ways[map_id], drift_before_m=before, drift_m=drift))
    new = _with_generations(new, maps)
    canaries = ask_persons_canaries(database, {m.map_id: m for m in new}, options.canaries)
    if canaries.regressions:
        return Replacement(
            reason="CANARY",
            message=f"nothing is moved: {canaries.message}",
            measured=measured.notes,
            left_out=tuple(str(fit.edge) for fit in solution.left_out),
        )
    results = database.commit_maps(
        new, replaces=[m.map_id for m in new], based_on={m.map_id: maps[m.map_id].write_id for m in new}
    )
    return Replacement(
        reason=None,
        message=f"{len(new)} maps placed anew: {solution.message}",
        version=max(r.version for r in results),
        moved=tuple(reports),
        measured=measured.notes,
        left_out=tuple(str(fit.edge) for fit in solution.left_out),
        flagged=tuple(sorted({m for r in results for m in r.flagged})),
    )


def ask_persons_canaries(
    database: Database, new: Mapping[str, FeatureMap], options: CanaryOptions
) -> CanaryRun:
    """The known queries that a person vouches for, before and after maps move.

    Images of the maps move along, and so do remembered answers. Where someone knows the truth, an answer that
    is wrong afterwards must at least have come much nearer: before, the new anchor answered already, and may
    have been as wrong.
    """
    known = [canary for canary in list_canaries(database) if canary.origin == "person"]
    if not known:
        return CanaryRun(checks=(), note="no known queries")
    before = Localiser.open(database)
    after = Localiser.open(database, previous=before, instead=new)
    checks = [check_known(database, canary, before, after, options) for canary in known]
    return CanaryRun(checks=tuple(_judged(check) for check in checks), note=f"{len(known)} known queries")


def _judged(check: CanaryCheck) -> CanaryCheck:
    untouched = abs(check.error_m - check.error_before_m) < _SAME_M
    nearer = check.before == "moved" and check.error_m <= 0.5 * check.error_before_m
    if check.regression or check.after not in ("moved", "found") or untouched or nearer:
        return check
    return replace(check, regression=f"{check.error_m:.2f} m off, once the maps have moved")


def _way(move: Sim3, corners: FloatArray) -> float:
    places = corners if len(corners) else np.zeros((1, 3))
    return float(np.linalg.norm(move.act(places) - places, axis=1).max())


def _carried(
    edge: StoredEdge,
    map_id: str,
    maps: Mapping[str, PlacedMap],
    corrections: Mapping[str, Sim3],
    places: Mapping[str, str],
) -> StoredEdge:
    """An overlap in the coordinates of the new places: Z' = X_other Z X_map^-1."""
    other = in_frame(corrections[edge.map_id], maps[edge.map_id].frame, maps[map_id].frame)
    adjoint = other.adjoint()
    return replace(
        edge,
        place=places[edge.map_id],
        other_from_map=other @ edge.other_from_map @ corrections[map_id].inverse(),
        covariance=_symmetric(adjoint @ edge.covariance @ adjoint.T),
        shared=adjoint @ edge.shared,
    )


def _with_evidence(
    feature_map: FeatureMap,
    before: PlacedMap,
    edges: list[StoredEdge],
    solution: GraphSolution,
    frame: LocalFrame,
    budget_m: float,
) -> tuple[FeatureMap, float]:
    """The moved map with its new covariance, drift and overlaps; and its drift."""
    map_id, own = feature_map.map_id, feature_map.frame
    relative = covariance_in_frame(solution.covariance_relative[map_id], frame, own)
    drift = drift_m(relative, places_of(feature_map))
    growth = growth_of(feature_map.placement.evidence)
    if before.is_anchor:
        total = in_frame(solution.corrections[map_id], frame, own) @ before.present_from_own
        growth[OWN] = {
            "covariance": before.own_covariance.ravel().tolist(),
            "present_from_own": total.log().tolist(),
        }
    else:
        growth |= {
            "drift_m": round(drift, 6),
            "budget_m": budget_m,
            "covariance_relative": relative.ravel().tolist(),
            "edges": [edge.as_json() for edge in edges],
        }
    placement = replace(
        feature_map.placement,
        evidence={**feature_map.placement.evidence, GROWTH: growth},
    )
    parents = before.parents
    if not before.is_anchor:
        held = tuple(dict.fromkeys(edge.map_id for edge in edges))
        kept = tuple(m for m in before.parents if m in held)
        # Only anchors join the parents: a map never becomes its own ancestor.
        parents = (*kept, *(m for m in held if m not in kept)) or before.parents
    return replace(feature_map, placement=placement, parents=parents), drift


def _with_generations(new: list[FeatureMap], maps: Mapping[str, PlacedMap]) -> list[FeatureMap]:
    generation = {m: placed.generation for m, placed in maps.items()}
    parents = {m.map_id: m.parents for m in new if m.parents}
    for _ in range(len(new)):
        for map_id, of in parents.items():
            generation[map_id] = 1 + max(generation.get(p, 0) for p in of)
    return [replace(m, generation=generation[m.map_id]) for m in new]


def _status(before: PlacedMap, drift: float, budget_m: float) -> MapStatus:
    """Active maps stay so; those that were quarantined for their parent's sake are active again."""
    if before.status == "active":
        return "active"
    return "active" if _FLAG in before.status_reason and drift <= budget_m else "quarantined"


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)
