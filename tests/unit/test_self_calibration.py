"""Pose and lens together: convergence, and a covariance that holds over lenses drawn from the priors."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from reloc.localise.lens_prior import LensPriors, lens_of, pixel_jacobians, with_lens
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, pose_uncertainty, refine_pose
from reloc.localise.self_calibration import (
    calibrate,
    covariance_from_information,
)
from tests.support.scenes import box_points, looking_at

WIDTH, HEIGHT = 1000, 800
PRIORS = LensPriors()
TRUE = Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=(900.0, 506.0, 395.0, 0.03))
SLANTED = looking_at(np.array([38.0, 22.0, 33.0]), np.array([0.0, 0.0, 3.0]))
NADIR = Rigid3(rotation=np.diag([1.0, -1.0, -1.0]), translation=[0.0, 0.0, 60.0])


def deep_scene(rng: np.random.Generator, camera: Camera) -> tuple[FloatArray, FloatArray, Rigid3]:
    points = box_points(rng, 300)
    return _seen(camera, points, SLANTED), points, SLANTED


def flat_scene(rng: np.random.Generator, camera: Camera) -> tuple[FloatArray, FloatArray, Rigid3]:
    """Straight down on a plane: height and focal length are one number."""
    points = rng.uniform([-28, -22, 0], [28, 22, 0], (250, 3))
    return _seen(camera, points, NADIR), points, NADIR


def _seen(camera: Camera, points: FloatArray, pose: Rigid3) -> FloatArray:
    return camera.project(pose.act(points))


def run(
    pixels: FloatArray, points: FloatArray, start: Rigid3, focal_px: float, focal_sigma: float
) -> tuple[Rigid3, Camera]:
    camera = Camera.from_focal(WIDTH, HEIGHT, focal_px)
    return calibrate(pixels, points, start, camera, PRIORS.around(camera, focal_px, focal_sigma), 0.6)[:2]


def shifted(pose: Rigid3, metres: FloatArray, axis_angle: FloatArray) -> Rigid3:
    moved = Rigid3.exp(np.concatenate([axis_angle, np.zeros(3)])) @ pose
    return Rigid3(rotation=moved.rotation, translation=-moved.rotation @ (pose.center + metres))


@pytest.mark.parametrize("guess", [650.0, 900.0, 1300.0])
def test_a_deep_scene_tells_pose_and_lens(guess: float) -> None:
    rng = np.random.default_rng(0)
    pixels, points, pose = deep_scene(rng, TRUE)
    start = shifted(pose, np.array([2.0, -1.0, 1.5]), np.array([0.02, -0.03, 0.01]))
    found, found_camera = run(pixels, points, start, guess, 0.7)
    assert np.linalg.norm(found.center - pose.center) < 0.02
    assert found.angle_to_deg(pose) < 0.03
    assert found_camera.model == "OPENCV"
    lens = lens_of(found_camera)
    np.testing.assert_allclose(lens[0], 900.0, atol=0.5)
    np.testing.assert_allclose(lens[1:3], TRUE.params[1:3], atol=0.6)
    np.testing.assert_allclose(lens[3:], [0.03, 0.0, 0.0, 0.0, 0.0], atol=2e-3)
    known = [
        0.7 * guess,
        10,
        10,
        PRIORS.radial,
        PRIORS.aspect,
        PRIORS.second_radial,
        *[PRIORS.tangential] * 2,
    ]
    camera = Camera.from_focal(WIDTH, HEIGHT, guess)
    np.testing.assert_allclose(PRIORS.around(camera, guess, 0.7).sigma, known)
    prior = replace(PRIORS, whole_lens=False).around(camera, guess, 0.7)
    np.testing.assert_allclose(prior.sigma, known[:4])
    _, simple, _ = calibrate(pixels, points, start, camera, prior, 0.6)
    assert simple.model == "SIMPLE_RADIAL"
    np.testing.assert_allclose(simple.params, TRUE.params, atol=0.5)


def test_a_lens_with_more_than_one_coefficient_is_told_whole() -> None:
    """What one radial coefficient leaves over passes for another focal length, far beyond what is claimed."""
    rng = np.random.default_rng(8)
    lens = Camera(
        model="OPENCV",
        width=WIDTH,
        height=HEIGHT,
        params=(750.0, 751.0, 501.0, 399.0, -0.07, 0.05, 1e-3, -8e-4),
    )
    count = 3000
    off_m: dict[bool, list[float]] = {True: [], False: []}
    squared: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(10):
        points = rng.uniform([-38, -30, 0], [38, 30, 0.3], (count, 3))
        points[: count // 10, 2] = 6.0  # a few roofs, seen from above
        pixels = _seen(lens, points, NADIR) + rng.normal(0, 0.3, (count, 2))
        for whole in (True, False):
            options = replace(PoseOptions(), lens=replace(PRIORS, whole_lens=whole))
            start = PoseHypothesis(
                cam_from_local=NADIR,
                camera=Camera.from_focal(WIDTH, HEIGHT, 754.0),
                camera_source="exif",
                inliers=np.ones(count, dtype=bool),
                lens_prior=options.lens.around(lens, 754.0, PRIORS.exif_focal_rel),
            )
            found = refine_pose(pixels, points, start, options)
            rows = found.inliers
            nothing = np.zeros((int(rows.sum()), 3, 3))
            said = pose_uncertainty(pixels[rows], points[rows], nothing, found, options).covariance[3:, 3:]
            off = found.cam_from_local.center - NADIR.center
            off_m[whole].append(float(np.linalg.norm(off)))
            squared[whole].append(float(off @ np.linalg.solve(said, off)))
    assert np.mean(off_m[True]) < 0.5 * np.mean(off_m[False])
    assert np.mean(squared[True]) < 5.0  # 3 in theory
    assert np.mean(squared[False]) > 2.0 * np.mean(squared[True])


def test_wrong_matches_hardly_move_it() -> None:
    rng = np.random.default_rng(1)
    pixels, points, pose = deep_scene(rng, TRUE)
    pixels = pixels + rng.normal(0, 0.4, pixels.shape)
    clean, clean_lens = run(pixels, points, pose, 900.0, 0.15)
    pixels[:30] += rng.normal(0, 40, (30, 2))
    dirty, dirty_lens = run(pixels, points, pose, 900.0, 0.15)
    assert np.linalg.norm(dirty.center - clean.center) < 0.1
    assert dirty_lens.focal_px == pytest.approx(clean_lens.focal_px, rel=2e-3)


def test_a_flat_scene_keeps_the_prior_and_finds_the_valley_from_anywhere() -> None:
    """The data fix height over focal length only, so the prior's focal length comes back, from any start."""
    rng = np.random.default_rng(2)
    true = Camera.from_focal(WIDTH, HEIGHT, 900.0)
    pixels, points, _ = flat_scene(rng, true)
    pixels = pixels + rng.normal(0, 0.3, pixels.shape)
    for height_m, focal_px in ((40.0, 600.0), (60.0, 900.0), (90.0, 1350.0)):
        start = Rigid3(rotation=NADIR.rotation, translation=[0.0, 0.0, height_m])
        camera = Camera.from_focal(WIDTH, HEIGHT, focal_px)
        found, lens, _ = calibrate(pixels, points, start, camera, PRIORS.around(camera, 1000.0, 0.15), 0.6)
        assert lens.focal_px == pytest.approx(1000.0, rel=0.02)
        ratio = found.center[2] / lens.focal_px
        assert ratio == pytest.approx(60.0 / 900.0, rel=2e-3)


