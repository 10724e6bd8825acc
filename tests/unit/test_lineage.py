"""Chains of maps to their anchors, in figures and in words."""

import math
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from featuredb.maps.feature_map import MapMethod, MapStatus
from featuredb.maps.lineage import (
    children_of,
    describe_lineage,
    drift_and_budget,
    family_of,
    trace,
)


@dataclass(frozen=True, kw_only=True)
class Described:
    map_id: str
    parents: tuple[str, ...] = ()
    status: MapStatus = "active"
    drift_m: float | None = None
    budget_m: float | None = None
    generation: int = 0
    method: MapMethod = "gps"


def maps(*described: Described) -> dict[str, Described]:
    return {d.map_id: d for d in described}


CHAIN = maps(
    Described(map_id="A12"),
    Described(map_id="B", parents=("A12",)),
    Described(map_id="C", parents=("B",)),
    Described(map_id="D", parents=("C",), drift_m=0.312, budget_m=0.5),
)


def test_the_words_of_a_chain() -> None:
    assert describe_lineage(trace("D", CHAIN)) == "3 steps from anchor A12, 0.31 of 0.50 m"
    assert describe_lineage(trace("C", CHAIN)) == "2 steps from anchor A12"
    assert describe_lineage(trace("B", CHAIN)) == "1 step from anchor A12"
    assert describe_lineage(trace("A12", CHAIN)) == "anchor"
    only_drift = {**CHAIN, "B": Described(map_id="B", parents=("A12",), drift_m=0.1)}
    assert describe_lineage(trace("B", only_drift)) == "1 step from anchor A12, 0.10 m"


def test_the_chain_itself() -> None:
    lineage = trace("D", CHAIN)
    assert lineage.chain == ("D", "C", "B", "A12")
    assert lineage.anchors == ("A12",)
    assert (lineage.steps, lineage.drift_m, lineage.budget_m) == (3, 0.312, 0.5)


def test_the_nearest_of_several_anchors_comes_first() -> None:
    town = {
        **CHAIN,
        "Z": Described(map_id="Z"),
        "E": Described(map_id="E", parents=("D", "Z")),
    }
    lineage = trace("E", town)
    assert lineage.anchors == ("Z", "A12")
    assert lineage.chain == ("E", "Z")


def test_chains_lead_over_living_maps() -> None:
    town = {
        **CHAIN,
        "B": Described(map_id="B", parents=("A12",), status="retired"),
        "C": Described(map_id="C", parents=("B", "D2")),
        "D2": Described(map_id="D2", parents=("D1",)),
        "D1": Described(map_id="D1"),
    }
    assert trace("C", town).chain == ("C", "D2", "D1")
    assert trace("C", town).anchors == ("D1",)


def test_a_retired_map_still_shows_how_it_came_about() -> None:
    retired = {m: Described(map_id=m, parents=d.parents, status="retired") for m, d in CHAIN.items()}
    assert trace("D", retired).chain == ("D", "C", "B", "A12")


def test_a_map_whose_parents_are_gone_has_no_anchor() -> None:
    lineage = trace("B", maps(Described(map_id="B", parents=("gone",), drift_m=1.0)))
    assert (lineage.steps, lineage.anchors, lineage.chain) == (None, (), ("B",))
    assert describe_lineage(lineage) == "no chain to an anchor, 1.00 m"


def test_a_circle_ends() -> None:
    circle = maps(Described(map_id="A", parents=("B",)), Described(map_id="B", parents=("A",)))
    assert trace("A", circle).steps is None
    assert family_of("A", circle) == {"A", "B"}


def test_family_and_children() -> None:
    town = {
        **CHAIN,
        "Z": Described(map_id="Z"),
        "E": Described(map_id="E", parents=("A12", "A12")),
    }
    assert family_of("C", town) == {"A12", "B", "C", "D"}
    assert family_of("A12", town) == {"A12", "B", "C", "D", "E"}
    assert children_of({m: one.parents for m, one in town.items()})["A12"] == ["B", "E"]


@pytest.mark.parametrize(
    ("evidence", "found"),
    [
        ({"growth": {"drift_m": 0.3, "budget_m": 1}}, (0.3, 1.0)),
        ({"growth": {"drift_m": 0.0}}, (0.0, None)),
        ({"growth": {"drift_m": -0.1, "budget_m": math.inf}}, (None, None)),
        ({"growth": {"drift_m": "0.3", "budget_m": True}}, (None, None)),
        ({"growth": []}, (None, None)),
        ({}, (None, None)),
    ],
)
def test_drift_out_of_evidence(evidence: dict[str, object], found: tuple[float | None, float | None]) -> None:
    assert drift_and_budget(evidence) == found


@given(
    st.integers(1, 12).flatmap(
        lambda n: st.lists(st.lists(st.integers(0, n - 1), max_size=3).map(tuple), min_size=n, max_size=n)
    )
)
def test_chains_are_shortest_by_another_way(parents: list[tuple[int, ...]]) -> None:
    """Bellman-Ford over the same links."""
    town = maps(*(Described(map_id=str(i), parents=tuple(map(str, p))) for i, p in enumerate(parents)))
    far = len(parents) + 1
    steps = [0 if not p else far for p in parents]
    for _ in parents:
        steps = [min([s, *(steps[q] + 1 for q in p)]) for s, p in zip(steps, parents, strict=True)]
    for i, expected in enumerate(steps):
        lineage = trace(str(i), town)
        assert lineage.steps == (None if expected >= far else expected)
        for child, parent in zip(lineage.chain, lineage.chain[1:], strict=False):
            assert parent in town[child].parents
        if lineage.anchors:
            assert lineage.chain[-1] == lineage.anchors[0]
            assert not town[lineage.anchors[0]].parents
