"""A pose graph over maps: where all of them lie best, given anchors and measured overlaps.

Nodes are corrections of the maps' present places, similarities in one local frame; edges are measured
similarities between maps that overlap; anchors are held by their own covariance. With x' = X_i x for the
points of map i and Z that carries what map i says to where map j says it, X_i = X_j Z in truth, so an edge's
residual is log(X_j^-1 X_i Z^-1).

An edge is judged by how much of chi-square goes with it (the block form of Baarda's test).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import bsr_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, left_jacobian
from ingest.growth.gates import SIGMAS
from ingest.growth.values import Edge, tied_together

WORLD = ""  # what anchors are measured against, and stays
_CHANCE = float(chi2.sf(SIGMAS**2, 1))  # of a worse chi-square, below which something contradicts
# An edge is left out when it takes with it so many times more of chi-square than the next one; where several
# explain the contradiction alike, nobody can tell which is wrong. Of 300 random graphs with one or two gross
# errors a right edge was left out in 70 at 1, in none at 1.5 and more; a wrong one in 120 at 2.
_CLEAR_LEAD = 2.0
# Where no edge stands out, all covariances grow by chi-square over its degrees, up to this: deviations five
# times those claimed are no longer noise.
_MOST_VARIANCE_FACTOR = 25.0
# Standard deviations that nothing is known better than: log scale and radians, metres. They keep a covariance
# of zero, an anchor that is the truth by decree, invertible.
_FLOOR = np.diag(np.repeat([1e-9, 1e-6], [4, 3]) ** 2)
_ROUNDS, _HALVINGS = 50, 8  # of Gauss and Newton, and of a step
# Sigmas of a step after which it has settled, and redundancy below which nothing checks a direction.
_NOTHING = 1e-6


GraphEdge = tuple[str, Edge]
"""A map and its overlap with another one, or with `WORLD`: its own placement; all in the graph's frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphSolution:
    """New places of all maps that hang on an anchor; none where there is a reason.

    Attributes:
        reason: None, NO_ANCHOR or CONTRADICTION; `message` says it for people.
        corrections: new_from_present of each map that a chain of edges ties to an anchor, graph's frame.
        covariance: (7, 7) of each new place on Earth.
        covariance_relative: (7, 7) relative to the anchors, as if those were the truth; zero for anchors.
        left_out: the two maps of each edge that contradicts the rest.
    """

    reason: str | None
    message: str
    corrections: Mapping[str, Sim3] = field(default_factory=dict)
    covariance: Mapping[str, FloatArray] = field(default_factory=dict)
    covariance_relative: Mapping[str, FloatArray] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()


