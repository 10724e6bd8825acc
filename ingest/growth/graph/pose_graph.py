"""A pose graph over maps: where all of them lie best, given anchors and measured overlaps.

Nodes are corrections of the maps' present places, similarities in one local frame; edges are measured
similarities between maps that overlap; anchors are held by their own covariance. With x' = X_i x for the
points of map i and Z that carries what map i says to where map j says it, X_i = X_j Z in truth, so an edge's
residual is log(X_j^-1 X_i Z^-1).

Marginal covariances come from the normal matrix of the whole graph, not from sums along one path. An edge is
judged by how much of chi-square goes with it (the block form of Baarda's test).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import expm
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import Sim3
from ingest.growth.gates import SIGMAS
from ingest.growth.values import tied_together

_NAMED = 8  # overlaps that a message names
_CHANCE = float(chi2.sf(SIGMAS**2, 1))  # of a worse chi-square, below which something contradicts
# An edge is left out when it takes with it so many times more of chi-square than the next one; where several
# explain the contradiction alike, nobody can tell which is wrong.
_CLEAR_LEAD = 2.0
# Where no edge stands out, all covariances grow by chi-square over its degrees, up to this: deviations five
# times those claimed are no longer noise.
_MOST_VARIANCE_FACTOR = 25.0
# Standard deviations that nothing is known better than: log scale and radians, metres. They keep a covariance
# of zero, an anchor that is the truth by decree, invertible.
_FLOOR = np.diag(np.repeat([1e-9, 1e-6], [4, 3]) ** 2)
_ROUNDS, _HALVINGS, _SETTLED = 50, 8, 1e-6  # a step of so many sigmas is far below any
_FREE = 1e-6  # a direction of an edge whose redundancy is smaller is not checked by anything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphNode:
    """A map.

    Attributes:
        prior: (7, 7) covariance of its own placement, left perturbation in the graph's frame, where it is an
            anchor; None for a map that others placed.
        present_from_own: where an earlier graph has moved the anchor, from where its own placement has it.
    """

    map_id: str
    prior: FloatArray | None = None
    present_from_own: Sim3 = field(default_factory=Sim3.identity)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphEdge:
    """A measured overlap of two maps at their present places.

    Attributes:
        b_from_a: carries what map a says to where map b says it; graph's frame.
        covariance: (7, 7) of its left perturbation.
        shared: (7, 3) the part that all edges have in common, for one sigma of three errors.
    """

    a: str
    b: str
    b_from_a: Sim3
    covariance: FloatArray
    shared: FloatArray = field(default_factory=lambda: np.zeros((7, 3)))

    def __str__(self) -> str:
        return f"{self.a} - {self.b}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeFit:
    """How an edge agrees with the rest.

    Attributes:
        chi_square: by how much the graph's chi-square falls without the edge.
        redundancy: number of its seven directions that others check, 0 to 7.
    """

    edge: GraphEdge
    chi_square: float
    redundancy: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphSolution:
    """New places of all maps that hang on an anchor.

    Attributes:
        reason: None, NO_ANCHOR or CONTRADICTION; `message` says it for people.
        corrections: new_from_present of each map that a chain of edges ties to an anchor, graph's frame;
            empty where there is a reason.
        covariance: (7, 7) of each new place on Earth.
        covariance_relative: (7, 7) relative to the anchors, as if those were the truth; zero for anchors.
        chi_square, degrees: of the fit; covariances are widened by their ratio where that is needed.
        left_out: edges that contradict the rest.
    """

    reason: str | None
    message: str
    corrections: Mapping[str, Sim3] = field(default_factory=dict)
    covariance: Mapping[str, FloatArray] = field(default_factory=dict)
    covariance_relative: Mapping[str, FloatArray] = field(default_factory=dict)
    chi_square: float = 0.0
    degrees: int = 0
    left_out: tuple[GraphEdge, ...] = ()


class _Fit:
    """A graph solved by least squares, with what is needed to judge it; corrections are new_from_present."""

    def __init__(self, nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> None:
        self._nodes, self._rows = nodes, {node.map_id: i for i, node in enumerate(nodes)}
        self.edges = [e for e in edges if e.a in self._rows and e.b in self._rows]
        self._white = [_whitening(edge.covariance) for edge in self.edges]
        self._anchors = [i for i, node in enumerate(nodes) if node.prior is not None]
        places = self._solved()
        self._residuals, self._jacobian = self._linearised(places)
        self.corrections = dict(zip(self._rows, places, strict=True))
        self.chi_square = float(self._residuals @ self._residuals)
        self.degrees = len(self._residuals) - 7 * len(nodes)
        wanted = [(i, i) for i in range(len(nodes))]
        wanted += [(self._rows[e.a], self._rows[e.b]) for e in self.edges]
        self._blocks = _inverse_blocks(self._jacobian, wanted)

    def _solved(self) -> list[Sim3]:
        """Corrections by Gauss and Newton from the present places; a step that makes it worse is halved."""
        places = [Sim3.identity() for _ in self._nodes]
        for _ in range(_ROUNDS):
            residuals, jacobian = self._linearised(places)
            step = -_solver(jacobian)((jacobian.T @ residuals)[:, None])[:, 0]
            if np.linalg.norm(jacobian @ step) < _SETTLED:
                break
            for _ in range(_HALVINGS):
                parts = step.reshape(-1, 7)
                tried = [Sim3.exp(part) @ place for part, place in zip(parts, places, strict=True)]
                if np.linalg.norm(self._linearised(tried)[0]) < np.linalg.norm(residuals):
                    places = tried
                    break
                step = step / 2.0
            else:
                break
        return places

    def _linearised(self, places: Sequence[Sim3]) -> tuple[FloatArray, csr_array]:
        """Whitened residuals (7 m,) of edges and anchors' priors, derivatives by left perturbations."""
        residuals: list[FloatArray] = []
        blocks: list[tuple[int, int, FloatArray]] = []
        for k, (edge, white) in enumerate(zip(self.edges, self._white, strict=True)):
            a, b = self._rows[edge.a], self._rows[edge.b]
            b_inverse = places[b].inverse()
            miss = (b_inverse @ places[a] @ edge.b_from_a.inverse()).log()
            along = white @ np.linalg.solve(left_jacobian(miss), b_inverse.adjoint())
            residuals.append(white @ miss)
            blocks += [(k, a, along), (k, b, -along)]
        for k, i in enumerate(self._anchors, start=len(self.edges)):
            white = _whitening(self._nodes[i].prior)
            miss = (places[i] @ self._nodes[i].present_from_own).log()
            residuals.append(white @ miss)
            blocks.append((k, i, white @ np.linalg.inv(left_jacobian(miss))))
        return np.concatenate(residuals), _assemble(blocks, len(residuals), len(places))

    def edges_judged(self) -> tuple[EdgeFit, ...]:
        """What each edge takes of chi-square, and in how many directions others check it."""
        tests = [self._test(k, (self._rows[e.a], self._rows[e.b])) for k, e in enumerate(self.edges)]
        return tuple(
            EdgeFit(edge=edge, chi_square=chi, redundancy=rank)
            for edge, (chi, rank) in zip(self.edges, tests, strict=True)
        )

    def priors_judged(self) -> list[float]:
        """What each anchor's own placement takes of chi-square."""
        return [self._test(k, (i,))[0] for k, i in enumerate(self._anchors, start=len(self.edges))]

    def marginals(self) -> dict[str, FloatArray]:
        """Covariance (7, 7) of each map's correction, with what edges have in common."""
        common = self._in_common(self._jacobian)
        return {node.map_id: self._blocks[i, i] + common[i] for i, node in enumerate(self._nodes)}

    def relative_marginals(self) -> dict[str, FloatArray]:
        """The same if the anchors were where they are without error; zero for themselves."""
        free = [i for i, node in enumerate(self._nodes) if node.prior is None]
        found = {node.map_id: np.zeros((7, 7)) for node in self._nodes}
        if not free:
            return found
        columns = (7 * np.array(free)[:, None] + np.arange(7)).ravel()
        jacobian = self._jacobian[:, columns]
        blocks = _inverse_blocks(jacobian, [(k, k) for k in range(len(free))])
        common = self._in_common(jacobian)
        for k, i in enumerate(free):
            found[self._nodes[i].map_id] = blocks[k, k] + common[k]
        return found

    def _in_common(self, jacobian: csr_array) -> FloatArray:
        """(n, 7, 7) what comes on top where edges err together: along a chain their errors add up.

        The independent sum holds the same errors once each; what that has beyond is not taken away.
        """
        count = jacobian.shape[1] // 7
        together, apart = np.zeros((count, 7, 3)), np.zeros((count, 7, 7))
        errors_of = {k: self._white[k] @ e.shared for k, e in enumerate(self.edges)}
        shared = {k: errors for k, errors in errors_of.items() if errors.any()}
        if not shared:
            return apart
        solve = _solver(jacobian)
        by_row = csc_array(jacobian.T)
        for k, errors in shared.items():
            moved = solve(by_row[:, 7 * k : 7 * k + 7] @ errors).reshape(count, 7, 3)
            together += moved
            apart += moved @ np.swapaxes(moved, 1, 2)
        values, vectors = np.linalg.eigh(together @ np.swapaxes(together, 1, 2) - apart)
        return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2))

    def _test(self, k: int, nodes: tuple[int, ...]) -> tuple[float, int]:
        """The fall of chi-square without the k-th measurement of these nodes, and its redundancy."""
        rows = slice(7 * k, 7 * k + 7)
        columns = (7 * np.array(nodes)[:, None] + np.arange(7)).ravel()
        part = self._jacobian[rows][:, columns].toarray()
        blocks = self._blocks
        covariance = np.block(
            [[blocks[i, j] if (i, j) in blocks else blocks[j, i].T for j in nodes] for i in nodes]
        )
        spread = np.eye(7) - part @ covariance @ part.T
        values, vectors = np.linalg.eigh(0.5 * (spread + spread.T))
        free = values > _FREE
        along = vectors[:, free].T @ self._residuals[rows]
        return float((along**2 / values[free]).sum()), int(free.sum())


