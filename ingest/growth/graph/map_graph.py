"""The maps of a snapshot as a pose graph: who placed whom, how well, and how far that may have drifted."""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.store import MapSummary, Snapshot
from featuredb.store.changes import is_imported
from featuredb.store.decode import frame_of, placement_of
from featuredb.store.encode import Row
from featuredb.store.tables import BOUNDS
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.graph.pose_graph import WORLD, GraphSolution, solve_pose_graph
from ingest.growth.map_places import drift_m, growth_of, inflated, with_growth, with_overlaps
from ingest.growth.place.component import GrownMap, grow_component
from ingest.growth.values import LEAST_PHOTOS, Edge, GrowthPhotos, LocalisedPhoto, Refused, tied_together
from ingest.map_builder import MapIdentity
from ingest.sfm.links import keep_photos
from reloc.localise.candidates import IndexedArea

_LOG = logging.getLogger(__name__)

_TRIES = 3  # the part within the budget may lie otherwise, and be cut again
OWN = "own_placement"  # key of an anchor's evidence of growth, once a graph has moved it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedMap:
    """A map with its place, as its row has it, without its points.

    Attributes:
        place: digest of where it lies.
        corners: (8, 3) of its points' box in its own frame, metres; empty for a map without points.
        edges: overlaps that were measured when it was placed.
    """

    summary: MapSummary
    frame: LocalFrame
    placement: Placement
    place: str
    corners: FloatArray
    edges: tuple[Edge, ...]

    @property
    def is_anchor(self) -> bool:
        return not self.summary.parents

    @property
    def own_place(self) -> Edge:
        """An anchor's own placement, before others moved it, as an overlap with the world; its frame."""
        own = growth_of(self.placement.evidence).get(OWN)
        covariance, moved = self.placement.covariance, Sim3.identity()
        if own is not None:
            covariance, moved = np.reshape(own["covariance"], (7, 7)), Sim3.exp(own["present_from_own"])
        return Edge(map_id=WORLD, other_from_map=moved.inverse(), covariance=covariance)


def placed_maps(snapshot: Snapshot) -> dict[str, PlacedMap]:
    """Maps with a place, by id, but retired ones and imports that nobody vouches for: edges may be forged."""
    placed = {m.map_id: m for m in snapshot.maps() if not is_imported(m.status, m.status_reason)}
    return {m: _placed(placed[m], row) for row in snapshot.rows() if (m := row["map_id"]) in placed}


def _placed(summary: MapSummary, row: Row) -> PlacedMap:
    frame, placement = frame_of(row), placement_of(row)
    corners = np.zeros((0, 3))
    if row[BOUNDS[0]] is not None:
        low_and_high = np.reshape([row[name] for name in BOUNDS], (2, 3))
        corners = frame.enu_from_utm(list(product(*low_and_high.T)), row["epsg"])
    return PlacedMap(
        summary=summary,
        frame=frame,
        placement=placement,
        place=place_key(frame, placement),
        corners=corners,
        edges=tuple(Edge.from_json(edge) for edge in growth_of(placement.evidence).get("edges", ())),
    )


def place_key(frame: LocalFrame, placement: Placement) -> str:
    """A digest of where a map lies, and how surely: 16 hex digits, others once the map is placed anew."""
    at = placement.local_from_sfm
    numbers = [frame.latitude_deg, frame.longitude_deg, frame.height_m, at.scale, *at.rotation.ravel()]
    numbers += [*at.translation, *placement.covariance.ravel()]
    return hashlib.sha256(np.array(numbers, dtype="<f8").tobytes()).hexdigest()[:16]


def holds(maps: Mapping[str, PlacedMap], edge: Edge) -> bool:
    """Whether the other map is where it was when the overlap was measured; else it is measured again."""
    return edge.map_id in maps and maps[edge.map_id].place == edge.place


def solve_maps(
    maps: Mapping[str, PlacedMap], new: Mapping[str, Sequence[Edge]], frame: LocalFrame
) -> GraphSolution:
    """The graph of the maps that overlaps connect with those of `new`, overlaps that hold and new ones.

    Args:
        new: overlaps by the map that has them; one that is not placed yet lies in `frame`, the graph's.
    """
    overlaps = [(m, e) for m, placed in maps.items() for e in placed.edges if holds(maps, e)]
    overlaps += [(m, e) for m, own in new.items() for e in own if e.map_id in maps]
    names = [*maps, *(m for m in new if m not in maps)]
    groups = tied_together(names, [(m, e.map_id) for m, e in overlaps])
    group_of = dict(zip(names, groups, strict=True))
    wanted = {group_of[m] for m in new}
    members = sorted(m for m in names if group_of[m] in wanted)
    overlaps += [(m, maps[m].own_place) for m in members if m in maps and maps[m].is_anchor]
    frames = {m: maps[m].frame if m in maps else frame for m in members}
    return solve_pose_graph(members, [(m, in_graph(e, frames[m], frame)) for m, e in overlaps if m in frames])