class _Fit:
    """A graph solved by least squares, with what is needed to judge it; corrections are new_from_present."""

    def __init__(self, ids: Sequence[str], edges: Sequence[GraphEdge]) -> None:
        self._ids, rows = ids, {map_id: i for i, map_id in enumerate(ids)}
        self.edges = [of for of in edges if of[0] in rows]
        self._ends = [(rows[m], rows.get(edge.map_id)) for m, edge in self.edges]
        self._anchors = {m for m, edge in self.edges if edge.map_id == WORLD}
        # W with W C W^T = I.
        self._white = [np.linalg.inv(np.linalg.cholesky(e.covariance + _FLOOR)) for _, e in self.edges]
        places = self._solved()
        self._residuals, self._jacobian = self._linearised(places)
        self.corrections = dict(zip(rows, places, strict=True))
        self.chi_square = float(self._residuals @ self._residuals)
        self.degrees = len(self._residuals) - 7 * len(ids)

    def _solved(self) -> list[Sim3]:
        """Corrections by Gauss and Newton from the present places; a step that makes it worse is halved."""
        places = [Sim3.identity() for _ in self._ids]
        for _ in range(_ROUNDS):
            residuals, jacobian = self._linearised(places)
            step = -_solver(jacobian)((jacobian.T @ residuals)[:, None])[:, 0]
            if np.linalg.norm(jacobian @ step) < _NOTHING:
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
        """Whitened residuals (7 m,) of the edges, derivatives by left perturbations.

        Those at a residual of nothing lead nowhere where an overlap is turned by a right angle: the fit stops
        short, and of two overlaps that hold a map alike the right one was left out.
        """
        residuals, blocks, columns, starts = [], [], [], [0]
        for (_, edge), (a, b), white in zip(self.edges, self._ends, self._white, strict=True):
            b_inverse = Sim3.identity() if b is None else places[b].inverse()
            miss = (b_inverse @ places[a] @ edge.other_from_map.inverse()).log()
            along = white @ np.linalg.solve(left_jacobian(miss), b_inverse.adjoint())
            residuals.append(white @ miss)
            blocks += [along] if b is None else [along, -along]
            columns += [a] if b is None else [a, b]
            starts.append(len(columns))
        shape = (7 * len(self.edges), 7 * len(places))
        jacobian = bsr_array((np.array(blocks), columns, starts), shape=shape)
        return np.concatenate(residuals), csr_array(jacobian)

    def judged(self) -> list[tuple[float, int]]:
        """Of each edge the fall of chi-square without it, and how many of its directions others check."""
        solve, found = _solver(self._jacobian), []
        for k in range(len(self.edges)):
            rows = self._jacobian[7 * k : 7 * k + 7]
            spread = np.eye(7) - rows @ solve(rows.T.toarray())
            values, vectors = np.linalg.eigh(0.5 * (spread + spread.T))
            free = values > _NOTHING
            along = vectors[:, free].T @ self._residuals[7 * k : 7 * k + 7]
            found.append((float((along**2 / values[free]).sum()), int(free.sum())))
        return found

    def marginals(self, *, relative: bool) -> dict[str, FloatArray]:
        """Covariance (7, 7) of each map's correction; `relative`: as if the anchors had no error."""
        free = [i for i, map_id in enumerate(self._ids) if map_id not in self._anchors or not relative]
        found = {map_id: np.zeros((7, 7)) for map_id in self._ids}
        if free:
            columns = (7 * np.array(free)[:, None] + np.arange(7)).ravel()
            for i, covariance in zip(free, self._covariances(self._jacobian[:, columns]), strict=True):
                found[self._ids[i]] = covariance
        return found

    def _covariances(self, jacobian: csr_array) -> FloatArray:
        """(n, 7, 7) of the maps of the columns: the inverse normal matrix, and what edges have in common.

        Along a chain errors that edges share add up. The independent sum holds the same errors once each;
        what that has beyond is not taken away.
        """
        solve, size = _solver(jacobian), jacobian.shape[1]
        units = (np.eye(size, 7, -first) for first in range(0, size, 7))
        own = np.array([solve(unit)[7 * i : 7 * i + 7] for i, unit in enumerate(units)])
        together, apart = np.zeros((size // 7, 7, 3)), np.zeros((size // 7, 7, 7))
        for k, ((_, edge), white) in enumerate(zip(self.edges, self._white, strict=True)):
            if edge.shared.any():
                rows = jacobian[7 * k : 7 * k + 7]
                moved = solve(rows.T @ (white @ edge.shared)).reshape(-1, 7, 3)
                together += moved
                apart += moved @ np.swapaxes(moved, 1, 2)
        values, vectors = np.linalg.eigh(together @ np.swapaxes(together, 1, 2) - apart)
        common = (vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        return np.asarray(0.5 * (own + np.swapaxes(own, 1, 2)) + common)


def solve_pose_graph(ids: Sequence[str], edges: Sequence[GraphEdge]) -> GraphSolution:
    """The most likely places of all maps; edges that contradict the rest are named and left out.

    Args:
        ids: of the maps. edges: overlaps between them, and the anchors' own placements.

    Raises:
        InvalidValueError: the covariance of an edge is not finite.
    """
    if broken := [f"{m} - {e.map_id}" for m, e in edges if not np.isfinite(e.covariance).all()]:
        raise InvalidValueError(f"pose graph: covariances that are not finite: {broken}")
    left_out: list[tuple[str, str]] = []
    remaining, reached = list(edges), _anchored(ids, edges)
    if not reached:
        return GraphSolution(reason="NO_ANCHOR", message="no map of the graph is an anchor")
    while True:
        fitted = _Fit(reached, remaining)
        judged = fitted.judged()
        worst = _contradicting(fitted, judged)
        if worst is None or _anchored(ids, [e for e in remaining if e is not worst]) != reached:
            break
        left_out.append((worst[0], worst[1].map_id))
        remaining.remove(worst)
    factor = 1.0
    if fitted.degrees > 0 and not _likely(fitted.chi_square, fitted.degrees):
        factor = max(1.0, fitted.chi_square / fitted.degrees)
    figures = f"chi-square {fitted.chi_square:.1f} with {fitted.degrees} degrees of freedom"
    found = GraphSolution(reason=None, message=figures, left_out=tuple(left_out))
    if factor > _MOST_VARIANCE_FACTOR:
        blamed = [
            (chi, f"{m} - {edge.map_id}")
            for (m, edge), (chi, free) in zip(fitted.edges, judged, strict=True)
            if edge.map_id != WORLD and free
        ]
        named = "; ".join(f"{pair} by {chi:.1f}" for chi, pair in sorted(blamed, reverse=True))
        text = f"the overlaps contradict each other and no single one stands out ({figures}): {named}"
        return replace(found, reason="CONTRADICTION", message=text)
    return replace(
        found,
        corrections=fitted.corrections,
        covariance={m: factor * c for m, c in fitted.marginals(relative=False).items()},
        covariance_relative={m: factor * c for m, c in fitted.marginals(relative=True).items()},
    )


def _likely(chi_square: float, degrees: int) -> bool:
    return bool(chi2.sf(chi_square, degrees) >= _CHANCE)


def _contradicting(fitted: _Fit, judged: Sequence[tuple[float, int]]) -> GraphEdge | None:
    """The edge that alone explains why the graph does not fit, if there is one."""
    chi_square, degrees = fitted.chi_square, fitted.degrees
    overlaps = [k for k, (_, edge) in enumerate(fitted.edges) if edge.map_id != WORLD]
    if degrees == 0 or not overlaps or _likely(chi_square, degrees):
        return None
    row = max(overlaps, key=lambda k: judged[k][0])
    worst, redundancy = judged[row]
    if redundancy == 0 or _likely(worst, redundancy):
        return None
    rivals = [chi for k, (chi, _) in enumerate(judged) if k != row]
    # Of two measurements of one loop the same part of chi-square goes with either.
    alone = all(worst > _CLEAR_LEAD * other for other in rivals)
    clean = _likely(chi_square - worst, max(degrees - redundancy, 1))
    others_clean = any(_likely(chi_square - other, max(degrees - 7, 1)) for other in rivals)
    return fitted.edges[row] if alone or (clean and not others_clean) else None


def _anchored(ids: Sequence[str], edges: Sequence[GraphEdge]) -> list[str]:
    """Maps with a chain of edges to an anchor's placement."""
    world, *labels = tied_together([WORLD, *ids], [(m, edge.map_id) for m, edge in edges])
    return [map_id for map_id, label in zip(ids, labels, strict=True) if label == world]


def _solver(jacobian: csr_array) -> Callable[[FloatArray], FloatArray]:
    """What solves the normal equations for columns of right-hand sides."""
    normal = jacobian.T @ jacobian
    scale = diags_array(1.0 / np.sqrt(normal.diagonal()))
    solver = splu(csc_array(scale @ normal @ scale))
    return lambda right: np.asarray(scale @ solver.solve(scale @ right))
