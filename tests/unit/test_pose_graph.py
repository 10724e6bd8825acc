"""Pose graphs over maps against closed forms."""

import itertools
from typing import Any

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, left_jacobian
from ingest.growth.graph import pose_graph
from ingest.growth.graph.pose_graph import GraphEdge
from tests.support.pose_graphs import GraphNode, graph_edge, solved

_SIGMA = np.array([1e-4, 2e-4, 2e-4, 3e-4, 0.03, 0.02, 0.04])
_EDGE = np.diag(_SIGMA**2)
_TIGHT = np.diag(np.repeat([1e-8, 1e-5], [4, 3]) ** 2)


def _edge(a: str, b: str, shift: tuple[float, ...] = (0.0,) * 7, covariance: FloatArray = _EDGE) -> GraphEdge:
    return graph_edge(a, b, Sim3.exp(shift), covariance)


def _east(metres: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.0, 0.0, metres, 0.0, 0.0)


@pytest.mark.parametrize("scale", [0.0, 0.2, 1.0])
def test_left_jacobian_against_differences(scale: float) -> None:
    tangent = scale * np.array([0.3, 0.5, -0.2, 0.7, 1.0, 2.0, -3.0])
    base = Sim3.exp(tangent).inverse()
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-6
        forward = (Sim3.exp(tangent + step) @ base).log()
        back = (Sim3.exp(tangent - step) @ base).log()
        np.testing.assert_allclose((forward - back) / 2e-6, left_jacobian(tangent)[:, k], atol=1e-7)


