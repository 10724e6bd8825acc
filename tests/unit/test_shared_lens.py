"""One lens of many photos, against scenes of exact geometry with noise."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from reloc.localise.lens_prior import LensPriors, known_within, lens_of
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, refine_pose
from reloc.shared_lens import LensView, lenses_of_cameras, shared_lens
from tests.support.scenes import looking_at

WIDTH, HEIGHT = 1000, 800
TRUE = Camera(
    model="OPENCV",
    width=WIDTH,
    height=HEIGHT,
    params=(900.0, 900.5, 506.0, 395.0, -0.05, 0.02, 4e-4, -3e-4),
)


def photos(rng: np.random.Generator, count: int, camera: Camera, noise_px: float = 0.4) -> list[LensView]:
    """Views from the air of a town of low houses, each solved alone from a focal length that is 5 % off."""
    views = []
    for _ in range(count):
        points = rng.uniform([-40, -40, 0], [40, 40, 5], (900, 3))
        center = np.array([*rng.uniform(-12, 12, 2), 60.0])
        pose = looking_at(center, np.array([*rng.uniform(-8, 8, 2), 0.0]))
        pixels = camera.project(pose.act(points))
        inside = np.isfinite(pixels).all(axis=1) & ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        points = points[inside]
        pixels = pixels[inside] + rng.normal(0, noise_px, (len(points), 2))
        start = PoseHypothesis(
            cam_from_local=pose,
            camera=Camera.from_focal(WIDTH, HEIGHT, 0.95 * camera.focal_px),
            camera_source="exif",
            inliers=np.ones(len(points), dtype=bool),
            lens_prior=LensPriors().around(camera, 0.95 * camera.focal_px, LensPriors().exif_focal_rel),
        )
        alone = refine_pose(pixels, points, start, PoseOptions())
        rows = alone.inliers
        assert rows.mean() > 0.9
        views.append(
            LensView(
                pixels=pixels[rows],
                points=points[rows],
                cam_from_local=alone.cam_from_local,
                camera=alone.camera,
            )
        )
    return views


def test_many_photos_tell_the_lens_better_than_each_alone() -> None:
    rng = np.random.default_rng(0)
    views = photos(rng, 12, TRUE)
    found = shared_lens(views)
    assert found is not None
    assert found.agree.all()
    alone = np.array([v.camera.focal_px for v in views]) - 900.0
    assert abs(found.camera.params[0] - 900.0) < 0.5 * np.sqrt(np.mean(alone**2))
    off = (np.array(found.camera.params) - TRUE.params) / found.sigmas
    assert np.abs(off).max() < 4.0
    # The true lens is within what is said of it, and that is not merely wide.
    assert found.sigmas[0] < 1.5


def test_the_sigmas_hold_over_many_draws() -> None:
    squared = []
    for seed in range(8):
        found = shared_lens(photos(np.random.default_rng(100 + seed), 4, TRUE))
        assert found is not None
        squared.append(((found.camera.params[0] - 900.0) / found.sigmas[0]) ** 2)
    # The scale that covers correlated pixels makes independent ones look better than they are.
    assert 0.02 < np.mean(squared) < 2.0


@pytest.mark.parametrize("seed", range(4))
def test_photos_of_one_lens_agree_on_a_map_that_is_not_exact(seed: int) -> None:
    """Neighbouring points are off together, by as much as real maps' are."""
    rng = np.random.default_rng(seed)
    bent = []
    for view in photos(rng, 10, TRUE):
        waves = np.sin(view.points @ rng.normal(0.0, 0.06, (3, 3)) + rng.uniform(0.0, 6.0, 3))
        bent.append(replace(view, points=view.points + 0.1 * waves))
    found = shared_lens(bent)
    assert found is not None
    assert found.agree.all()
    assert abs(found.camera.params[0] - 900.0) < 3.0 * found.sigmas[0]


