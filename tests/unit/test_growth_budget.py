"""Which photos of a map that has drifted too far are within the budget by themselves."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import turns_about
from ingest.growth import gates
from ingest.growth.graph import map_graph
from ingest.growth.graph.map_graph import rows_within, with_drift
from ingest.growth.place.component import GrownMap
from ingest.growth.place.drift import PhotoSpread
from ingest.growth.values import GrowthPhotos
from tests.support.growth_box import grown_map
from tests.support.scenes import box_points, looking_at, random_descriptors, ring, scene_map

RNG = np.random.default_rng(4)
POINTS = box_points(RNG, 300)
BUDGET_M, BENDING_M = 0.5, 0.3  # 1.96 sigmas of the bending are beyond the budget


def bent(own_sigma_m: list[float], rows: list[int]) -> GrownMap:
    """A map whose photos show so surely what they do, NaN: not known; its bending is that of the worst."""
    plain = scene_map(
        points=POINTS, descriptors=random_descriptors(RNG, 300), poses=ring(len(own_sigma_m)), map_id="bent"
    )
    spread = replace(
        PhotoSpread.unknown(len(rows)),
        middles=np.zeros((len(rows), 3)),
        shown=np.square(own_sigma_m)[:, None, None] * np.eye(7),
    )
    model = SimpleNamespace(rows=np.array(rows))
    return grown_map(plain, model, bending_m=BENDING_M, spread=spread)


def within(own_sigma_m: list[float], rows: list[int], sigma_m: float) -> list[int]:
    grown = bent(own_sigma_m, rows)
    return rows_within(grown, grown.feature_map, relative(sigma_m), BUDGET_M)


def relative(sigma_m: float) -> FloatArray:
    """Covariance relative to the anchors: a shift of that sigma, and the bending."""
    return np.diag([0.0] * 4 + [sigma_m**2 + BENDING_M**2] * 3)


def test_photos_are_judged_by_their_own_bending() -> None:
    assert within([0.02, 0.05, 0.29, 0.1], [7, 3, 9, 4], 0.05) == [7, 3, 4]


def test_photos_that_know_nothing_of_themselves_bend_as_the_worst() -> None:
    assert within([np.nan, 0.02], [0, 1], 0.05) == [1]


def test_where_the_map_as_a_whole_has_drifted_no_photo_is_within() -> None:
    assert within([0.01, 0.01], [0, 1], 0.3) == []


@pytest.mark.parametrize(("off_m", "passes"), [(0.5, True), (0.51, False)])
def test_the_gate_of_drift(off_m: float, passes: bool) -> None:
    gate = gates.drift(off_m, BUDGET_M)
    assert gate.passes == passes
    assert f"{off_m:.2f} m" in gate.message


def test_photos_far_from_what_they_show_keep_the_budget_like_that() -> None:
    """A turn about the box moves two distant cameras by 0.8 m, and what they show by 0.1 m at most."""
    points = box_points(RNG, 2000)
    far = [looking_at(np.array([x, 0.0, 40.0]), np.array([0.0, 0.0, 3.0])) for x in (-400.0, 400.0)]
    plain = scene_map(points=points, descriptors=random_descriptors(RNG, 2000), poses=[*ring(4), *far])
    turn = turns_about(np.zeros(3)) @ turns_about(np.zeros(3)).T * 1e-3**2
    grown = grown_map(plain, SimpleNamespace(rows=np.arange(6)), covariance_relative=turn)
    feature_map, drift, relative = with_drift(grown, {}, BUDGET_M)
    assert drift == pytest.approx(1.96e-3 * np.hypot(400.0, 40.0), rel=1e-6)
    assert not gates.drift(drift, BUDGET_M).passes
    assert rows_within(grown, feature_map, relative, BUDGET_M) == [0, 1, 2, 3]


def test_each_photo_that_is_cut_off_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """One is beyond the budget, one hangs on it alone, one was left out before for a reason of its own."""

    feature_map = bent([np.nan], [0]).feature_map

    def grown(part: Any, *_: object) -> GrownMap:
        left_out = {3: ("WEAK_LINK", "little")} if 3 in part.rows else {}
        return grown_map(feature_map, part, bending_m=BENDING_M, left_out=left_out)

    def cut(part: Any, rows: list[int], least: int) -> Any:
        return SimpleNamespace(rows=np.array([0, 1, 2]))  # 4 hangs on nothing that is left

    whole = SimpleNamespace(rows=np.arange(6))
    monkeypatch.setattr(
        map_graph, "with_drift", lambda found, *_: (feature_map, 0.1 * len(found.model.rows), None)
    )
    monkeypatch.setattr(map_graph, "rows_within", lambda *_: [0, 1, 2, 4])
    monkeypatch.setattr(map_graph, "keep_photos", cut)
    monkeypatch.setattr(map_graph, "grow_component", grown)
    found = map_graph.grow_within_budget(whole, GrowthPhotos(), {}, [], {}, BUDGET_M)
    assert isinstance(found, GrownMap)
    codes = {row: code for row, (code, _) in found.left_out.items()}
    assert codes == {3: "WEAK_LINK", 4: "DRIFT_BUDGET", 5: "DRIFT_BUDGET"}
