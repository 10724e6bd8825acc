"""New photos, each localised by the maps by itself: poses, threads, geotags, lenses, corroboration."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

import ingest.growth.place.localised as localised_module
from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapObservations
from ingest.growth.place.localised import (
    localise_photo,
    localise_photos,
    share_shown,
    with_lens,
)
from ingest.growth.place.refine import pose_by_lens
from ingest.growth.trust.confirmation import NewPhotos as CorroboratingPhotos
from ingest.growth.trust.confirmation import Sources, corroborate
from ingest.growth.values import GrowthPhotos, LocalisedPhoto
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import Localised
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest
from tests.support.growth_box import DESCRIPTORS, KEY, POINTS, existing, prior, walk
from tests.support.new_photos import NewPhotos, take_photos
from tests.support.scenes import (
    CAMERA,
    indexed,
    random_descriptors,
)


@pytest.fixture(scope="module")
def area() -> IndexedArea:
    return indexed(existing())


@pytest.fixture(scope="module")
def new() -> NewPhotos:
    return take_photos(np.random.default_rng(3), POINTS, DESCRIPTORS, walk(), camera_key=KEY)


@pytest.fixture(scope="module")
def localised(new: NewPhotos, area: IndexedArea) -> dict[int, LocalisedPhoto]:
    found, reasons = localise_photos(new.given, range(len(new.photos)), [area])
    assert not reasons
    return found


def test_each_photo_is_localised_by_itself(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    for row, photo in localised.items():
        offset = photo.cam_from_local.center - new.poses[row].center
        sigma = np.sqrt(np.diag(photo.covariance)[3:])
        assert np.linalg.norm(offset) < 0.1
        assert (np.abs(offset) < 5 * sigma).all()
        # Every inlier names the point that it is: the world row of the feature, as the map's row.
        assert (new.world_of[row][photo.feature_rows] == photo.point_of).mean() > 0.99
        assert photo.map_ids == ("old",)


def test_two_threads_localise_as_one_does(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    again, reasons = localise_photos(new.given, range(len(new.photos)), [area], threads=2)
    assert not reasons
    assert list(again) == list(localised)
    for row, photo in localised.items():
        np.testing.assert_array_equal(again[row].feature_rows, photo.feature_rows)
        np.testing.assert_array_equal(again[row].covariance, photo.covariance)


def test_what_a_photo_sees_of_a_map_is_asked_once(new: NewPhotos) -> None:
    """Photos of another owner, whose word counts, see the map; the second time the answers are the same."""
    photos = [replace(photo, contributor="somebody") for photo in new.photos]
    given = GrowthPhotos(photos=photos, features_of=new.features_of)
    asked = CorroboratingPhotos(given=given, rows=range(len(photos)), localised={})
    here, sources = existing(), Sources(trusted=("somebody",))
    first = corroborate(here, [], asked, sources, write_id="w1")
    assert {w.name for w in first} == {photo.name for photo in photos}
    assert set(asked.heard) == {("w1", row) for row in range(len(photos))}
    asked.heard.update(dict.fromkeys(asked.heard, None))
    assert not corroborate(here, [], asked, sources, write_id="w1")
    # Written anew, the map may show something else.
    assert corroborate(here, [], asked, sources, write_id="w2")


def test_photos_that_overlap_with_a_map_are_asked_about_it(new: NewPhotos) -> None:
    """Where the map's own photos were matched with the new ones, what matched nothing need not be asked."""
    photos = [replace(photo, contributor="somebody") for photo in new.photos]
    made_of = [replace(image, sha256=photos[0].sha256) for image in existing().images[:1]]
    here = replace(existing(), images=(*made_of, *existing().images[1:]))
    overlaps = {(0, 2), (0, 3), (1, 4)}
    given = GrowthPhotos(
        photos=photos, features_of=new.features_of, overlaps=overlaps, geometry_of=new.geometry_of
    )
    asked = CorroboratingPhotos(given=given, rows=range(1, len(photos)), localised={})
    # Other images of the map are not among the photos: nobody knows what overlaps with them.
    assert asked.that_may_see(here) == list(asked.rows)
    of_photos = replace(here, images=tuple(made_of), observations=_of_image(here, made_of[0].image_id))
    assert asked.that_may_see(of_photos) == [2, 3]
    heard = corroborate(of_photos, [], asked, Sources(trusted=("somebody",)), write_id="w1")
    assert {name for name, _ in asked.heard} == {"w1"}
    assert {row for _, row in asked.heard} == {2, 3}
    assert {w.name for w in heard} <= {photos[2].name, photos[3].name}


def _of_image(feature_map: FeatureMap, image_id: int) -> MapObservations:
    """What one image of a map sees."""
    seen = feature_map.observations
    rows = seen.image_id == image_id
    return MapObservations(**{f.name: getattr(seen, f.name)[rows] for f in fields(MapObservations)})


