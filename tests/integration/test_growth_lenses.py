"""Lenses of photos that grow: lent by maps, shared, and told better by the existing points."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from ingest.growth.place.component import GrownMap, grow_component
from ingest.growth.place.localised import localise_photos, with_shared_lenses
from reloc.localise.candidates import IndexedArea
from tests.support.growth_box import DESCRIPTORS, KEY, POINTS, centers_error, existing, walk
from tests.support.new_photos import NewPhotos, identity, moved, take_photos
from tests.support.scenes import CAMERA, indexed


@pytest.fixture(scope="module")
def area() -> IndexedArea:
    return indexed(existing())


@pytest.fixture(scope="module")
def new() -> NewPhotos:
    return take_photos(np.random.default_rng(3), POINTS, DESCRIPTORS, walk(), camera_key=KEY)


def test_a_small_model_takes_the_maps_lens(area: IndexedArea) -> None:
    """Structure from motion of a few photos found a focal length 12 % too short; the map knows the camera."""
    poses = walk(4)
    new = take_photos(np.random.default_rng(9), POINTS, DESCRIPTORS, poses, camera_key=KEY)
    found, _ = localise_photos(new.given, range(4), [area])
    wrong = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(790.0, 500.0, 400.0, 0.03))
    bent = replace(new.model, cameras=(wrong,))
    grown = grow_component(bent, new.given, found, [area], identity())
    assert isinstance(grown, GrownMap), grown
    assert grown.model.cameras[0].focal_px == pytest.approx(CAMERA.focal_px, rel=1e-3)
    assert centers_error(grown, new).max() < 0.05


def test_a_camera_none_of_whose_photos_is_localised_takes_the_maps_lens(area: IndexedArea) -> None:
    """They hang on photos of another camera; the map knows theirs by its EXIF key all the same."""
    new = take_photos(np.random.default_rng(9), POINTS, DESCRIPTORS, walk(6), camera_key=KEY)
    found, _ = localise_photos(new.given, range(3), [area])
    assert len(found) == 3
    wrong = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(880.0, 500.0, 400.0, 0.02))
    two = replace(new.model, cameras=(CAMERA, wrong), camera_of=np.array([0, 0, 0, 1, 1, 1]))
    grown = grow_component(two, new.given, found, [area], identity())
    assert isinstance(grown, GrownMap), grown
    focals = [camera.focal_px for camera in grown.model.cameras]
    assert focals == pytest.approx([CAMERA.focal_px] * len(focals), rel=1e-3)
    assert centers_error(grown, new).max() < 0.05


@pytest.mark.parametrize(
    "real",
    [
        Camera(model="RADIAL", width=1000, height=800, params=(904.0, 500.0, 400.0, 0.03, 0.03)),
        Camera(
            model="OPENCV",
            width=1000,
            height=800,
            params=(904.0, 904.5, 501.5, 398.5, 0.03, 0.03, 3e-3, -3e-3),
        ),
    ],
    ids=["radial", "opencv"],
)
def test_existing_points_tell_a_lens_better_than_the_map_that_lent_it(
    area: IndexedArea, real: Camera
) -> None:
    """The map's lens is 0.4 % off and lacks what the photos show; every later photo would repeat it."""
    new = take_photos(
        np.random.default_rng(9), POINTS, DESCRIPTORS, walk(4), camera_key=KEY, camera=real, noise_px=0.15
    )
    found, _ = localise_photos(new.given, range(4), [area])
    assert {p.camera for p in found.values()} == {CAMERA}
    lent = replace(new.model, cameras=(CAMERA,))
    grown = grow_component(lent, new.given, found, [area], identity())
    assert isinstance(grown, GrownMap), grown
    (camera,) = grown.model.cameras
    assert camera.focal_px == pytest.approx(real.focal_px, rel=2e-3)
    at = 2 if real.model == "OPENCV" else 1
    assert camera.params[2:4] == pytest.approx(real.params[at : at + 2], abs=2.0)
    assert centers_error(grown, new).max() < 0.1  # with the lens as it was lent 0.3 m


def test_lone_photos_of_one_camera_have_one_lens(new: NewPhotos, area: IndexedArea) -> None:
    """One of them came with a focal length a quarter too long and stands as much farther away."""
    found, _ = localise_photos(new.given, range(3), [area])
    long = CAMERA.with_focal(1.25 * CAMERA.focal_px)
    pose = found[1].cam_from_local
    back = pose.center + 0.25 * (pose.center - np.median(found[1].points, axis=0))
    off = replace(found[1], camera=long, cam_from_local=moved(pose, back - pose.center))
    given = {**found, 1: off}
    one = with_shared_lenses(given, dict.fromkeys(range(3), "unnamed"))
    assert {p.camera for p in one.values()} == {CAMERA}
    assert np.linalg.norm(one[1].cam_from_local.center - new.poses[1].center) < 0.1
    assert one[0] is found[0]
    apart = with_shared_lenses(given, {0: "a", 1: "b", 2: "a"})
    assert apart[1] is off
