"""Pure parts of trust in growth: graph of maps, drift, cut models, answering points, reports."""

import json
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.subset import answering_with
from featuredb.store import MapSummary
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.graph.map_graph import (
    OWN,
    PlacedMap,
    no_surer_than,
    place_key,
    solve_maps,
)
from ingest.growth.graph.replacing import MovedMap, Replacement, overlaps_to_measure
from ingest.growth.growth_report import GrownEntry, GrowthReport, PhotoFate
from ingest.growth.map_places import drift_m, growth_of, places_of
from ingest.growth.place.map_images import model_of
from ingest.growth.trust import canaries
from ingest.growth.trust.canaries import CanaryCheck, CanaryRun
from ingest.growth.trust.confirmation import OutsidePhoto, Source, confirm
from ingest.growth.trust.promotion import Promotion
from ingest.growth.values import Edge, GrowthPhotos
from ingest.photos.photo import Photo
from ingest.sfm.links import keep_photos
from tests.support.scene_strip import EDGE, FRAME, east, sources_of, strip_map

_ANCHOR = strip_map("A", 20.0, owners=["survey"])


def _place_of(feature_map: FeatureMap) -> str:
    return place_key(feature_map.frame, feature_map.placement)


def _placed(feature_map: FeatureMap, created_ms: int = 0) -> PlacedMap:
    growth = growth_of(feature_map.placement.evidence)
    own = ("map_id", "status", "generation", "parents")
    told: dict[str, Any] = dict.fromkeys(field.name for field in fields(MapSummary))  # what no test asks for
    told |= {name: getattr(feature_map, name) for name in own}
    told |= {"write_id": f"{created_ms:012x}{'0' * 20}", "status_reason": ""}
    return PlacedMap(
        summary=MapSummary(**told),
        frame=feature_map.frame,
        placement=feature_map.placement,
        place=_place_of(feature_map),
        corners=places_of(feature_map),
        edges=tuple(Edge.from_json(e) for e in growth.get("edges", ())),
    )


def test_an_edge_survives_json() -> None:
    edge = Edge(
        map_id="x", place="p", other_from_map=Sim3.exp(np.arange(7) * 0.01), covariance=EDGE,
        shared_points=5, photos=2,
    )  # fmt: skip
    again = Edge.from_json(json.loads(json.dumps(edge.as_json())))
    np.testing.assert_allclose(again.other_from_map.matrix(), edge.other_from_map.matrix(), atol=1e-12)
    np.testing.assert_array_equal(again.covariance, edge.covariance)
    assert (again.map_id, again.place, again.shared_points, again.photos) == ("x", "p", 5, 2)


def test_counts_of_a_foreign_edge_are_whole_numbers() -> None:
    told = {
        "map_id": 7,
        "place": "p",
        "shared_points": 5.0,
        "photos": "2",
        "covariance": EDGE.ravel().tolist(),
    }
    edge = Edge.from_json(told)
    assert (edge.map_id, edge.shared_points, edge.photos) == ("7", 5, 2)
    assert isinstance(edge.shared_points, int)


def test_photos_come_with_their_features_and_overlaps_with_their_geometry() -> None:
    photo = Photo(name="a.jpg", path=Path("a.jpg"), width=100, height=100)
    for incomplete in ({"photos": [photo]}, {"overlaps": [(0, 1)]}):
        with pytest.raises(InvalidValueError, match="features of photos and geometry of overlaps"):
            GrowthPhotos(**incomplete)  # type: ignore[arg-type]
    assert GrowthPhotos().models() == ()


def test_a_map_that_moves_has_another_place() -> None:
    moved = strip_map("A", 20.0, owners=["survey"], move=east(0.01))
    assert _place_of(_ANCHOR) == _place_of(strip_map("A", 20.0, owners=["else"]))
    assert _place_of(moved) != _place_of(_ANCHOR)


