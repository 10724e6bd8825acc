"""Growth places maps without a place by the maps that show the same, or says why not."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import Placement
from featuredb.maps.move import placed_map
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import NoPlace, UnplacedMap
from featuredb.store import Database
from featuredb.store.encode import content_digest
from ingest.growth.run import grow
from ingest.growth.unplaced import left_over, place_unplaced_maps
from ingest.growth.values import GrowthOptions, GrowthPhotos
from ingest.map_builder import MapOptions, build_unplaced_map
from reloc.localiser import Localiser
from tests.support.growth_box import DESCRIPTORS, FRAME, KEY, POINTS, existing, walk
from tests.support.new_photos import identity, take_photos
from tests.support.scenes import random_descriptors

_PHOTOS = walk(4)


def _unplaced(map_id: str, showing: Collection[int]) -> UnplacedMap:
    """What photos become whose place nobody knows; those of `showing` show what the placed map shows."""
    rng = np.random.default_rng(3)
    new = take_photos(rng, POINTS, DESCRIPTORS, _PHOTOS, camera_key=KEY)
    strange = random_descriptors(rng, len(POINTS))
    features = [
        made
        if row in showing
        else replace(made, features=replace(made.features, descriptors=strange[new.world_of[row]]))
        for row, made in enumerate(new.features)
    ]
    why = NoPlace(reason_code="TOO_FEW", reason="no photo has GPS", ways=("picks",))
    made = build_unplaced_map(new.model, why, new.photos, features, identity(map_id), MapOptions())
    assert made is not None
    return made


@pytest.fixture
def database(tmp_path: Path) -> Database:
    database = Database.create(tmp_path / "db")
    database.commit_map(existing())
    return database


def test_a_map_without_a_place_is_placed_by_one_that_shows_the_same(
    database: Database, tmp_path: Path
) -> None:
    unplaced = _unplaced("loose", range(4))
    before = database.commit_map(unplaced).version
    areas, options = Localiser.open(database).areas, GrowthOptions()
    done, _ = place_unplaced_maps(database, areas, tmp_path / "work", options)
    assert [(entry.map_id, entry.status) for entry in done] == [("loose", "quarantined")], done
    placed = database.snapshot().load_map("loose")
    assert (placed.status, placed.generation, placed.parents) == ("quarantined", 1, ("old",))
    assert (placed.placement.method, placed.name) == ("map", "loose")
    growth = placed.placement.evidence["growth"]
    assert growth["gates"]["drift"]["passes"]
    centers = np.array([image.cam_from_local.center for image in placed.images])
    off = np.linalg.norm(FRAME.enu_from(placed.frame).act(centers) - [p.center for p in _PHOTOS], axis=1)
    assert off.max() < growth["drift_m"] < 0.5
    seen = placed.observations
    assert seen.descriptors[seen.has_descriptor].any(axis=1).all()
    database.rollback(before)
    assert content_digest(database.snapshot().load_unplaced("loose")) == content_digest(unplaced)


def test_photos_that_are_not_taken_along_stay_a_map_without_a_place() -> None:
    unplaced = _unplaced("loose", range(4))
    here = Placement(
        method="map", local_from_sfm=Sim3.identity(), covariance=np.eye(7) * 1e-6, residual_rms_m=0.0
    )
    whole = replace(placed_map(unplaced, here, FRAME, "unknown"), parents=("old",))
    why = {"by": "map-1", "code": "CONTRADICTS", "why": "they lie elsewhere"}
    (rest,) = left_over(unplaced, only_images(whole, [0]), **why)
    assert [image.name for image in rest.images] == [f"new-{k}.jpg" for k in (1, 2, 3)]
    assert rest.map_id.startswith("loose-")
    assert rest.no_place.reason_code == "CONTRADICTS"
    assert "placed by map-1: they lie elsewhere" in rest.no_place.reason
    assert rest.no_place.ways == ("picks",)
    assert left_over(unplaced, only_images(whole, [0, 1]), **why) == []  # two photos are no map


def test_what_the_gates_refuse_stays_without_a_place(database: Database, tmp_path: Path) -> None:
    """One photo that shows the placed map proves nothing; the other map shows another place."""
    database.commit_maps([_unplaced("hardly", {1}), _unplaced("elsewhere", ())])
    for _ in range(2):  # the second run remembers
        report = grow(database, GrowthPhotos(), tmp_path / "work")
        found = {entry.map_id: entry.reason_code for entry in report.maps}
        assert found == {"hardly": "TOO_FEW_AGREE", "elsewhere": "NOT_LOCALISED"}, report.as_text()
    assert "has no place still: TOO_FEW_AGREE" in report.as_text()
    assert {m.map_id for m in database.snapshot().unplaced_maps()} == {"hardly", "elsewhere"}