def test_a_photo_of_another_lens_is_left_out() -> None:
    rng = np.random.default_rng(1)
    other = Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=(990.0, 990.0, *TRUE.params[2:]))
    views = photos(rng, 6, TRUE)
    stranger = photos(rng, 1, other)[0]
    found = shared_lens([*views[:2], stranger, *views[2:]])
    assert found is not None
    np.testing.assert_array_equal(found.agree, [True, True, False, True, True, True, True])
    assert found.camera.params[0] == pytest.approx(900.0, abs=2.0)


def test_a_photo_that_contradicts_its_cameras_lens_is_not_asked_with_it() -> None:
    rng = np.random.default_rng(5)
    other = Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=(990.0, 990.0, *TRUE.params[2:]))
    (stranger,) = photos(rng, 1, other)
    views = [*photos(rng, 3, TRUE), stranger, None, *photos(rng, 2, other)]
    lenses, asked_with = lenses_of_cameras(["a", "a", "a", "a", "a", "b", "b"], views)
    assert list(lenses) == ["a"]
    assert [lens is not None for lens in asked_with] == [True] * 3 + [False] * 4
    assert asked_with[0] == lenses["a"].as_request()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_photos_have_no_lens_in_common(count: int) -> None:
    assert shared_lens(photos(np.random.default_rng(2), count, TRUE)) is None


def test_photos_that_all_disagree_have_none() -> None:
    rng = np.random.default_rng(3)
    views = []
    for focal in (700.0, 900.0, 1150.0):
        camera = Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=(focal, focal, *TRUE.params[2:]))
        views += photos(rng, 1, camera)
    assert shared_lens(views) is None


def test_a_known_lens_is_kept_within_its_sigmas_and_no_closer() -> None:
    """Exact where it is said to be, free where it is not; poses profit from the first."""
    rng = np.random.default_rng(4)
    (view,) = photos(rng, 1, TRUE)
    start = PoseHypothesis(
        cam_from_local=view.cam_from_local,
        camera=TRUE,
        camera_source="request",
        inliers=np.ones(len(view.pixels), dtype=bool),
    )
    for sigmas, within in ((np.zeros(8), 1e-3), (np.full(8, 1e-9), 1e-3)):
        tight = PoseHypothesis(
            **{f: getattr(start, f) for f in ("cam_from_local", "camera", "camera_source", "inliers")},
            lens_prior=known_within(TRUE, sigmas),
        )
        found = refine_pose(view.pixels, view.points, tight, PoseOptions())
        np.testing.assert_allclose(lens_of(found.camera), lens_of(TRUE), atol=within)
    wrong = Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=(880.0, 880.0, *TRUE.params[2:]))
    loose = PoseHypothesis(
        cam_from_local=view.cam_from_local,
        camera=wrong,
        camera_source="request",
        inliers=start.inliers,
        lens_prior=known_within(wrong, np.array([20.0, 20.0, 1, 1, 1e-3, 1e-3, 1e-5, 1e-5])),
    )
    found = refine_pose(view.pixels, view.points, loose, PoseOptions())
    assert found.camera.focal_px == pytest.approx(900.0, abs=8.0)


def test_sigmas_are_of_the_models_parameters() -> None:
    simple = Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=(900.0, 500.0, 400.0, 0.01))
    np.testing.assert_allclose(
        known_within(simple, np.array([2.0, 3.0, 4.0, 0.1])).sigma, [2.0, 3.0, 4.0, 0.1]
    )
    whole = known_within(TRUE, np.array([2.0, 2.0, 3.0, 4.0, 0.1, 0.2, 0.3, 0.4])).sigma
    np.testing.assert_allclose(whole, [2.0, 3.0, 4.0, 0.1, LensPriors().aspect, 0.2, 0.3, 0.4])
    with pytest.raises(InvalidValueError, match="8 sigmas"):
        known_within(TRUE, np.ones(4))
    pinhole = Camera(model="PINHOLE", width=10, height=10, params=(9.0, 9.0, 5.0, 5.0))
    with pytest.raises(InvalidValueError, match="SIMPLE_RADIAL"):
        known_within(pinhole, np.ones(4))