@pytest.mark.parametrize("scene", [flat_scene, deep_scene])
@pytest.mark.evaluation
def test_the_covariance_holds_over_lenses_from_the_priors(scene: object) -> None:
    """Chi-square of the six pose parameters over lenses, pixel noise and scenes: mean 6."""
    options = PoseOptions()
    rng = np.random.default_rng(3)
    values, heights, sigmas = [], [], []
    for _ in range(120):
        nominal = 900.0
        lens = Camera(
            model="SIMPLE_RADIAL",
            width=WIDTH,
            height=HEIGHT,
            params=(
                nominal * (1 + PRIORS.exif_focal_rel * float(np.clip(rng.normal(), -2.5, 2.5))),
                WIDTH / 2 + 10.0 * rng.normal(),
                HEIGHT / 2 + 10.0 * rng.normal(),
                PRIORS.radial * rng.normal(),
            ),
        )
        pixels, points, pose = scene(rng, lens)  # type: ignore[operator]
        inside = np.isfinite(pixels).all(axis=1) & ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        pixels, points = pixels[inside] + rng.normal(0, 0.4, (int(inside.sum()), 2)), points[inside]
        start = PoseHypothesis(
            cam_from_local=pose,
            camera=Camera.from_focal(WIDTH, HEIGHT, lens.focal_px),
            camera_source="exif",
            inliers=np.ones(len(points), dtype=bool),
            lens_prior=PRIORS.around(lens, nominal, PRIORS.exif_focal_rel),
        )
        wide = replace(options, tolerance_rel=0.006)
        # Start inside the tolerance whatever the distortion; how far one may start is tested above.
        found = refine_pose(pixels, points, replace(start, camera=lens), wide)
        rows = found.inliers
        assert rows.mean() > 0.97
        measured = pose_uncertainty(
            pixels[rows], points[rows], np.zeros((int(rows.sum()), 3, 3)), found, wide
        )
        moved = found.cam_from_local
        delta = np.concatenate([so3_log(pose.rotation.T @ moved.rotation), pose.center - moved.center])
        values.append(delta @ np.linalg.solve(measured.covariance, delta))
        heights.append(abs(delta[5]))
        sigmas.append(np.sqrt(measured.covariance[5, 5]))
    assert np.mean(values) == pytest.approx(6.0, rel=0.15)
    if scene is flat_scene:
        # Height is as unknown as the focal length: 15 % of 60 m; and the errors are of that size.
        assert np.median(sigmas) == pytest.approx(9.0, rel=0.15)
        assert 0.5 < np.mean(np.array(heights) < np.array(sigmas)) < 0.86
    else:
        assert np.median(sigmas) < 0.3