def test_a_chain_of_n_edges_has_n_times_the_covariance() -> None:
    nodes = [GraphNode(map_id="A", prior=_TIGHT), *(GraphNode(map_id=f"m{k}") for k in range(5))]
    edges = [_edge(f"m{k}", "A" if k == 0 else f"m{k - 1}") for k in range(5)]
    found = solved(nodes, edges)
    assert found.reason is None
    for k in range(5):
        np.testing.assert_allclose(found.covariance_relative[f"m{k}"], (k + 1) * _EDGE, rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(found.covariance[f"m{k}"], (k + 1) * _EDGE + _TIGHT, rtol=1e-4, atol=1e-12)
    assert found.message == "chi-square 0.0 with 0 degrees of freedom"


def test_an_anchor_at_the_far_end_halves_the_middle() -> None:
    """Between two anchors n edges apart, k from one: k (n - k) / n of an edge's covariance."""
    nodes = [GraphNode(map_id="A", prior=_TIGHT), GraphNode(map_id="B", prior=_TIGHT)]
    nodes += [GraphNode(map_id=f"m{k}") for k in range(1, 4)]
    names = ["A", "m1", "m2", "m3", "B"]
    edges = [_edge(b, a) for a, b in itertools.pairwise(names)]
    found = solved(nodes, edges)
    for k in range(1, 4):
        np.testing.assert_allclose(
            found.covariance_relative[f"m{k}"], k * (4 - k) / 4 * _EDGE, rtol=1e-6, atol=1e-15
        )
    # m2 hung two edges from A: now it has half of that.
    assert found.covariance_relative["m2"][4, 4] == pytest.approx(_SIGMA[4] ** 2, rel=1e-6)


def test_the_drift_of_a_chain_is_spread_over_its_edges() -> None:
    nodes = [GraphNode(map_id="A", prior=_TIGHT), GraphNode(map_id="B", prior=_TIGHT)]
    nodes += [GraphNode(map_id=f"m{k}") for k in range(1, 4)]
    # The chain drifted 0.08 m east by B, whose overlap with m3 says so.
    edges = [_edge("m1", "A"), _edge("m2", "m1"), _edge("m3", "m2"), _edge("m3", "B", _east(-0.08))]
    found = solved(nodes, edges)
    assert found.reason is None
    for k in range(1, 4):
        np.testing.assert_allclose(found.corrections[f"m{k}"].log()[4:], [-0.02 * k, 0.0, 0.0], atol=1e-6)
    # (0.08)^2 against the sum of four variances.
    assert found.message == f"chi-square {0.08**2 / (4 * _SIGMA[4] ** 2):.1f} with 7 degrees of freedom"


def test_general_similarities_are_recovered() -> None:
    """Maps displaced by known similarities; exact edges in general position bring them back."""
    rng = np.random.default_rng(4)
    truth = {m: Sim3.exp(rng.normal(0, [0.02, 0.1, 0.1, 0.1, 5, 5, 5])) for m in "bcd"}
    truth["a"] = Sim3.identity()
    pairs = [("b", "a"), ("c", "b"), ("d", "c"), ("d", "a"), ("c", "a")]
    edges = [graph_edge(i, j, truth[j].inverse() @ truth[i], _EDGE) for i, j in pairs]
    nodes = [GraphNode(map_id=m, prior=_TIGHT if m == "a" else None) for m in "abcd"]
    found = solved(nodes, edges)
    assert found.message.startswith("chi-square 0.0 ")
    for m in "bcd":
        np.testing.assert_allclose(found.corrections[m].matrix(), truth[m].matrix(), atol=1e-6)


@pytest.mark.evaluation
def test_covariance_is_that_of_many_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spread of solutions under sampled edge errors, with maps far from the origin and a loop."""
    monkeypatch.setattr("ingest.growth.graph.pose_graph._CHANCE", 1e-12)
    rng = np.random.default_rng(0)
    truth = {
        "a": Sim3.identity(),
        "b": Sim3.exp([0.01, 0.0, 0.0, 0.3, 200.0, 10.0, 0.0]),
        "c": Sim3.exp([-0.01, 0.0, 0.1, -0.2, 10.0, 300.0, 0.0]),
    }
    nodes = [GraphNode(map_id="a", prior=_TIGHT), GraphNode(map_id="b"), GraphNode(map_id="c")]
    pairs = [("b", "a"), ("c", "b"), ("c", "a")]

    def drawn(noise: bool) -> tuple[dict[str, Sim3], dict[str, FloatArray]]:
        edges = []
        for i, j in pairs:
            xi = rng.normal(0, _SIGMA) if noise else np.zeros(7)
            measured = Sim3.exp(xi) @ truth[j].inverse() @ truth[i]
            edges.append(graph_edge(i, j, measured, _EDGE))
        found = solved(nodes, edges)
        return dict(found.corrections), dict(found.covariance)

    _, covariance = drawn(noise=False)
    samples = [drawn(noise=True)[0] for _ in range(40)]
    for m in "bc":
        errors = np.array([(s[m] @ truth[m].inverse()).log() for s in samples])
        whitened = errors @ np.linalg.inv(np.linalg.cholesky(covariance[m])).T
        # 40 squared norms of 7 unit normals: mean 7, deviation of the mean 0.59.
        assert (whitened**2).sum(axis=1).mean() == pytest.approx(7.0, abs=2.0)


def _square(wrong: tuple[float, ...]) -> tuple[list[GraphNode], list[GraphEdge]]:
    """An anchor and three maps, every pair of them overlapping; one overlap of m1 and m3 is wrong."""
    nodes = [GraphNode(map_id="A", prior=_TIGHT), *(GraphNode(map_id=f"m{k}") for k in (1, 2, 3))]
    edges = [
        _edge("m1", "A"), _edge("m2", "A"), _edge("m3", "A"),
        _edge("m2", "m1"), _edge("m3", "m2"), _edge("m3", "m1", wrong),
    ]  # fmt: skip
    return nodes, edges


_TURNED = [
    pytest.param((0.0, 0.0, 0.0, np.radians(angle), 20.0, 5.0, 0.0), id=f"{angle} degrees")
    for angle in (90, 180)
]


@pytest.mark.parametrize("wrong", [pytest.param(_east(5.0), id="5 m"), *_TURNED])
def test_an_edge_that_contradicts_the_rest_is_named_and_left_out(wrong: tuple[float, ...]) -> None:
    found = solved(*_square(wrong))
    assert found.reason is None
    assert found.left_out == (("m3", "m1"),)
    for m in ("m1", "m2", "m3"):
        np.testing.assert_allclose(found.corrections[m].log(), np.zeros(7), atol=1e-6)


@pytest.mark.parametrize("wrong", _TURNED)
@pytest.mark.parametrize("edge", [("m4", "m3"), ("m4", "m2")], ids=" - ".join)
def test_of_two_overlaps_that_alone_hold_a_map_none_is_left_out(
    edge: tuple[str, str], wrong: tuple[float, ...]
) -> None:
    """At the end of a band of maps, each of which overlaps the next two, one of the last two is turned."""
    names = ["A", "m1", "m2", "m3", "m4"]
    nodes = [GraphNode(map_id=m, prior=_TIGHT if m == "A" else None) for m in names]
    pairs = [*zip(names[1:], names, strict=False), *zip(names[2:], names, strict=False)]
    found = solved(nodes, [_edge(*pair, wrong if pair == edge else (0.0,) * 7) for pair in pairs])
    assert found.reason == "CONTRADICTION"
    assert not found.corrections


def test_the_only_way_to_an_anchor_is_never_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the figures say of it: without it the map would have no place."""
    nodes, edges = _square((0.0,) * 7)
    nodes = [*nodes, GraphNode(map_id="far", prior=None)]
    edges = [*edges, _edge("far", "m1", (0.0,) * 7)]

    def bridge(fitted: Any, judged: object) -> Any:
        return next((of for of in fitted.edges if of[0] == "far"), None)

    monkeypatch.setattr(pose_graph, "_contradicting", bridge)
    found = solved(nodes, edges)
    assert found.left_out == ()
    assert "far" in found.corrections


def test_an_edge_within_its_noise_is_kept() -> None:
    found = solved(*_square(_east(0.03)))
    assert found.reason is None
    assert found.left_out == ()


def _loop(closing_m: float) -> tuple[list[GraphNode], list[GraphEdge]]:
    nodes = [GraphNode(map_id="A", prior=_TIGHT), GraphNode(map_id="B", prior=_TIGHT), GraphNode(map_id="m")]
    return nodes, [_edge("m", "A"), _edge("m", "B", _east(closing_m))]


def test_a_loop_that_misses_by_more_than_its_noise_widens_all_covariances() -> None:
    """Either edge explains it alike, so none is left out; the middle is taken, less sure of itself."""
    found = solved(*_loop(0.4))
    assert found.reason is None
    assert found.left_out == ()
    chi_square = 0.4**2 / (2 * _SIGMA[4] ** 2)
    np.testing.assert_allclose(
        found.covariance_relative["m"], chi_square / 7 * _EDGE / 2, rtol=1e-3, atol=1e-12
    )


def test_a_loop_that_misses_by_far_is_refused_with_its_edges() -> None:
    found = solved(*_loop(30.0))
    assert found.reason == "CONTRADICTION"
    assert "m - A" in found.message
    assert "m - B" in found.message
    assert not found.corrections


def test_maps_without_an_anchor_stay() -> None:
    nodes = [GraphNode(map_id="A", prior=_TIGHT), *(GraphNode(map_id=m) for m in ("m", "x", "y"))]
    found = solved(nodes, [_edge("m", "A"), _edge("x", "y")])
    assert set(found.corrections) == {"A", "m"}
    nothing = solved(nodes[1:], [_edge("x", "y")])
    assert nothing.reason == "NO_ANCHOR"


def test_anchors_give_way_within_their_own_covariance() -> None:
    """A GPS anchor of 3 m next to one of 3 cm moves; the better one stays."""
    loose = np.diag(np.repeat([1e-3, 3.0], [4, 3]) ** 2)
    firm = np.diag(np.repeat([1e-5, 0.03], [4, 3]) ** 2)
    nodes = [GraphNode(map_id="gps", prior=loose), GraphNode(map_id="lidar", prior=firm)]
    found = solved(nodes, [_edge("gps", "lidar", _east(2.0), _TIGHT)])
    assert found.corrections["gps"].log()[4] == pytest.approx(2.0, abs=0.01)
    assert abs(found.corrections["lidar"].log()[4]) < 0.01


def test_an_anchor_that_was_moved_remembers_its_own_placement() -> None:
    """Moved 2 m by an earlier graph; with the same overlap again nothing moves or is counted twice."""
    loose = np.diag(np.repeat([1e-3, 3.0], [4, 3]) ** 2)
    firm = np.diag(np.repeat([1e-5, 0.03], [4, 3]) ** 2)
    first = solved(
        [GraphNode(map_id="gps", prior=loose), GraphNode(map_id="lidar", prior=firm)],
        [_edge("gps", "lidar", _east(2.0), _TIGHT)],
    )
    nodes = [
        GraphNode(map_id=m, prior=prior, present_from_own=first.corrections[m])
        for m, prior in (("gps", loose), ("lidar", firm))
    ]
    measured = first.corrections["lidar"] @ Sim3.exp(_east(2.0)) @ first.corrections["gps"].inverse()
    again = solved(nodes, [graph_edge("gps", "lidar", measured, _TIGHT)])
    np.testing.assert_allclose(again.corrections["gps"].matrix(), np.eye(4), atol=1e-6)
    np.testing.assert_allclose(again.covariance["gps"], first.covariance["gps"], rtol=1e-3, atol=1e-9)


def test_a_large_graph_takes_the_sparse_way_to_the_same_answer() -> None:
    count = 200
    nodes = [GraphNode(map_id="A", prior=_TIGHT), GraphNode(map_id="B", prior=_TIGHT)]
    nodes += [GraphNode(map_id=f"m{k}") for k in range(1, count)]
    names = ["A", *(f"m{k}" for k in range(1, count)), "B"]
    edges = [_edge(b, a) for a, b in itertools.pairwise(names)]
    found = solved(nodes, edges)
    np.testing.assert_allclose(found.covariance_relative["m100"], 50 * _EDGE, rtol=1e-5, atol=1e-14)
