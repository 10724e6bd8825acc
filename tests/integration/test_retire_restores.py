"""A bad map that got in is taken out again: every answer is, bit for bit, what it was before."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from featuredb.features.extractor import extract
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.store import Database
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from reloc.service.handler import reply_from_result
from tests.support.planar_map import CAMERA, field_texture, planar_map, render, view
from tests.support.remembered import remembered

_LIE_EAST_M = 6.0  # the same field once more, so far from where it is
pytestmark = pytest.mark.slow


def grown(feature_map: FeatureMap, map_id: str, *parents: str) -> FeatureMap:
    placement = replace(
        feature_map.placement,
        method="map",
        evidence={"growth": {"drift_m": 0.2, "budget_m": 0.5, "steps": 1, "anchors": list(parents)}},
    )
    return replace(
        feature_map, map_id=map_id, placement=placement, parents=parents, generation=1, status="active"
    )


@pytest.fixture(scope="module")
def fields() -> dict[str, FeatureMap]:
    anchor = planar_map(1, map_id="anchor")
    return {
        "anchor": anchor,
        "next": grown(planar_map(2, east_m=90.0), "next", "anchor"),
        "lie": grown(planar_map(1, east_m=_LIE_EAST_M), "lie", "anchor"),
        "lie's child": grown(planar_map(3, east_m=180.0), "lie's child", "lie"),
    }


@pytest.fixture(scope="module")
def queries() -> list[tuple[Any, LocaliseRequest]]:
    """Photos of both fields and of none, with and without a camera, one with a prior."""
    first, second, elsewhere = (field_texture(seed) for seed in (1, 2, 9))
    poses = [view(4, -6, 40, 10, 33), view(-7, 8, 50, 20, 200), view(0, 0, 44, 5, 90)]
    known = LocaliseRequest(camera=CAMERA, want_inliers=True)
    unknown = LocaliseRequest(want_inliers=True)
    prior = GeoPrior(
        latitude_deg=49.0152,
        longitude_deg=8.4092,
        height_m=None,
        sigma_horizontal_m=500.0,
        sigma_vertical_m=100.0,
    )
    return [
        (render(first, poses[0], seed=50), known),
        (render(first, poses[1], seed=51), unknown),
        (render(first, poses[2], seed=52), replace(known, prior=prior)),
        (render(second, poses[0], seed=53), known),
        (render(second, poses[1], seed=54), replace(unknown, map_ids=("next",))),
        (render(elsewhere, poses[0], seed=55), known),
    ]


def answers(localiser: Localiser, queries: list[tuple[Any, LocaliseRequest]]) -> list[dict[str, Any]]:
    """Everything that an answer says but when it was given and how long it took."""
    told = []
    for gray, request in queries:
        result = localiser.localise(gray, request)
        reply = reply_from_result(result, request_id="r", timings_ms={})
        told.append({**reply.model_dump(exclude={"snapshot"}), "evidence": result.evidence})
        if result.pose is not None:
            told[-1]["cam_from_local"] = result.pose.cam_from_local.matrix().tobytes()
            told[-1]["covariance_bits"] = result.pose.covariance.tobytes()
    return told


@pytest.fixture(scope="module", autouse=True)
def _features_found_once() -> Iterator[None]:
    """The same photos are asked for again and again; only what is found for them may differ."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reloc.localise.localise.extract", remembered(extract))
        yield


@pytest.fixture(scope="module")
def story(
    tmp_path_factory: pytest.TempPathFactory,
    fields: dict[str, FeatureMap],
    queries: list[tuple[Any, LocaliseRequest]],
) -> tuple[Database, int, list[dict[str, Any]], list[dict[str, Any]]]:
    """The database with the lie in it; the version before; the answers before and with it."""
    database = Database.create(tmp_path_factory.mktemp("store") / "town.db")
    database.commit_map(fields["anchor"])
    before = database.commit_map(fields["next"]).version
    old = answers(Localiser.open(database), queries)
    database.commit_maps([fields["lie"], fields["lie's child"]])
    return database, before, old, answers(Localiser.open(database), queries)


def test_the_lie_does_harm_while_it_is_in(story) -> None:
    """Otherwise the next tests would say nothing."""
    _, _, old, poisoned = story
    assert [a["status"] for a in old] == ["localised"] * 5 + ["not_localised"]
    assert [a != b for a, b in zip(old, poisoned, strict=True)][:3] == [True] * 3
    assert old[4]["lineage"][0]["drift_m"] == 0.2
    assert (old[4]["lineage"][0]["steps"], old[4]["lineage"][0]["anchors"]) == (1, ("anchor",))
    assert (old[0]["lineage"][0]["steps"], old[0]["lineage"][0]["drift_m"]) == (0, None)


def test_retire_brings_back_every_bit(story, queries) -> None:
    database, before, old, _ = story
    poisoned = Localiser.open(database)
    assert database.retire("lie", "look-alike field") == ("lie", "lie's child")
    assert answers(Localiser.open(database), queries) == old
    # A running server loads beside the localiser that it has.
    assert answers(Localiser.open(database, previous=poisoned), queries) == old
    assert [m.write_id for m in database.snapshot().maps()] == [
        m.write_id for m in database.snapshot(before).maps()
    ]


def test_rollback_brings_back_every_bit(story, queries, fields) -> None:
    database, before, old, poisoned = story
    database.commit_maps([fields["lie"], fields["lie's child"]])
    assert answers(Localiser.open(database), queries) == poisoned
    database.rollback(before)
    assert answers(Localiser.open(database), queries) == old
    assert database.snapshot().rows() == database.snapshot(before).rows()


def test_quarantine_brings_back_every_bit_and_promotion_the_harm(story, queries, fields) -> None:
    database, _, old, poisoned = story
    database.commit_maps([fields["lie"], fields["lie's child"]])
    assert database.set_status(["lie"], "quarantined", "one owner only").changed == ("lie", "lie's child")
    assert answers(Localiser.open(database), queries) == old
    database.set_status(["lie", "lie's child"], "active", "by hand")
    assert answers(Localiser.open(database), queries) == poisoned


def test_every_number_was_compared(story) -> None:
    """The comparison sees a change in the last bit of a pose."""
    _, _, old, _ = story
    moved = dict(old[0]["utm"], easting=float(np.nextafter(old[0]["utm"]["easting"], np.inf)))
    assert {**old[0], "utm": moved} != old[0]
    assert len(old[0]["inlier_points"]["pixels"]) == old[0]["inliers"] > 30