def solve_pose_graph(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> GraphSolution:
    """The most likely places of all maps; edges that contradict the rest are named and left out.

    Raises:
        InvalidValueError: map ids repeat, an edge names an unknown map, or its covariance is not finite.
    """
    ids = [node.map_id for node in nodes]
    if len(set(ids)) != len(ids):
        raise InvalidValueError(f"pose graph: map ids repeat: {ids}")
    if unknown := {m for e in edges for m in (e.a, e.b)} - set(ids):
        raise InvalidValueError(f"pose graph: edges name unknown maps {sorted(unknown)}")
    if broken := [str(e) for e in edges if not np.isfinite(e.covariance).all()]:
        raise InvalidValueError(f"pose graph: covariances that are not finite: {broken}")
    left_out: list[GraphEdge] = []
    remaining = list(edges)
    reached = _anchored(nodes, remaining)
    if not reached:
        return GraphSolution(reason="NO_ANCHOR", message="no map of the graph is an anchor")
    while True:
        fitted = _Fit([n for n in nodes if n.map_id in reached], remaining)
        fits = fitted.edges_judged()
        worst = _contradicting(fitted, fits)
        if worst is None or _anchored(nodes, [e for e in remaining if e is not worst]) != reached:
            break
        left_out.append(worst)
        remaining.remove(worst)
    return replace(_solution(fitted, fits), left_out=tuple(left_out))


def _solution(fitted: _Fit, fits: Sequence[EdgeFit]) -> GraphSolution:
    factor = 1.0
    if fitted.degrees > 0 and not _likely(fitted.chi_square, fitted.degrees):
        factor = max(1.0, fitted.chi_square / fitted.degrees)
    figures = f"chi-square {fitted.chi_square:.1f} with {fitted.degrees} degrees of freedom"
    found = GraphSolution(reason=None, message=figures, chi_square=fitted.chi_square, degrees=fitted.degrees)
    if factor > _MOST_VARIANCE_FACTOR:
        worst = sorted((f for f in fits if f.redundancy), key=lambda f: -f.chi_square)[:_NAMED]
        named = "; ".join(f"{f.edge} by {f.chi_square:.1f}" for f in worst)
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


def _contradicting(fitted: _Fit, fits: Sequence[EdgeFit]) -> GraphEdge | None:
    """The edge that alone explains why the graph does not fit, if there is one."""
    checked = sorted((f for f in fits if f.redundancy), key=lambda f: -f.chi_square)
    if fitted.degrees == 0 or _likely(fitted.chi_square, fitted.degrees) or not checked:
        return None
    worst = checked[0]
    if _likely(worst.chi_square, worst.redundancy):
        return None
    rivals = [*(f.chi_square for f in checked[1:]), *fitted.priors_judged()]
    # Of two measurements of one loop the same part of chi-square goes with either.
    alone = all(worst.chi_square > _CLEAR_LEAD * other for other in rivals)
    clean = _likely(fitted.chi_square - worst.chi_square, max(fitted.degrees - worst.redundancy, 1))
    others_clean = any(_likely(fitted.chi_square - other, max(fitted.degrees - 7, 1)) for other in rivals)
    return worst.edge if alone or (clean and not others_clean) else None


def _anchored(nodes: Sequence[GraphNode], edges: Sequence[GraphEdge]) -> set[str]:
    """Maps with a chain of edges to an anchor."""
    labels = tied_together([node.map_id for node in nodes], [(e.a, e.b) for e in edges])
    held = {label for node, label in zip(nodes, labels, strict=True) if node.prior is not None}
    return {node.map_id for node, label in zip(nodes, labels, strict=True) if label in held}


def _inverse_blocks(
    jacobian: csr_array, wanted: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], FloatArray]:
    """Blocks (7, 7) of the inverse normal matrix."""
    solve, size = _solver(jacobian), jacobian.shape[1]
    columns: dict[int, FloatArray] = {}
    blocks: dict[tuple[int, int], FloatArray] = {}
    for i, j in sorted(set(wanted), key=lambda pair: pair[1]):
        if j not in columns:
            columns.clear()
            unit = np.zeros((size, 7))
            unit[7 * j : 7 * j + 7] = np.eye(7)
            columns[j] = solve(unit)
        blocks[i, j] = columns[j][7 * i : 7 * i + 7]
        if i == j:
            blocks[i, j] = 0.5 * (blocks[i, j] + blocks[i, j].T)
    return blocks


