"""A pose graph over maps: where all of them lie best, given anchors and measured overlaps.

Nodes are corrections of the maps' present places, similarities in one local frame; edges are measured
similarities between maps that overlap; anchors are held by their own covariance. With x' = X_i x for the
points of map i and Z that carries what map i says to where map j says it, X_i = X_j Z in truth, so an edge's
residual is log(X_j^-1 X_i Z^-1).

Marginal covariances come from the normal matrix of the whole graph, not from sums along one path. An edge is
judged by how much of chi-square goes with it (the block form of Baarda's test).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2, norm

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.growth.gates import SIGMAS
from ingest.growth.graph.pose_graph_fit import GraphEdge, GraphNode, PoseGraphFit
from ingest.growth.values import tied_together

_NAMED = 8  # overlaps that a message names
_CHANCE = float(chi2.sf(SIGMAS**2, 1))  # of a worse chi-square, below which something contradicts
# An edge is left out when it takes with it so many times more of chi-square than the next one; where several
# explain the contradiction alike, nobody can tell which is wrong.
_CLEAR_LEAD = 2.0
# Where no edge stands out, all covariances grow by chi-square over its degrees, up to this: deviations five
# times those claimed are no longer noise.
_MOST_VARIANCE_FACTOR = 25.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeFit:
    """How an edge agrees with the rest.

    Attributes:
        chi_square: by how much the graph's chi-square falls without the edge.
        redundancy: number of its seven directions that others check, 0 to 7.
        sigmas: of a normal error that is as unlikely; NaN where nothing checks it.
        left_out: whether it contradicts the rest, and was left out.
    """

    edge: GraphEdge
    chi_square: float
    redundancy: int
    sigmas: float
    left_out: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphSolution:
    """New places of all maps that hang on an anchor.

    Attributes:
        reason: None, NO_ANCHOR or CONTRADICTION; `message` says it for people.
        corrections: new_from_present of each map that a chain of edges ties to an anchor, graph's frame;
            empty where there is a reason.
        covariance: (7, 7) of each new place on Earth.
        covariance_relative: (7, 7) relative to the anchors, as if those were the truth; zero for anchors.
        chi_square, degrees: of the fit; `variance_factor` is their ratio where it was needed, else 1.
        edges: all of them, those left out too.
    """

    reason: str | None
    message: str
    corrections: Mapping[str, Sim3] = field(default_factory=dict)
    covariance: Mapping[str, FloatArray] = field(default_factory=dict)
    covariance_relative: Mapping[str, FloatArray] = field(default_factory=dict)
    chi_square: float = 0.0
    degrees: int = 0
    variance_factor: float = 1.0
    edges: tuple[EdgeFit, ...] = ()

    @property
    def left_out(self) -> tuple[EdgeFit, ...]:
        return tuple(fit for fit in self.edges if fit.left_out)


def solve_pose_graph(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> GraphSolution:
    """The most likely places of all maps; edges that contradict the rest are named and left out.

    Raises:
        InvalidValueError: map ids repeat, or an edge names an unknown map.
    """
    _check(nodes, edges)
    left_out: list[EdgeFit] = []
    remaining = list(edges)
    anchored_first = _anchored(nodes, remaining)
    while True:
        reached = _anchored(nodes, remaining)
        if not reached:
            return GraphSolution(reason="NO_ANCHOR", message="no map of the graph is an anchor")
        fitted = PoseGraphFit([n for n in nodes if n.map_id in reached], remaining)
        fits = tuple(
            EdgeFit(edge=edge, chi_square=chi, redundancy=rank, sigmas=equivalent_sigmas(chi, rank))
            for edge, (chi, rank) in zip(fitted.edges, fitted.edges_judged(), strict=True)
        )
        worst = _contradicting(fitted, fits)
        if worst is None or _anchored(nodes, [e for e in remaining if e is not worst.edge]) != anchored_first:
            break
        left_out.append(replace(worst, left_out=True))
        remaining.remove(worst.edge)
    return _solution(fitted, (*fits, *left_out))


def _solution(fitted: PoseGraphFit, fits: tuple[EdgeFit, ...]) -> GraphSolution:
    factor = 1.0
    if fitted.degrees > 0 and not _likely(fitted.chi_square, fitted.degrees):
        factor = max(1.0, fitted.chi_square / fitted.degrees)
    figures = f"chi-square {fitted.chi_square:.1f} with {fitted.degrees} degrees of freedom"
    found = GraphSolution(
        reason=None,
        message=figures,
        chi_square=fitted.chi_square,
        degrees=fitted.degrees,
        variance_factor=factor,
        edges=fits,
    )
    if factor > _MOST_VARIANCE_FACTOR:
        worst = sorted((f for f in fits if np.isfinite(f.sigmas)), key=lambda f: -f.chi_square)[:_NAMED]
        named = "; ".join(f"{f.edge} by {f.sigmas:.1f} sigma" for f in worst)
        text = f"the overlaps contradict each other and no single one stands out ({figures}): {named}"
        return replace(found, reason="CONTRADICTION", message=text)
    return replace(
        found,
        corrections=fitted.corrections,
        covariance={m: factor * c for m, c in fitted.marginals().items()},
        covariance_relative={m: factor * c for m, c in fitted.relative_marginals().items()},
    )


def _likely(chi_square: float, degrees: int) -> bool:
    return bool(chi2.sf(chi_square, degrees) >= _CHANCE)


def _contradicting(fitted: PoseGraphFit, fits: Sequence[EdgeFit]) -> EdgeFit | None:
    """The edge that alone explains why the graph does not fit, if there is one."""
    checked = sorted((f for f in fits if f.redundancy), key=lambda f: -f.chi_square)
    if fitted.degrees == 0 or _likely(fitted.chi_square, fitted.degrees) or not checked:
        return None
    worst = checked[0]
    if _likely(worst.chi_square, worst.redundancy):
        return None
    rivals = [f.chi_square for f in checked[1:]] + [t for t, _ in fitted.priors_judged()]
    # Of two measurements of one loop the same part of chi-square goes with either.
    alone = all(worst.chi_square > _CLEAR_LEAD * other for other in rivals)
    clean = _likely(fitted.chi_square - worst.chi_square, max(fitted.degrees - worst.redundancy, 1))
    others_clean = any(_likely(fitted.chi_square - other, max(fitted.degrees - 7, 1)) for other in rivals)
    return worst if alone or (clean and not others_clean) else None


def _check(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> None:
    ids = [node.map_id for node in nodes]
    if len(set(ids)) != len(ids):
        raise InvalidValueError(f"pose graph: map ids repeat: {ids}")
    unknown = {m for e in edges for m in (e.a, e.b)} - set(ids)
    if unknown:
        raise InvalidValueError(f"pose graph: edges name unknown maps {sorted(unknown)}")


def _anchored(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> set[str]:
    """Maps with a chain of edges to an anchor."""
    labels = tied_together([node.map_id for node in nodes], [(e.a, e.b) for e in edges])
    held = {label for node, label in zip(nodes, labels, strict=True) if node.prior is not None}
    return {node.map_id for node, label in zip(nodes, labels, strict=True) if label in held}


def equivalent_sigmas(chi_square: float, degrees: int) -> float:
    """The normal error, in standard deviations, that is as unlikely as a chi-square; NaN without degrees."""
    if degrees == 0:
        return float("nan")
    log_p = float(chi2.logsf(chi_square, degrees))
    # Beyond what float64 holds the tail is that of a normal error to within a few per cent.
    return float(norm.isf(0.5 * np.exp(log_p))) if log_p > -700.0 else float(np.sqrt(chi_square))
