"""Maps without a place in the database, and databases of the format before they were."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deltalake import DeltaTable

from featuredb.errors import MapNotFoundError, StoreError, UnplacedMapError
from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from featuredb.store.encode import content_digest
from featuredb.store.maintenance import compact, upgrade
from featuredb.store.sql import SqlSession
from featuredb.store.verify import verify
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from tests.support.maps import assert_same_map, random_map, random_unplaced_map
from tests.support.planar_map import CAMERA, field_texture, render, view

OLD = Path(__file__).parent.parent / "data" / "format1.db"


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database.create(tmp_path / "maps.db")


@pytest.fixture
def old(tmp_path: Path) -> Database:
    shutil.copytree(OLD, tmp_path / "old.db")
    return Database.open(tmp_path / "old.db")


def test_a_map_without_a_place_comes_back_as_it_was(database: Database) -> None:
    unplaced = random_unplaced_map(1)
    database.commit_maps([unplaced, random_map(2)])
    snapshot = database.snapshot()
    again = snapshot.load_unplaced("map-1")
    assert content_digest(again) == content_digest(unplaced)
    assert np.array_equal(again.points.xyz, unplaced.points.xyz)
    assert again.no_place == unplaced.no_place
    assert again.frame == unplaced.frame
    assert [m.map_id for m in snapshot.maps()] == ["map-2"]
    assert [m.map_id for m in snapshot.unplaced_maps()] == ["map-1"]
    assert verify(database).problems == ()


def test_what_needs_a_place_says_what_gives_one(database: Database) -> None:
    database.commit_maps([random_unplaced_map(1), random_map(2)])
    snapshot = database.snapshot()
    with pytest.raises(UnplacedMapError, match=r"no photo has GPS.*place it by picks"):
        snapshot.load_map("map-1")
    with pytest.raises(UnplacedMapError):
        snapshot.get("map-1")
    with pytest.raises(MapNotFoundError, match="has a place"):
        snapshot.load_unplaced("map-2")
    with pytest.raises(StoreError, match="no place, so it cannot be active"):
        database.set_status(["map-1"], "active", "because")


def test_sql_shows_no_place_where_there_is_none(database: Database) -> None:
    database.commit_maps([random_unplaced_map(1), random_map(2)])
    with SqlSession(database.snapshot()) as session:
        counts = session.query(
            "select map_id, count(*), count(easting), count(x), count(zone), count(tile) from points "
            "group by map_id order by map_id"
        )
        assert list(counts.rows) == [("map-1", 60, 0, 60, 0, 0), ("map-2", 60, 60, 0, 60, 60)]
        epsg = session.query("select map_id, epsg, frame_is_metric from maps order by map_id")
        assert list(epsg.rows) == [("map-1", None, False), ("map-2", 32632, None)]


def test_placing_replaces_and_rollback_brings_the_map_without_a_place_back(database: Database) -> None:
    unplaced = random_unplaced_map(1)
    before = database.commit_map(unplaced)
    placed = random_map(1)
    done = database.commit_map(placed, replaces="map-1", based_on=before.write_id)
    assert done.created
    assert_same_map(database.snapshot().load_map("map-1"), placed)
    assert database.snapshot().unplaced_maps() == []
    database.rollback(before.version)
    assert isinstance(database.snapshot().load_any("map-1"), UnplacedMap)
    assert database.retire("map-1", "not wanted") == ("map-1",)
    assert database.snapshot().unplaced_maps() == []
    assert compact(database)["maps"] >= 0
    assert verify(database).problems == ()


def test_verify_finds_a_place_that_a_map_without_one_cannot_have(database: Database) -> None:
    database.commit_map(random_unplaced_map(1))
    table = DeltaTable(f"{database.url}/points")
    table.update(updates={"easting": "456800.0"}, predicate="point_index = 3")
    problems = [p.what for p in verify(database).problems]
    assert problems == ["points: easting is not that of the map's coordinates"]


def test_an_old_database_answers_and_takes_placed_maps(old: Database) -> None:
    assert old.format == 1
    assert verify(old).problems == ()
    _asks_the_field(old)
    old.commit_map(random_map(2, fingerprint="other"))
    assert verify(old).problems == ()
    with pytest.raises(
        StoreError, match=r"format 1, which cannot keep maps without a place.*featuredb upgrade"
    ):
        old.commit_map(random_unplaced_map(3))
    upgrade(old)
    _asks_the_field(old)
    old.commit_map(random_unplaced_map(3))
    assert verify(old).problems == ()


def test_points_and_own_frame_agree() -> None:
    unplaced = random_unplaced_map(1)
    frame = LocalFrame.from_utm(456_800.0, 5_429_300.0, 120.0, 32632)
    assert np.allclose(unplaced.points_local(), random_map(1).points_local(frame))
    with pytest.raises(Exception, match="camera keys"):
        replace(unplaced, camera_keys=("only one",))


def _asks_the_field(database: Database) -> None:
    """The answer that the release which wrote the database gave."""
    photo = render(field_texture(1), view(3, 2, 40, 10, 30), seed=5)
    result = Localiser.open(database).localise(photo, LocaliseRequest(camera=CAMERA))
    assert result.pose is not None
    assert result.inliers == 264
    assert np.allclose(result.pose.utm, [456803.0096774445, 5429301.977452012, 159.99971344041452], atol=1e-6)
