"""`featuredb thin` on a database: a new state at the same place, children untouched, rollback."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import ConflictError, StoreError
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.thin import described_points_of_images, thin_map
from featuredb.store import Database
from featuredb.store.verify import verify
from tests.support.maps import assert_same_map, random_map


@pytest.fixture
def database(tmp_path: Path) -> Database:
    """A map with 200 points and another one that it placed."""
    database = Database.create(tmp_path / "db")
    database.commit_map(random_map(1, map_id="parent", points=200, images=4, observations=1500))
    database.commit_map(random_map(2, map_id="child", parents=("parent",)))
    return database


def test_thinned_map_stands_where_it_stood_and_its_children_too(
    database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    before = database.snapshot()
    whole = before.load_map("parent")
    assert main(["thin", database.url, "par", "--cover", "20"]) == 0
    assert f"rollback {database.url} {before.version}" in capsys.readouterr().out
    after = database.snapshot()
    assert {m.map_id: m.status for m in after.maps()} == {"parent": "active", "child": "active"}
    thin = after.load_map("parent")
    np.testing.assert_array_equal(thin.points.utm, whole.points.utm)
    np.testing.assert_array_equal(thin.placement.covariance, whole.placement.covariance)
    assert described_points_of_images(thin).min() >= 20
    assert after.get("parent").descriptors < 0.5 * before.get("parent").descriptors
    assert verify(database).ok
    database.rollback(before.version)
    assert_same_map(database.snapshot().load_map("parent"), whole)


def test_dry_run_and_second_run_change_nothing(
    database: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    version = database.poll_version()
    assert main(["thin", database.url, "parent", "--cover", "20", "--dry-run"]) == 0
    assert database.poll_version() == version
    assert main(["thin", database.url, "parent", "--cover", "20"]) == 0
    assert main(["thin", database.url, "parent", "--cover", "20"]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert database.poll_version() == version + 1


def test_only_active_maps_and_known_ones(database: Database, capsys: pytest.CaptureFixture[str]) -> None:
    database.commit_map(replace(random_map(3, map_id="waiting"), status="quarantined"))
    assert main(["thin", database.url, "waiting"]) != 0
    assert main(["thin", database.url, "nowhere"]) != 0
    said = capsys.readouterr().err
    assert "waiting is quarantined" in said
    assert "nowhere" in said


def test_a_state_that_moved_is_not_taken_for_one_that_did_not(database: Database) -> None:
    whole = database.snapshot().load_map("parent")
    moved = replace(whole, placement=replace(whole.placement, local_from_sfm=Sim3.identity()))
    with pytest.raises(StoreError, match="local_from_sfm"):
        database.commit_map(moved, replaces="parent", moves=False)
    assert database.commit_map(moved, replaces="parent").flagged == ("child",)


def test_a_map_placed_anew_meanwhile_is_not_thinned_over(database: Database) -> None:
    summary = database.snapshot().get("parent")
    whole = database.snapshot().load_map("parent")
    thin = thin_map(whole, 20)
    moved = replace(whole, placement=replace(whole.placement, local_from_sfm=Sim3.identity()))
    database.commit_map(moved, replaces="parent")
    with pytest.raises(ConflictError):
        database.commit_map(thin, replaces="parent", based_on=summary.write_id, moves=False)
