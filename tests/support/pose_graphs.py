"""Graphs of maps, of which anchors have a placement of their own."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.growth.graph.pose_graph import WORLD, GraphEdge, GraphSolution, solve_pose_graph
from ingest.growth.values import Edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphNode:
    """A map; an anchor has the covariance (7, 7) of its own placement, and may have been moved from it."""

    map_id: str
    prior: FloatArray | None = None
    present_from_own: Sim3 = field(default_factory=Sim3.identity)


def graph_edge(a: str, b: str, b_from_a: Sim3, covariance: FloatArray, **more: FloatArray) -> GraphEdge:
    """The overlap of map a with map b, as a graph has it."""
    return a, Edge(map_id=b, other_from_map=b_from_a, covariance=covariance, **more)


def solved(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> GraphSolution:
    """The graph of these maps and overlaps."""
    placements = [
        graph_edge(n.map_id, WORLD, n.present_from_own.inverse(), n.prior)
        for n in nodes
        if n.prior is not None
    ]
    return solve_pose_graph([node.map_id for node in nodes], [*edges, *placements])
