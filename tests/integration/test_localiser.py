"""Localisation from a database: which maps answer, and what threads share."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import IncompatibleExtractorError, MapNotFoundError
from featuredb.features.extractor import ExtractorOptions
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import localise
from reloc.localise.options import CandidateOptions, LocaliseOptions
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from tests.support import planar_map as field
from tests.support.field_queries import KNOWN, POSE, indexed, moved, pose_errors
from tests.support.planar_map import EASTING, field_texture, render, view


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    return field.planar_map(map_id="field")


@pytest.fixture(scope="module")
def area(field_map: FeatureMap) -> IndexedArea:
    return indexed(field_map)


@pytest.fixture(scope="module")
def texture() -> NDArray[np.uint8]:
    return field_texture(1)


@pytest.fixture(scope="module")
def photo(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return render(texture, POSE, seed=99)


def test_threads_share_the_areas(area: IndexedArea, texture: NDArray[np.uint8]) -> None:
    photos = [render(texture, view(e, -5.0, 42.0, 10.0, 20.0 * e), seed=e) for e in range(6)]
    requests = [KNOWN if i % 2 else LocaliseRequest() for i in range(6)]
    serial = [localise(p, r, [area]) for p, r in zip(photos, requests, strict=True)]
    with ThreadPoolExecutor(3) as pool:
        parallel = list(pool.map(lambda p, r: localise(p, r, [area]), photos, requests))
    for one, other in zip(serial, parallel, strict=True):
        assert one.pose is not None
        assert other.pose is not None
        np.testing.assert_array_equal(one.pose.cam_from_local.matrix(), other.pose.cam_from_local.matrix())
        np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)


def test_a_database_serves_its_active_maps_only(
    tmp_path: Path, field_map: FeatureMap, photo: NDArray[np.uint8]
) -> None:
    """Retired and quarantined maps answer nothing; unchanged areas are taken over; map_ids restrict."""
    database = Database.create(str(tmp_path / "db"))
    far = moved(field_map, "far", 3000.0)
    elsewhere = replace(moved(field.planar_map(5), "elsewhere", -3000.0), status="active")
    for feature_map in (field_map, elsewhere, moved(far, "held", 6000.0).with_status("quarantined")):
        database.commit_map(feature_map)
    first = Localiser.open(database)
    assert sorted(m.map_id for a in first.areas for m in a.area.maps) == ["elsewhere", "field"]
    result = first.localise(photo, KNOWN)
    assert pose_errors(result, POSE)[0] < 0.05
    assert result.snapshot == first.snapshot
    assert first.localise(photo, replace(KNOWN, map_ids=("elsewhere",))).pose is None
    only = first.localise(photo, replace(KNOWN, map_ids=("field",)))
    assert only.pose is not None
    assert only.pose.map_ids == ("field",)
    assert first.localise(photo, replace(KNOWN, map_ids=("fi",))).pose is not None  # first letters are enough
    for wrong in ("nowhere", "held"):
        with pytest.raises(MapNotFoundError, match=wrong):
            first.localise(photo, replace(KNOWN, map_ids=(wrong,)))

    database.commit_map(far)
    second = Localiser.open(database, previous=first)
    kept = {id(a.area) for a in first.areas}
    assert sum(id(a.area) in kept for a in second.areas) == 2
    assert len(second.areas) == 3
    assert second.localise(photo, KNOWN).reason == "AMBIGUOUS"
    assert first.localise(photo, KNOWN).reason is None  # a snapshot stays as it was

    database.retire("field", "moved away")
    third = Localiser.open(database, previous=second)
    assert sorted(m.map_id for a in third.areas for m in a.area.maps) == ["elsewhere", "far"]
    assert third.localise(photo, KNOWN).pose is not None
    upright = LocaliseOptions(extractor=ExtractorOptions(upright=True))
    with pytest.raises(IncompatibleExtractorError, match="again with this version"):
        Localiser.open(database, upright, previous=third).localise(photo, KNOWN)


def test_naming_maps_of_an_area_builds_nothing_and_leaves_the_others_out(
    tmp_path: Path, field_map: FeatureMap, photo: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with voting over an index of many lists, and for the lenses that maps lend."""
    database = Database.create(tmp_path / "db")
    beside = moved(field_map, "beside", 100.0)
    loose = moved(field_map, "loose", 9000.0).with_status("quarantined")
    by_gps = replace(loose, placement=replace(loose.placement, method="gps"))
    for feature_map in (field_map, replace(beside, camera_keys=("its own",)), by_gps):
        database.commit_map(feature_map)
    options = LocaliseOptions(candidates=CandidateOptions(single_cluster_points=1))
    localiser = Localiser.open(database, options)
    (both,) = localiser.areas
    assert localiser.localise(photo, KNOWN).reason == "AMBIGUOUS"
    assert localiser.localise(photo, replace(KNOWN, map_ids=("loose",))).pose is not None

    def built(*_: object) -> None:
        raise AssertionError("something was built for a query")

    monkeypatch.setattr("reloc.localise.candidates.build_area", built)
    monkeypatch.setattr("reloc.localiser.segment_of", built)
    for named, east_m in (("field", 0.0), ("beside", 100.0), ("loose", 9000.0)):
        pose = localiser.localise(photo, replace(KNOWN, map_ids=(named,))).pose
        assert pose is not None
        assert pose.map_ids == (named,)
        assert pose.utm[0] == pytest.approx(EASTING + east_m + POSE.center[0], abs=0.1)
    (one,) = localiser.areas_of(("field",))
    assert both.area.camera_for_key("its own") is not None
    assert one.area.camera_for_key("its own") is None
    assert set(one.area.map_of(one.area.searched_points())) == {0}


def test_a_map_in_quarantine_that_positions_placed_answers_where_it_is_named(
    tmp_path: Path, field_map: FeatureMap, photo: NDArray[np.uint8]
) -> None:
    by_gps = replace(field_map.placement, method="gps")
    database = Database.create(tmp_path / "db")
    database.commit_map(replace(field_map, placement=by_gps, status="quarantined"))
    localiser = Localiser.open(database)
    refused = localiser.localise(photo, KNOWN)
    assert refused.reason == "NO_COVERAGE"
    assert refused.detail == "no map is active; maps in quarantine answer only where they are named, field"
    named = localiser.localise(photo, replace(KNOWN, map_ids=("field",)))
    assert named.pose is not None
    assert [entry.map_id for entry in named.pose.lineage] == ["field"]


def test_a_map_in_quarantine_that_maps_placed_answers_nobody(
    tmp_path: Path, field_map: FeatureMap, photo: NDArray[np.uint8]
) -> None:
    database = Database.create(tmp_path / "db")
    database.commit_map(field_map)
    grown = replace(
        field.planar_map(map_id="grown"),
        placement=replace(field_map.placement, method="map"),
        parents=("field",),
        generation=1,
        status="quarantined",
    )
    database.commit_map(grown)
    with pytest.raises(MapNotFoundError, match="grown"):
        Localiser.open(database).localise(photo, replace(KNOWN, map_ids=("grown",)))
