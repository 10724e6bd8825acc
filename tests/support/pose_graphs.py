"""Graphs of maps, of which anchors have a placement of their own."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.growth.graph.pose_graph import WORLD, GraphEdge, GraphSolution, solve_pose_graph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphNode:
    """A map; an anchor has the covariance (7, 7) of its own placement, and may have been moved from it."""

    map_id: str
    prior: FloatArray | None = None
    present_from_own: Sim3 = field(default_factory=Sim3.identity)


def solved(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> GraphSolution:
    """The graph of these maps and overlaps."""
    placements = [
        GraphEdge(a=n.map_id, b=WORLD, b_from_a=n.present_from_own.inverse(), covariance=n.prior)
        for n in nodes
        if n.prior is not None
    ]
    return solve_pose_graph([node.map_id for node in nodes], [*edges, *placements])
