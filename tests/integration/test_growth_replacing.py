"""Overlaps and re-placement on databases of small maps whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import in_frame, move_map
from featuredb.store.changes import IMPORTED
from ingest.growth.graph.map_graph import placed_maps
from ingest.growth.graph.replacing import replace_descendants
from ingest.growth.place.map_images import measure_overlap
from ingest.growth.values import Edge
from tests.support.scene_strip import (
    ANCHOR,
    FRAME,
    POINTS,
    add,
    database_of,
    east,
    error_m,
    strip_map,
)

_BUDGET_M = 0.5


def test_an_overlap_is_measured(tmp_path: Path) -> None:
    """A map displaced by a known similarity, against one that is right."""
    move = Sim3.exp([0.002, 0.001, -0.002, 0.003, 0.4, -0.3, 0.2])
    crooked = strip_map("m", 40.0, move=move, seed=1)
    found = measure_overlap(crooked, strip_map("n", 55.0, seed=2))
    assert isinstance(found, Edge), found
    places = POINTS[np.abs(POINTS[:, 0] - 45.0) < 20.0]
    miss = found.other_from_map.act(move.act(places)) - places
    assert np.linalg.norm(miss, axis=1).max() < 0.03
    error = (found.other_from_map @ move).log()
    assert error @ np.linalg.solve(found.covariance, error) < 24.0  # 0.1 % of a chi-square of 7


def test_maps_that_do_not_overlap_have_none(tmp_path: Path) -> None:
    found = measure_overlap(strip_map("m", 20.0, seed=1), strip_map("n", 150.0, seed=2))
    assert isinstance(found, str)
    assert "images are found" in found


def _chain(drift_each_m: float, far: Sim3 | None) -> list[FeatureMap]:
    """An anchor, four maps that drift away from it, and an anchor at the far end that came later."""
    maps = [ANCHOR]
    for k in range(1, 5):
        maps.append(
            strip_map(
                f"m{k}", 20.0 + 32.0 * k, owners=["anna", "ben"], parents=[maps[-1]], status="active",
                move=east(drift_each_m * k), seed=k,
            )
        )  # fmt: skip
    if far is not None:
        maps.append(strip_map("B", 165.0, owners=["survey"], move=far, seed=9))
    return maps


def test_an_anchor_at_the_far_end_re_places_what_drifted_in_one_commit(tmp_path: Path) -> None:
    database = database_of(tmp_path, *_chain(0.06, Sim3.identity()))
    before = database.poll_version()
    done = replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M)
    assert done is not None
    assert done.reason is None
    assert database.poll_version() == before + 1
    snapshot = database.snapshot()
    for k in range(1, 5):
        drifted, placed = 0.06 * k, error_m(snapshot.load_map(f"m{k}"), 20.0 + 32.0 * k)
        assert placed < max(0.5 * drifted, 0.05)
        assert snapshot.get(f"m{k}").status == "active"
    assert error_m(snapshot.load_map("A"), 20.0) < 0.03
    assert {m.map_id for m in done.moved} >= {"m1", "m2", "m3", "m4"}
    # m4 overlaps the new anchor and says so; drift is a quarter of a chain of four, at most.
    assert "B" in snapshot.get("m4").parents
    drift = {m.map_id: m.drift_m for m in done.moved}
    assert drift["m4"] < drift["m2"] < 0.5
    # Everything has been said: a second look finds nothing to do, and measures nothing.
    assert replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M) is None
    assert database.poll_version() == before + 1


def test_an_anchor_that_contradicts_by_far_moves_nothing(tmp_path: Path) -> None:
    """The far anchor lies eight metres off: neither side is believed, and the report names the overlaps."""
    database = database_of(tmp_path, *_chain(0.0, east(8.0)))
    before = database.poll_version()
    done = replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M)
    assert done is not None
    assert done.reason == "CONTRADICTION"
    assert "m4 - B" in done.message
    assert database.poll_version() == before


def test_what_was_imported_moves_nothing(tmp_path: Path) -> None:
    """A dataset's anchor and edge, forged to be surer than all else, would pull at the database's anchor."""
    database = database_of(tmp_path, ANCHOR)
    sure = np.diag(np.repeat([1e-9, 1e-5], [4, 3]))
    forger = strip_map("X", 20.0, owners=["survey"], move=east(1.0), covariance=sure, seed=5)
    forger = replace(forger, status="quarantined")
    forged = strip_map("y", 30.0, owners=["eve"], parents=[ANCHOR, forger], seed=6)
    database.commit_maps([forger, forged], reasons={"X": IMPORTED, "y": IMPORTED})
    assert set(placed_maps(database.snapshot())) == {"A"}
    for feature_map in _chain(0.06, Sim3.identity())[1:]:
        add(database, feature_map)
    done = replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M)
    assert done is not None
    assert done.reason is None
    assert not {"X", "y"} & {m.map_id for m in done.moved}
    assert error_m(database.snapshot().load_map("A"), 20.0) < 0.03


def test_a_map_that_only_an_import_holds_stays_where_it_is(tmp_path: Path) -> None:
    """Its other parent is placed anew, and hangs on the same import."""
    imported = replace(strip_map("X", 20.0, owners=["survey"]), status="quarantined")
    first = strip_map("m1", 45.0, owners=["anna"], parents=[imported], seed=1)
    second = strip_map("m2", 60.0, owners=["ben"], parents=[first], seed=2)
    database = database_of(tmp_path)
    database.commit_maps([imported], reasons={"X": IMPORTED})
    for feature_map in (first, second):
        add(database, feature_map)
    database.commit_map(
        move_map(first, in_frame(east(0.1), FRAME, first.frame), covariance=first.placement.covariance),
        replaces="m1",
    )
    before = database.poll_version()
    done = replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M)
    assert done is not None
    assert done.reason == "NO_ANCHOR"
    assert database.poll_version() == before


def test_a_parent_that_is_placed_anew_takes_its_children_along(tmp_path: Path) -> None:
    """A survey with GPS of metres is anchored by LiDAR two metres west: its children follow."""
    loose = np.diag(np.repeat([1e-4, 3.0], [4, 3]) ** 2)
    first = strip_map("A", 20.0, owners=["survey"], move=east(2.0), covariance=loose)
    child = strip_map(
        "m1", 52.0, owners=["anna", "ben"], parents=[first], status="active", move=east(2.0), seed=1
    )
    database = database_of(tmp_path, first, child)
    right = replace(
        move_map(first, in_frame(east(-2.0), FRAME, first.frame), covariance=ANCHOR.placement.covariance),
        status="active",
    )
    result = database.commit_map(right, replaces="A")
    assert result.flagged == ("m1",)
    done = replace_descendants(database, tmp_path / "work", budget_m=_BUDGET_M)
    assert done is not None
    assert done.reason is None
    snapshot = database.snapshot()
    assert snapshot.get("m1").status == "active"
    assert error_m(snapshot.load_map("m1"), 52.0) < 0.1
    assert error_m(snapshot.load_map("A"), 20.0) < 0.02
    placed = placed_maps(snapshot)
    assert placed["m1"].edges[0].place == placed["A"].place
