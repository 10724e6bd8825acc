"""The least squares behind a pose graph over maps: solution, marginal covariances, tests of measurements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import splu

from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import Sim3

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
        shared: (7, 3) the part of it that all edges have in common: what they are off for one sigma of three
            errors that no edge has alone.
    """

    a: str
    b: str
    b_from_a: Sim3
    covariance: FloatArray
    shared: FloatArray = field(default_factory=lambda: np.zeros((7, 3)))

    def __post_init__(self) -> None:
        object.__setattr__(self, "shared", frozen_array("GraphEdge.shared", self.shared, (7, 3)))
        object.__setattr__(self, "covariance", frozen_array("GraphEdge.covariance", self.covariance, (7, 7)))

    def __str__(self) -> str:
        return f"{self.a} - {self.b}"


class PoseGraphFit:
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

    def edges_judged(self) -> list[tuple[float, int]]:
        """What each edge takes of chi-square, and in how many directions others check it."""
        return [self._test(k, (self._rows[e.a], self._rows[e.b])) for k, e in enumerate(self.edges)]

    def priors_judged(self) -> list[tuple[float, int]]:
        """The same of each anchor's own placement."""
        return [self._test(k, (i,)) for k, i in enumerate(self._anchors, start=len(self.edges))]

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
