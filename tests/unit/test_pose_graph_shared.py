"""What overlaps err alike adds up along a chain, against many trials."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.growth.graph.map_graph import in_graph
from ingest.growth.graph.pose_graph import GraphSolution
from ingest.growth.values import Edge
from tests.support.pose_graphs import GraphNode, graph_edge, solved

MAPS, STEP_M = 12, 30.0
OWN = np.diag(np.array([1e-5, 5e-5, 5e-5, 5e-5, 0.005, 0.005, 0.005]) ** 2)
TURN_RAD = np.array([2e-5, 2e-5, 1e-4])
_TIGHT = np.diag(np.repeat([1e-8, 1e-5], [4, 3]) ** 2)


def shared(k: int) -> FloatArray:
    """(7, 3) turns about the middle of the k-th map."""
    middle = np.array([STEP_M * (k + 1), 0.0, 0.0])
    return np.vstack([np.zeros((1, 3)), np.eye(3), skew(middle)]) @ np.diag(TURN_RAD)


def chain(errors: FloatArray, said: bool, far_anchor: bool = False) -> GraphSolution:
    """Maps that walk east from an anchor; each overlap is off by (7,) errors."""
    names = ["A", *(f"m{k}" for k in range(MAPS)), *(["B"] if far_anchor else [])]
    nodes = [GraphNode(map_id=n, prior=_TIGHT if n in "AB" else None) for n in names]
    edges = []
    for k, (parent, child) in enumerate(itertools.pairwise(names)):
        common = shared(k)
        edges.append(
            graph_edge(
                child,
                parent,
                Sim3.exp(errors[k]),
                OWN + common @ common.T,
                shared=common if said else np.zeros((7, 3)),
            )
        )
    return solved(nodes, edges)


def drawn(rng: np.random.Generator, count: int = MAPS) -> FloatArray:
    """(n, 7) errors of the overlaps of one chain: each its own, and one turn that all of them have."""
    turn = rng.normal(size=3)
    return np.array([rng.multivariate_normal(np.zeros(7), OWN) + shared(k) @ turn for k in range(count)])


@pytest.mark.evaluation
def test_the_end_of_a_chain_is_off_as_far_as_is_said() -> None:
    """Mean squared normalised error of the last map's place: 3 in theory; twice that if nothing is shared."""
    rng = np.random.default_rng(0)
    jacobian = point_jacobian(np.array([STEP_M * MAPS, 0.0, 0.0]))
    lengths: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(12):
        errors = drawn(rng)
        for said, found in lengths.items():
            solution = chain(errors, said)
            off = jacobian @ solution.corrections[f"m{MAPS - 1}"].log()
            spread = jacobian @ solution.covariance_relative[f"m{MAPS - 1}"] @ jacobian.T
            found.append(float(off @ np.linalg.solve(spread, off)))
    assert 2.0 < np.mean(lengths[True]) < 4.5
    assert np.mean(lengths[False]) > 5.5


def test_nothing_is_added_to_one_overlap_and_nothing_to_those_that_share_nothing() -> None:
    none = np.zeros((MAPS, 7))
    for said in (True, False):
        first = chain(none, said).covariance_relative["m0"]
        np.testing.assert_allclose(first, OWN + shared(0) @ shared(0).T, rtol=1e-6, atol=1e-12)
    silent = chain(none, said=False)
    for k in range(MAPS):
        apart = sum((OWN + shared(j) @ shared(j).T for j in range(k + 1)), np.zeros((7, 7)))
        np.testing.assert_allclose(silent.covariance_relative[f"m{k}"], apart, rtol=1e-6, atol=1e-12)


def test_the_sum_of_a_chain_is_squared() -> None:
    """Azimuths of n overlaps that turn alike: n squared times one's, and n times what each has of its own."""
    found = chain(np.zeros((MAPS, 7)), said=True)
    for k in range(MAPS):
        n = k + 1
        variance = n * OWN[3, 3] + (n * TURN_RAD[2]) ** 2
        for claimed in (found.covariance_relative, found.covariance):
            assert 0.999 * variance < claimed[f"m{k}"][3, 3] < 1.1 * variance


def test_a_far_anchor_takes_it_away() -> None:
    errors = np.zeros((MAPS + 1, 7))
    jacobian = point_jacobian(np.array([STEP_M * MAPS, 0.0, 0.0]))
    spreads = [
        jacobian @ chain(errors, said=True, far_anchor=far).covariance_relative[f"m{MAPS - 1}"] @ jacobian.T
        for far in (False, True)
    ]
    assert np.sqrt(np.linalg.eigvalsh(spreads[1])[-1]) < 0.1 * np.sqrt(np.linalg.eigvalsh(spreads[0])[-1])


def test_it_is_stored_with_the_overlap_and_turns_with_its_frame() -> None:
    edge = Edge(
        map_id="m0",
        place="there",
        other_from_map=Sim3.identity(),
        covariance=OWN + shared(1) @ shared(1).T,
        shared_points=100,
        photos=3,
        shared=shared(1),
    )
    back = Edge.from_json(edge.as_json())
    np.testing.assert_allclose(back.shared, edge.shared)
    old = Edge.from_json({k: v for k, v in edge.as_json().items() if k != "shared"})
    np.testing.assert_array_equal(old.shared, np.zeros((7, 3)))
    here = LocalFrame(latitude_deg=48.0, longitude_deg=9.0, height_m=300.0)
    there = LocalFrame(latitude_deg=48.3, longitude_deg=9.5, height_m=100.0)
    own = replace(edge, covariance=edge.shared @ edge.shared.T)
    moved = in_graph(own, here, there)
    np.testing.assert_allclose(moved.shared @ moved.shared.T, moved.covariance, rtol=1e-6, atol=1e-9)