def _solver(jacobian: csr_array) -> Callable[[FloatArray], FloatArray]:
    """What solves the normal equations for columns of right-hand sides."""
    normal = csc_array(jacobian.T @ jacobian)
    scale = 1.0 / np.sqrt(normal.diagonal())
    turned = coo_array(normal)
    turned.data = turned.data * scale[turned.row] * scale[turned.col]
    solver = splu(csc_array(turned))
    return lambda right: np.asarray(scale[:, None] * solver.solve(scale[:, None] * right))


def _assemble(blocks: Sequence[tuple[int, int, FloatArray]], rows: int, columns: int) -> csr_array:
    """A sparse matrix of (7, 7) blocks."""
    inner = np.arange(7)
    row = np.concatenate([np.repeat(7 * r + inner, 7) for r, _, _ in blocks])
    column = np.concatenate([np.tile(7 * c + inner, 7) for _, c, _ in blocks])
    value = np.concatenate([block.ravel() for _, _, block in blocks])
    return csr_array(coo_array((value, (row, column)), shape=(7 * rows, 7 * columns)))


def _whitening(covariance: FloatArray | None) -> FloatArray:
    """W (7, 7) with W C W^T = I."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + _FLOOR)), dtype=np.float64)


def small_adjoint(tangent: FloatArray) -> FloatArray:
    """(7, 7) matrix of the Lie bracket with (sigma, omega, nu), the derivative of Sim3.adjoint."""
    sigma, omega, nu = float(tangent[0]), tangent[1:4], tangent[4:]
    ad = np.zeros((7, 7))
    ad[1:4, 1:4] = skew(omega)
    ad[4:, 0] = -nu
    ad[4:, 1:4] = skew(nu)
    ad[4:, 4:] = sigma * np.eye(3) + skew(omega)
    return ad


def left_jacobian(tangent: FloatArray) -> FloatArray:
    """J (7, 7) with exp(x + dx) = exp(J dx) exp(x) to first order.

    The integral of exp(t ad) over t in [0, 1]: the corner of one matrix exponential (Van Loan 1978).
    """
    both = np.zeros((14, 14))
    both[:7, :7] = small_adjoint(tangent)
    both[:7, 7:] = np.eye(7)
    return np.asarray(expm(both)[:7, 7:], dtype=np.float64)
