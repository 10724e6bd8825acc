"""How far a grown map may have drifted from its anchors, by the graph of all maps, and what is enough."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.graph.map_graph import PlacedMap, no_surer_than, solve_with_new
from ingest.growth.map_places import drift_m, growth_of, inflated, places_of, with_growth
from ingest.growth.values import LEAST_PHOTOS, GrownMap, Refused
from ingest.sfm.links import keep_photos

_TRIES = 3  # the part within the budget may lie otherwise, and be cut again


def grow_within_budget(
    model: Model,
    grow: Callable[[Model], GrownMap | Refused],
    maps: Mapping[str, PlacedMap],
    budget_m: float,
) -> GrownMap | Refused:
    """The map, by `grow`, of a reconstruction with its drift, or of the part that is within the budget."""
    part, everything = model, tuple(model.rows.tolist())
    beyond: dict[int, tuple[str, str]] = {}
    refused = Refused(reason="", message="")
    for _ in range(_TRIES):
        grown = grow(part)
        if isinstance(grown, Refused):
            return replace(grown, rows=everything)
        feature_map, drift, relative = with_drift(grown, maps, budget_m)
        gate = gates.drift(drift, budget_m)
        if gate.passes:
            return replace(grown, feature_map=feature_map, left_out={**beyond, **grown.left_out})
        asked = (*grown.placement.gates, gate)
        refused = Refused(reason=gate.reason, message=gate.message, rows=everything, gates=asked)
        rows = [int(r) for r in grown.model.rows]
        within = rows_within(feature_map, rows, relative, budget_m)
        left = keep_photos(part, within, least=LEAST_PHOTOS) if len(within) < len(rows) else None
        if left is None:
            break
        gone = set(part.rows.tolist()) - set(left.rows.tolist())
        beyond |= {r: grown.left_out.get(r, (gate.reason, gate.message)) for r in gone}
        part = left
    return refused


def with_drift(
    grown: GrownMap, maps: Mapping[str, PlacedMap], budget_m: float
) -> tuple[FeatureMap, float, FloatArray]:
    """The map with its overlaps by the graph of maps, its drift (m) and covariance (7, 7) to anchors."""
    feature_map = grown.feature_map
    growth = growth_of(feature_map.placement.evidence)
    shared = np.reshape(growth["shared_turn"], (7, 3))
    edges = no_surer_than(
        [
            replace(edge, place=maps[edge.map_id].place, shared=shared)
            for edge in grown.placement.edges
            if edge.map_id in maps
        ],
        grown.placement.covariance_relative,
    )
    covariance = feature_map.placement.covariance
    relative = np.reshape(growth["covariance_relative"], (7, 7))
    solution = solve_with_new(maps, feature_map.map_id, edges, feature_map.frame)
    if solution.reason is None and feature_map.map_id in solution.covariance:
        covariance = solution.covariance[feature_map.map_id]
        relative = solution.covariance_relative[feature_map.map_id]
    drift = drift_m(relative, places_of(feature_map))
    placed = with_growth(
        feature_map,
        drift_m=round(drift, 6),
        budget_m=budget_m,
        covariance_relative=relative.ravel().tolist(),
        edges=[edge.as_json() for edge in edges],
        gates={**growth["gates"], **gates.figures((gates.drift(drift, budget_m),))},
    )
    placed = replace(placed, placement=replace(placed.placement, covariance=covariance))
    return inflated(placed), drift, relative


def rows_within(
    feature_map: FeatureMap, rows: Sequence[int], relative: FloatArray, budget_m: float
) -> list[int]:
    """Rows of the photos that are within the budget, each with its own bending in place of the largest.

    Args:
        rows: of the map's images, in their order.
        relative: (7, 7) covariance of the map relative to the anchors, with its bending.
    """
    bending_m2 = float(growth_of(feature_map.placement.evidence)["bending_m"]) ** 2
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
            jacobian = point_jacobian(pose.center)
            spread = pose.rotation.T @ image.covariance[3:, 3:] @ pose.rotation
            most = np.linalg.eigvalsh(spread - jacobian @ as_a_whole @ jacobian.T)[-1]
            excess = float(np.clip(most, 0.0, bending_m2))
        mine = as_a_whole + np.diag([0.0] * 4 + [excess] * 3)
        # A tenth off the budget: the part that is left is held by less, and its own bound is larger.
        if drift_m(mine, np.percentile(places, (10, 90), axis=0)) <= 0.9 * budget_m:
            within.append(row)
    return within