def in_graph(edge: Edge, own: LocalFrame, frame: LocalFrame) -> Edge:
    """A stored edge in the frame of a graph."""
    frame_from_own = Sim3.from_rigid3(frame.enu_from(own))
    return edge.carried(frame_from_own, frame_from_own)


def no_surer_than(edges: Sequence[Edge], together: FloatArray) -> list[Edge]:
    """Edges of one map to several, all made of the same photos, so that they do not count these twice.

    Taken as independent, they would place the map more surely than one fit to all of them, `together` (7, 7),
    did. Each of n gets n times what is missing, so that they have it together.
    """
    if not edges:
        return []
    apart = np.linalg.inv(sum(np.linalg.inv(edge.covariance) for edge in edges))
    half = np.linalg.cholesky(apart)  # axes in which what they say together is a unit ball: units mix
    white = np.linalg.solve(half, np.linalg.solve(half, together - apart).T)
    values, vectors = np.linalg.eigh(0.5 * (white + white.T))
    missing = half @ (vectors * np.maximum(values, 0.0)) @ vectors.T @ half.T
    more = len(edges) * 0.5 * (missing + missing.T)
    return [replace(edge, covariance=edge.covariance + more) for edge in edges]


def grow_within_budget(
    model: Model,
    new: GrowthPhotos,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    maps: Mapping[str, PlacedMap],
    budget_m: float,
    identity: MapIdentity | None = None,
) -> GrownMap | Refused:
    """`grow_component` of a reconstruction, or of the part of it that is within the budget; with its drift.

    What no step foresaw is a refusal, too (FAILED): it costs this reconstruction and not the others.
    """
    part = model
    beyond: dict[int, tuple[str, str]] = {}
    for _ in range(_TRIES):
        try:
            grown = grow_component(part, new, localised, areas, identity, budget_m)
        except (ArithmeticError, LookupError, RuntimeError, ValueError) as error:
            _LOG.exception("a reconstruction of %d photos", len(model.rows))
            text = f"{type(error).__name__}: {error}; the log tells where. Please report it"
            return Refused(reason="FAILED", message=text)
        if isinstance(grown, Refused):
            return grown
        feature_map, drift, relative = with_drift(grown, maps, budget_m)
        gate = gates.drift(drift, budget_m)
        if gate.passes:
            return replace(grown, feature_map=feature_map, left_out={**beyond, **grown.left_out})
        refused = Refused.by(gate, *grown.placement.gates)
        rows = grown.model.rows.tolist()
        within = rows_within(grown, feature_map, relative, budget_m)
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
    feature_map, me = grown.feature_map, grown.feature_map.map_id
    held = [replace(e, place=maps[e.map_id].place) for e in grown.placement.edges if e.map_id in maps]
    edges = no_surer_than(held, grown.placement.covariance)
    others = {m: placed for m, placed in maps.items() if m != me}
    solution = solve_maps(others, {me: edges}, feature_map.frame)
    covariance = solution.covariance.get(me, feature_map.placement.covariance)
    relative = solution.covariance_relative.get(me, grown.covariance_relative)
    placed = replace(feature_map, placement=replace(feature_map.placement, covariance=covariance))
    noted, drift = with_overlaps(placed, relative, edges, budget_m)
    told = gates.figures([*grown.placement.gates, gates.drift(drift, budget_m)])
    return inflated(with_growth(noted, gates=told)), drift, relative


def rows_within(grown: GrownMap, feature_map: FeatureMap, relative: FloatArray, budget_m: float) -> list[int]:
    """Rows of the photos that are within the budget, each with its own bending in place of the largest.

    Args:
        feature_map: of `grown`, as the graph of maps has it.
        relative: (7, 7) covariance of the map relative to the anchors, with its bending.
    """
    bending_m2 = grown.bending_m**2
    as_a_whole = relative - np.diag([0.0] * 4 + [bending_m2] * 3)
    lacks_m2 = np.nan_to_num(grown.spread.lacks_m2(as_a_whole), nan=bending_m2)
    points = feature_map.points_local()
    seen = feature_map.observations
    within = []
    for row, image, own_m2 in zip(grown.model.rows.tolist(), feature_map.images, lacks_m2, strict=True):
        own = points[seen.point_index[seen.image_id == image.image_id]]
        mine = as_a_whole + np.diag([0.0] * 4 + [min(own_m2, bending_m2)] * 3)
        places = np.vstack([image.cam_from_local.center, *([np.median(own, axis=0)] if len(own) else [])])
        # A tenth off the budget: the part that is left is held by less, and its own bound is larger.
        if drift_m(mine, places) <= 0.9 * budget_m:
            within.append(row)
    return within
