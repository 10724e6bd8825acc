"""How far a grown map may have drifted from its anchors, by the graph of all maps, and what is enough."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lineage import GROWTH
from ingest.colmap.bridge import Model
from ingest.growth.gates import Gate
from ingest.growth.graph.map_graph import PlacedMap, StoredEdge, no_surer_than, solve_with_new
from ingest.growth.map_places import drift_m, growth_of, inflated, places_of
from ingest.growth.values import GrownMap, Refused
from ingest.sfm.links import keep_photos

_LEAST_PHOTOS = 3  # of a reconstruction
_TRIES = 3  # the part within the budget may lie otherwise, and be cut again


def drift_gate(drift: float, budget_m: float) -> Gate:
    """Whether a map is near enough to its anchors."""
    return Gate(
        name="drift",
        reason="DRIFT_BUDGET",
        figure=drift,
        limit=budget_m,
        passes=drift <= budget_m,
        message=f"it may have drifted {drift:.2f} m from its anchors, {budget_m:.2f} m are allowed; it "
        "waits for an anchor",
    )


def grow_within_budget(
    model: Model,
    grow: Callable[[Model], GrownMap | Refused],
    maps: Mapping[str, PlacedMap],
    budget_m: float,
) -> GrownMap | Refused:
    """The map of a reconstruction with its drift, of the part of it that is within the budget.

    Args:
        grow: from a reconstruction to a map.
        maps: of the snapshot.
    """
    part, everything = model, tuple(model.rows.tolist())
    beyond: dict[int, tuple[str, str]] = {}
    refused = Refused(reason="", message="", rows=())
    for _ in range(_TRIES):
        grown = grow(part)
        if isinstance(grown, Refused):
            return replace(grown, rows=everything)
        feature_map, drift, relative = with_drift(grown, maps, budget_m)
        gate = drift_gate(drift, budget_m)
        if gate.passes:
            return replace(grown, feature_map=feature_map, left_out={**beyond, **grown.left_out})
        gates = (*grown.placement.gates, gate)
        refused = Refused(reason=gate.reason, message=gate.message, rows=everything, gates=gates)
        rows = [int(r) for r in grown.model.rows]
        within = rows_within(feature_map, rows, relative, budget_m)
        left = keep_photos(part, within, least=_LEAST_PHOTOS) if len(within) < len(rows) else None
        if left is None:
            break
        gone = set(part.rows.tolist()) - set(left.rows.tolist())
        beyond |= {r: grown.left_out.get(r, (gate.reason, gate.message)) for r in gone}
        part = left
    return refused


def with_drift(
    grown: GrownMap, maps: Mapping[str, PlacedMap], budget_m: float
) -> tuple[FeatureMap, float, FloatArray]:
    """The map with its overlaps, drift and covariance by the graph of all maps.

    Returns:
        The map, its drift (metres), its covariance (7, 7) relative to the anchors.
    """
    feature_map = grown.feature_map
    growth = growth_of(feature_map.placement.evidence)
    edges = no_surer_than(
        [
            replace(StoredEdge.from_json(edge), place=maps[edge["map_id"]].place)
            for edge in growth.get("edges", ())
            if edge["map_id"] in maps
        ],
        grown.placement.covariance_relative,
    )
    covariance = feature_map.placement.covariance
    relative = np.asarray(growth["covariance_relative"], dtype=np.float64).reshape(7, 7)
    shared = np.reshape(growth.get("shared_turn") or np.zeros(21), (7, 3))
    edges = [replace(edge, shared=shared) for edge in edges]
    solution = solve_with_new(maps, feature_map.map_id, edges, feature_map.frame)
    if solution.reason is None and feature_map.map_id in solution.covariance:
        covariance = solution.covariance[feature_map.map_id]
        relative = solution.covariance_relative[feature_map.map_id]
    drift = drift_m(relative, places_of(feature_map))
    gate = drift_gate(drift, budget_m)
    growth |= {
        "drift_m": round(drift, 6),
        "budget_m": budget_m,
        "covariance_relative": relative.ravel().tolist(),
        "edges": [edge.as_json() for edge in edges],
        "gates": {**growth.get("gates", {}), gate.name: gate.as_json()},
    }
    placement = replace(
        feature_map.placement,
        covariance=covariance,
        evidence={**feature_map.placement.evidence, GROWTH: growth},
    )
    placed = inflated(replace(feature_map, placement=placement))
    return replace(placed, status="quarantined"), drift, relative


def rows_within(
    feature_map: FeatureMap, rows: Sequence[int], relative: FloatArray, budget_m: float
) -> list[int]:
    """Rows of the photos that are within the budget, each with its own bending in place of the largest.

    Args:
        rows: of the map's images, in their order.
        relative: (7, 7) covariance of the map relative to the anchors, with its bending.
    """
    bending_m2 = float(growth_of(feature_map.placement.evidence).get("bending_m", 0.0)) ** 2
    as_a_whole = relative - np.diag([0.0] * 4 + [bending_m2] * 3)
    points = feature_map.points_local()
    seen = feature_map.observations
    within = []
    for row, image in zip(rows, feature_map.images, strict=True):
        own = points[seen.point_index[seen.image_id == image.image_id]]
        pose = image.cam_from_local
        places = np.vstack([own, pose.center[None]])
        excess = bending_m2
        if image.covariance is not None:
            jacobian = point_jacobian(pose.center[None])[0]
            spread = pose.rotation.T @ image.covariance[3:, 3:] @ pose.rotation
            most = np.linalg.eigvalsh(spread - jacobian @ as_a_whole @ jacobian.T)[-1]
            excess = float(np.clip(most, 0.0, bending_m2))
        mine = as_a_whole + np.diag([0.0] * 4 + [excess] * 3)
        # A tenth off the budget: the part that is left is held by less, and its own bound is larger.
        if drift_m(mine, np.percentile(places, (10, 90), axis=0)) <= 0.9 * budget_m:
            within.append(row)
    return within