def test_drift_of_a_chain_grows_with_its_steps() -> None:
    """Drift by the graph: the covariance of n edges, at the images and the middles of what they show."""
    maps = {"A": _placed(_ANCHOR)}
    previous, drifts = _ANCHOR, []
    for k in range(1, 4):
        feature_map = strip_map(f"m{k}", 20.0 + 25.0 * k, parents=[previous], seed=k)
        placed = _placed(feature_map)
        solution = solve_maps(maps, {f"m{k}": placed.edges}, FRAME)
        np.testing.assert_allclose(solution.covariance_relative[f"m{k}"], k * EDGE, rtol=1e-6, atol=1e-15)
        places = places_of(feature_map)
        assert len(places) == 2 * len(feature_map.images)
        jacobian = point_jacobian(places)
        spread = jacobian @ (k * EDGE) @ np.swapaxes(jacobian, 1, 2)
        expected = 1.96 * np.sqrt(np.linalg.eigvalsh(spread).max())
        drifts.append(drift_m(solution.covariance_relative[f"m{k}"], places))
        assert drifts[-1] == pytest.approx(expected, rel=1e-6)
        maps[f"m{k}"] = placed
        previous = feature_map
    assert drifts[0] < drifts[1] < drifts[2]
    assert drift_m(EDGE, np.zeros((0, 3))) == 0.0


def test_two_edges_of_the_same_photos_count_once() -> None:
    """Both hold the map as surely as one fit to both did; independent, they would be twice as sure."""
    edge = Edge(
        map_id="A", place="", other_from_map=Sim3.identity(), covariance=EDGE, shared_points=1, photos=1
    )
    found = no_surer_than([edge, replace(edge, map_id="B")], EDGE)
    together = np.linalg.inv(sum(np.linalg.inv(e.covariance) for e in found))
    np.testing.assert_allclose(together, EDGE, rtol=1e-9)
    # Those that are no surer than the fit stay as they are; a single one gets what it lacks.
    np.testing.assert_allclose(no_surer_than([edge], EDGE / 2)[0].covariance, EDGE, rtol=1e-9)
    loose = no_surer_than([edge, replace(edge, map_id="B")], EDGE / 10)
    np.testing.assert_allclose(loose[0].covariance, EDGE, rtol=1e-9)
    bent = EDGE + np.diag([0.0] * 4 + [0.01] * 3)
    np.testing.assert_allclose(no_surer_than([edge], bent)[0].covariance, bent, rtol=1e-6)


def test_an_anchor_that_another_one_moved_does_not_count_their_overlap_twice() -> None:
    """A GPS anchor two metres east of a map on a firm one; solved again, nothing is surer than before."""
    loose = np.diag(np.repeat([1e-3, 3.0], [4, 3]) ** 2)
    gps, child = strip_map("gps", 20.0, covariance=loose), strip_map("m", 45.0, parents=[_ANCHOR])
    to_gps = Edge(
        map_id="gps",
        place=_place_of(gps),
        other_from_map=east(2.0),
        covariance=EDGE,
        shared_points=9,
        photos=3,
    )
    maps = {m.map_id: _placed(m) for m in (_ANCHOR, gps, child)}
    maps["m"] = replace(maps["m"], edges=(*maps["m"].edges, to_gps))
    first = solve_maps(maps, {"m": ()}, FRAME)
    moved = first.corrections["gps"]
    assert np.linalg.norm(moved.translation) > 1.5
    own = {"covariance": loose.ravel().tolist(), "present_from_own": moved.log().tolist()}
    anew = replace(gps.placement, covariance=first.covariance["gps"], evidence={"growth": {OWN: own}})
    there = replace(maps["gps"], placement=anew)
    agreeing = moved @ to_gps.other_from_map @ first.corrections["m"].inverse()
    edges = (maps["m"].edges[0], replace(to_gps, other_from_map=agreeing))
    maps |= {"gps": there, "m": replace(maps["m"], edges=edges)}
    again = solve_maps(maps, {"m": ()}, FRAME)
    assert np.linalg.norm(again.corrections["gps"].translation) < 0.01
    np.testing.assert_allclose(again.covariance["gps"], first.covariance["gps"], rtol=1e-3, atol=1e-6)


def test_the_gate_of_drift() -> None:
    assert gates.drift(0.49, 0.5).passes
    refused = gates.drift(0.51, 0.5)
    assert not refused.passes
    assert refused.reason == "DRIFT_BUDGET"
    assert "0.51 m" in refused.message