def test_a_pose_moves_with_its_focal_length_as_is_said(localised: dict[int, LocalisedPhoto]) -> None:
    for photo in localised.values():
        longer = replace(photo.camera, params=(1.01 * photo.camera.params[0], *photo.camera.params[1:]))
        moved = with_lens(photo, longer)
        turn = photo.cam_from_local.rotation
        expected = pose_by_lens(photo, longer)
        offset = moved.cam_from_local.center - photo.cam_from_local.center
        # Which way it goes is a matter of sign, and of no matter to a covariance.
        said = turn.T @ expected[3:]
        assert min(np.linalg.norm(offset - said), np.linalg.norm(offset + said)) < 0.15 * np.linalg.norm(said)
        assert np.linalg.norm(said) > 0.1


def test_away_from_its_geotag_a_photo_must_show_more(area: IndexedArea) -> None:
    """Half of the photo that shows the place is enough for a pose; not against the photo's own position."""
    pose = walk(1)[0]

    def found_by(gps: GeoPrior | None) -> LocalisedPhoto | str:
        new = take_photos(np.random.default_rng(5), POINTS, DESCRIPTORS, [pose], camera_key=KEY, gps=[gps])
        features = new.features_of(0).features
        shown = features.take(np.flatnonzero(features.xy[:, 0] < 0.5 * CAMERA.width))
        return localise_photo(new.photos[0], shown, [area])

    for gps in (None, prior(pose, (2.0, 1.0))):
        there = found_by(gps)
        assert isinstance(there, LocalisedPhoto), there
        assert 0.5 < share_shown(there, area.area) < 0.7
    away = found_by(prior(pose, (150.0, 0.0)))
    assert isinstance(away, str)
    assert away.startswith("CONTRADICTS_GEOTAG")


def test_a_photo_half_covered_is_refused_as_a_query_and_heard_by_growth(
    area: IndexedArea, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A query stands alone; what growth takes must agree with other photos in any case."""
    new = take_photos(np.random.default_rng(5), POINTS, DESCRIPTORS, [walk(1)[0]], camera_key=KEY)
    features = new.features_of(0).features
    shown = features.take(np.flatnonzero(features.xy[:, 0] < 0.4 * CAMERA.width))
    heard = localise_photo(new.photos[0], shown, [area])
    assert isinstance(heard, LocalisedPhoto), heard
    assert np.linalg.norm(heard.cam_from_local.center - new.poses[0].center) < 0.2
    monkeypatch.setattr(localised_module, "QUERY", LocaliseOptions())
    refused = localise_photo(new.photos[0], shown, [area])
    assert isinstance(refused, str)
    assert refused.startswith("AMBIGUOUS"), refused


def test_what_a_geotag_reaches_is_searched_once(area: IndexedArea, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strange features find nothing near their geotag, and are looked for beyond its reach only."""
    asked: list[tuple[LocaliseRequest, Localised]] = []
    honest = localised_module.localise_features

    def told(features: Features, request: LocaliseRequest, *rest: Any) -> Localised:
        asked.append((request, honest(features, request, *rest)))
        return asked[-1][1]

    monkeypatch.setattr(localised_module, "localise_features", told)
    pose = walk(1)[0]
    strange = random_descriptors(np.random.default_rng(8), len(POINTS))
    for offset, first, second in (
        ((2.0, 1.0), "TOO_FEW", "NO_COVERAGE"),
        ((5000.0, 0.0), "NO_COVERAGE", "TOO_FEW"),
    ):
        gps = prior(pose, offset)
        new = take_photos(np.random.default_rng(5), POINTS, strange, [pose], camera_key=KEY, gps=[gps])
        asked.clear()
        found = localise_photo(new.photos[0], new.features_of(0).features, [area])
        assert isinstance(found, str), found
        assert [(r.prior, r.beyond) for r, _ in asked] == [(gps, None), (None, gps)]
        for (_, outcome), reason in zip(asked, (first, second), strict=True):
            assert str(outcome.result.reason).startswith(reason)


def test_poses_are_compared_with_one_lens(new: NewPhotos, localised: dict[int, LocalisedPhoto]) -> None:
    """A longer lens stands further back; with the true lens the photo is where it was."""
    longer = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(960.0, 500.0, 400.0, 0.01))
    back = with_lens(localised[2], longer)
    assert back.camera == longer
    moved = back.cam_from_local.center - new.poses[2].center
    outward = new.poses[2].center - np.median(localised[2].points, axis=0)
    assert np.linalg.norm(moved) > 1.5
    assert moved @ outward / np.linalg.norm(moved) / np.linalg.norm(outward) > 0.9
    again = with_lens(back, CAMERA)
    assert np.linalg.norm(again.cam_from_local.center - new.poses[2].center) < 0.1
    other_size = Camera(model="SIMPLE_RADIAL", width=500, height=400, params=(450.0, 250.0, 200.0, 0.0))
    assert with_lens(localised[2], other_size) is localised[2]


def test_a_zoomed_photo_waits(area: IndexedArea) -> None:
    """An adjustment would take its lens for that of its camera."""
    zoomed = CAMERA.with_focal(1.5 * CAMERA.focal_px)
    new = take_photos(np.random.default_rng(5), POINTS, DESCRIPTORS, walk(1), camera=zoomed, camera_key=KEY)
    found = localise_photo(new.photos[0], new.features_of(0).features, [area])
    assert isinstance(found, str)
    assert found.startswith("PART_OF_PHOTO: ")