@pytest.mark.parametrize(
    "kind", ["none", "one", "one place", "behind", "beyond the fold", "far off", "at the camera", "line"]
)
def test_degenerate_input_comes_back_finite(kind: str) -> None:
    rng = np.random.default_rng(4)
    pixels, points, pose = deep_scene(rng, TRUE)
    camera = Camera.from_focal(WIDTH, HEIGHT, 900.0)
    if kind == "none":
        pixels, points = pixels[:0], points[:0]
    elif kind == "one":
        pixels, points = pixels[:1], points[:1]
    elif kind == "one place":
        pixels, points = np.repeat(pixels[:1], 9, axis=0), np.repeat(points[:1], 9, axis=0)
    elif kind == "behind":
        points = 2 * pose.center - points
    elif kind == "beyond the fold":
        camera = replace(camera, params=(300.0, 500.0, 400.0, -0.9))
    elif kind == "far off":
        pose = shifted(pose, np.array([500.0, 0, -400.0]), np.array([0, 2.0, 0]))
    elif kind == "at the camera":
        points = pose.center + rng.normal(0, 1e-9, points.shape)
    elif kind == "line":
        points = points[0] + np.linspace(0, 1, len(points))[:, None] * [5.0, 2.0, 1.0]
        pixels = TRUE.project(pose.act(points))
    found, lens, _ = calibrate(pixels, points, pose, camera, PRIORS.around(camera, 900.0, 0.7), 0.6)
    assert np.isfinite(found.matrix()).all()
    assert np.isfinite(lens.params).all()
    assert 0 < lens.focal_px < 1e5


@pytest.mark.parametrize(
    "camera",
    [
        replace(TRUE, params=(900.0, 506.0, 395.0, -0.2)),
        replace(TRUE, model="OPENCV", params=(900.0, 905.0, 506.0, 395.0, -0.2, 0.06, 3e-3, -2e-3)),
    ],
)
def test_closed_derivatives_against_finite_differences(camera: Camera) -> None:
    points = box_points(np.random.default_rng(6), 20)
    by_point, joint = pixel_jacobians(camera, SLANTED, points, lens=True)
    numeric_point, numeric_pose = pixel_jacobians(camera, SLANTED, points)
    np.testing.assert_allclose(by_point, numeric_point, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(joint[:, :, :6], numeric_pose, rtol=1e-5, atol=1e-3)
    lens = lens_of(camera)
    assert joint.shape[2] == 6 + len(lens)
    np.testing.assert_allclose(with_lens(camera, lens).params, camera.params)
    for i, step in enumerate((0.01, 0.01, 0.01, *[1e-5] * 5)[: len(lens)]):
        away = np.zeros(len(lens))
        away[i] = step
        ends = [with_lens(camera, lens + sign * away).project(SLANTED.act(points)) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(joint[:, :, 6 + i], expected, rtol=1e-5, atol=1e-5)


def test_other_models_are_refused() -> None:
    pinhole = Camera(model="PINHOLE", width=10, height=10, params=(9.0, 9.0, 5.0, 5.0))
    with pytest.raises(InvalidValueError, match="SIMPLE_RADIAL"):
        calibrate(np.zeros((4, 2)), np.ones((4, 3)), NADIR, pinhole, PRIORS.around(TRUE, 9.0, 0.1), 1.0)


def test_what_the_information_leaves_open_has_a_huge_variance() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(0, 1, (6, 6)) * [1, 1, 1, 1000, 1000, 1000]
    full = half.T @ half
    np.testing.assert_allclose(covariance_from_information(full) @ full, np.eye(6), atol=1e-6)
    open_direction = np.array([1.0, 2.0, -1.0, 0.5, 0.0, 0.3])
    kernel = np.linalg.svd(open_direction[None])[2][1:]
    covariance = covariance_from_information(kernel.T @ kernel)
    assert np.isfinite(covariance).all()
    assert open_direction @ covariance @ open_direction / (open_direction @ open_direction) > 1e9
    assert kernel[0] @ covariance @ kernel[0] < 1e3
    assert (np.diag(covariance_from_information(np.zeros((3, 3)))) > 1e9).all()