def test_which_overlaps_are_measured_anew() -> None:
    """Anchors that came after a map and touch it; parents that are not where they were; nothing else."""
    child = strip_map("m", 50.0, parents=[_ANCHOR])
    far = strip_map("F", 200.0)
    near = strip_map("N", 75.0)

    def wanted(anchor: FeatureMap, others: dict[FeatureMap, int]) -> list[tuple[str, str]]:
        maps = {"A": _placed(anchor), "m": _placed(child, 1000)}
        maps |= {m.map_id: _placed(m, at) for m, at in others.items()}
        return overlaps_to_measure(maps)

    assert wanted(_ANCHOR, {}) == []
    assert wanted(_ANCHOR, {near: 2000, far: 2000}) == [("m", "N")]
    assert wanted(_ANCHOR, {near: 500}) == []  # it was there when the map was placed, and did not hold it
    assert wanted(_ANCHOR, {replace(near, status="quarantined"): 2000}) == []
    assert wanted(strip_map("A", 20.0, owners=["survey"], move=east(1.0)), {}) == [("m", "A")]


def _model() -> Model:
    feature_map = strip_map("m", 40.0)
    return model_of(feature_map, feature_map.images, described=True)


def test_a_model_is_cut_to_the_photos_that_hang_together() -> None:
    model = _model()
    assert keep_photos(model, range(8)) is model
    assert keep_photos(model, range(8), least=len(model.rows) + 1) is None
    cut = keep_photos(model, [1, 2, 5])
    assert cut is not None
    assert cut.rows.tolist() == [1, 2, 5]
    assert (cut.track_lengths() >= 2).all()
    # The same point, seen by the same keypoint of the same photo.
    for o in (0, len(cut.point_of) // 2, len(cut.point_of) - 1):
        photo = int(cut.rows[cut.photo_of[o]])
        same = (model.photo_of == photo) & (model.keypoint_of == cut.keypoint_of[o])
        np.testing.assert_array_equal(model.xyz[model.point_of[same]][0], cut.xyz[cut.point_of[o]])
    assert keep_photos(model, [3]) is None
    assert keep_photos(model, []) is None


def test_a_model_falls_apart_where_nothing_is_shared() -> None:
    """Photos 0 and 1 see the west, 2 to 4 the east; the larger part is kept."""
    model = _model()
    west = model.xyz[model.point_of, 0] < 40.0
    keep = np.where(model.photo_of < 2, west, ~west) & (model.photo_of < 5)
    apart = replace(
        model, point_of=model.point_of[keep], photo_of=model.photo_of[keep],
        keypoint_of=model.keypoint_of[keep],
    )  # fmt: skip
    cut = keep_photos(apart, range(5))
    assert cut is not None
    assert cut.rows.tolist() == [2, 3, 4]


def test_only_points_of_two_sources_answer() -> None:
    """What only Eve's photos show, though they fit the rest, has no descriptors."""
    feature_map = strip_map("m", 40.0, owners=["anna", "ben", "eve", "anna"])
    eve = [i.image_id for i in feature_map.images if i.owner == "eve"]
    seen = feature_map.observations
    fake = feature_map.points_local()[:, 0] < 25.0
    keep = ~fake[seen.point_index] | np.isin(seen.image_id, eve)
    parts = {name: getattr(seen, name)[keep] for name in type(seen).__slots__}
    poisoned = replace(feature_map, observations=type(seen)(**parts))
    known = ("anna", "ben", "eve")
    points = confirm(poisoned, sources_of(poisoned, on_record=known)).points
    assert not points[fake].any()
    assert points[~fake].mean() > 0.9
    part = answering_with(poisoned, points)
    described = np.unique(part.observations.point_index[part.observations.has_descriptor])
    assert not fake[described].any()
    assert len(part.points) == len(poisoned.points)
    assert (part.observations.descriptors[~part.observations.has_descriptor] == 0).all()
    # Where all is seen by two, nothing changes; a trusted owner's points need nobody.
    clean = strip_map("m", 40.0, owners=["anna", "ben"])
    whole = answering_with(clean, np.ones(len(clean.points), dtype=bool)).observations
    np.testing.assert_array_equal(whole.descriptors, clean.observations.descriptors)
    np.testing.assert_array_equal(whole.has_descriptor, clean.observations.has_descriptor)
    trusted = confirm(poisoned, sources_of(poisoned, trusted=("eve",))).points
    assert trusted[fake].mean() > 0.5
    # Whose word does not count yet takes no part.
    assert not confirm(poisoned, sources_of(poisoned, on_record=["eve"])).points.any()


def test_a_witness_makes_points_answer() -> None:
    feature_map = strip_map("m", 40.0, owners=["anna"])
    rows = np.arange(100, dtype=np.int64)
    outside = OutsidePhoto(
        name="w", source=Source(owner="ben", proven=True), center=np.array([0.0, -60.0, 20.0]), points=rows
    )
    sources = sources_of(feature_map)
    alone = confirm(feature_map, sources).points
    found = confirm(feature_map, sources, [outside]).points
    assert not alone.any()
    assert found[rows].mean() > 0.9
    assert not found[100:].any()


def test_canaries_as_a_gate() -> None:
    good = CanaryCheck(name="a", before="right", after="right")
    bad = CanaryCheck(name="b", before="right", after="lost", regression="no longer localised")
    assert CanaryRun(checks=(good,), note="").gate.passes
    refused = CanaryRun(checks=(good, bad), note="").gate
    assert not refused.passes
    assert "b: no longer localised" in refused.message


def test_a_report_tells_all_in_both_forms() -> None:
    report = GrowthReport(
        database="db",
        started=datetime(2026, 6, 1, tzinfo=UTC),
        seconds=1.25,
        rounds=2,
        version=7,
        photos=(
            PhotoFate(name="p", owner="anna", outcome="promoted", map_id="m"),
            PhotoFate(name="q", owner="eve", outcome="waiting", reason_code="ALONE", reason="alone"),
        ),
        maps=(
            GrownEntry(
                map_id="m", status="active", reason_code="", reason="2 sources", photos=("p",), points=9,
                generation=1, drift_m=0.31, budget_m=0.5,
            ),
        ),
        promotions=(
            Promotion(map_id="m", promoted=True, reason_code="", reason="2 sources"),
            Promotion(map_id="old", promoted=False, reason_code="ONE_SOURCE", reason="1 of 2"),
        ),
        replacements=(
            Replacement(
                reason=None, message="1 map placed anew",
                moved=(MovedMap(map_id="m", move_m=0.2, drift_before_m=0.4, drift_m=0.1),),
                left_out=("a - b",), flagged=("z",),
            ),
        ),
        notes=("a note",),
    )  # fmt: skip
    text = report.as_text()
    for part in (
        "1 in active maps", "1 waiting", "ALONE: 1 photos", "1 step from an anchor", "0.31 of 0.50 m",
        "map old: stays in quarantine: ONE_SOURCE", "moved by 0.20 m", "overlap a - b",
        "note: a note", "quarantined, because nothing holds them any more: z",
    ):  # fmt: skip
        assert part in text
    assert text.count("map m:") == 1
    assert report.promoted == ("m",)
    told = json.loads(json.dumps(report.as_json()))
    assert told["photos"][1]["reason_code"] == "ALONE"
    assert told["replacements"][0]["moved"][0]["drift_before_m"] == 0.4
    assert Path(told["database"]).name == "db"


@pytest.mark.parametrize(
    ("right", "elsewhere", "refused"), [(3, 1, 0), (0, 1, 1), (1, 1, 1), (2, 2, 2), (0, 0, 0)]
)
def test_images_that_a_new_map_alone_has_elsewhere_count_unless_most_are_where_they_are(
    monkeypatch: pytest.MonkeyPatch, right: int, elsewhere: int, refused: int
) -> None:
    verdicts = ["right"] * right + ["moved"] * elsewhere + ["lost"] * 4
    told = iter(verdicts)

    def check(*_: object) -> tuple[CanaryCheck, str]:
        alone: Any = next(told)
        found = CanaryCheck(name="a", before="right", after="right", alone=alone)
        return found, "the new map alone has it 100 m off" if alone == "moved" else ""

    monkeypatch.setattr(canaries, "_check_own", check)
    monkeypatch.setattr(canaries, "own_canaries", lambda *_: [(None, None)] * len(verdicts))
    monkeypatch.setattr(canaries, "list_canaries", lambda _: [])
    nothing: Any = SimpleNamespace(areas=())
    run = canaries.run_canaries(nothing, nothing, nothing, [])
    assert len(run.checks) == len(verdicts)
    assert len(run.regressions) == refused
    assert run.gate.passes == (refused == 0)
