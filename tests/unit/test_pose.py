"""Poses of synthetic scenes against the truth; derivatives and covariances by independent routes."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp, so3_log
from reloc.localise.lens_prior import pixel_jacobians
from reloc.localise.options import PoseOptions
from reloc.localise.pose import (
    PoseHypothesis,
    _price_of_robustness,
    estimate_pose,
    pose_uncertainty,
    refine_pose,
    refined_as_part,
    reprojection_errors,
)
from tests.support.scenes import CAMERA, box_points, looking_at, pixels_inside

OPTIONS = PoseOptions()
POSE = looking_at(np.array([38.0, 22.0, 33.0]), np.array([0.0, 0.0, 3.0]))
TRUE_LENS = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(900.0, 503.0, 396.0, 0.01))


def scene(
    seed: int, count: int, *, noise_px: float = 0.5, outliers: float = 0.0, camera: Camera = CAMERA
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (n, 2), points (n, 3), and which of the matches are true (n,)."""
    rng = np.random.default_rng(seed)
    points = box_points(rng, 3 * count)
    pixels, inside = pixels_inside(camera, POSE, points)
    points, pixels = points[inside][:count], pixels[inside][:count]
    pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    wrong = rng.random(len(pixels)) < outliers
    pixels[wrong] = rng.uniform(0, [camera.width, camera.height], (wrong.sum(), 2))
    return pixels, points, ~wrong


def errors(found: Rigid3) -> tuple[float, float]:
    """Position in metres, orientation in degrees."""
    return float(np.linalg.norm(found.center - POSE.center)), found.angle_to_deg(POSE)


@pytest.mark.parametrize("seed", range(4))
def test_a_known_lens_with_sixty_percent_outliers(seed: int) -> None:
    pixels, points, true = scene(seed, 200, outliers=0.6)
    found = estimate_pose(pixels, points, CAMERA, "request", OPTIONS)
    assert found is not None
    found = refine_pose(pixels, points, found, OPTIONS)
    position_m, angle_deg = errors(found.cam_from_local)
    assert position_m < 0.05
    assert angle_deg < 0.06
    assert (found.inliers & true).sum() > 0.95 * true.sum()
    assert (found.inliers & ~true).sum() <= 3
    assert found.camera == CAMERA
    assert found.lens_prior is None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("guess", [600.0, 1300.0])
def test_a_free_focal_length_with_outliers(seed: int, guess: float) -> None:
    pixels, points, true = scene(seed, 200, outliers=0.5, camera=TRUE_LENS)
    start = Camera.from_focal(1000, 800, guess)
    found = estimate_pose(pixels, points, start, "estimated", OPTIONS)
    assert found is not None
    found = refine_pose(pixels, points, found, OPTIONS)
    position_m, angle_deg = errors(found.cam_from_local)
    assert position_m < 0.5
    assert angle_deg < 0.5
    assert found.camera.focal_px == pytest.approx(900, rel=0.01)
    assert (found.inliers & true).sum() > 0.95 * true.sum()
    assert found.lens_prior is not None
    assert found.lens_prior.mean[0] == guess


def whole_and_part(
    seed: int, camera: Camera, noise_px: float = 0.5
) -> tuple[PoseHypothesis, PoseHypothesis | None, np.ndarray, np.ndarray]:
    """A photo whose lens nobody knows, as of a whole photo and as of a part of one, with its matches."""
    pixels, points, _ = scene(seed, 200, noise_px=noise_px, camera=camera)
    found = estimate_pose(pixels, points, Camera.from_focal(1000, 800, 1200.0), "estimated", OPTIONS)
    assert found is not None
    whole = refine_pose(pixels, points, found, OPTIONS)
    assert whole.lens_prior is not None
    return whole, refined_as_part(pixels, points, whole, whole.lens_prior, OPTIONS), pixels, points


def test_a_picture_that_was_cut_out_of_a_photo_is_placed_with_the_middle_of_its_lens() -> None:
    cut = replace(TRUE_LENS, params=(1100.0, 760.0, 290.0, 0.01))
    squared = []
    for seed in range(8):
        whole, part, pixels, points = whole_and_part(seed, cut)
        assert part is not None
        assert errors(part.cam_from_local)[0] < 0.3 * errors(whole.cam_from_local)[0]
        own = (pixels[part.inliers], points[part.inliers])
        uncertainty = pose_uncertainty(*own, np.zeros((len(own[0]), 3, 3)), part, OPTIONS)
        squared.append(normalised_squared_error(part.cam_from_local, uncertainty.covariance))
    assert np.median(squared) < 16.8  # of six: 99 %


def test_a_whole_photo_is_hardly_ever_taken_for_a_part_of_one() -> None:
    parts = [whole_and_part(seed, TRUE_LENS)[1] for seed in range(20)]
    assert sum(part is not None for part in parts) <= 4  # one of twenty is allowed; 0.3 % have more than four


def test_the_same_input_gives_the_same_pose() -> None:
    pixels, points, _ = scene(0, 150, outliers=0.5)
    for camera, source in ((CAMERA, "request"), (Camera.from_focal(1000, 800, 1200.0), "estimated")):
        one, two = (estimate_pose(pixels, points, camera, source, OPTIONS) for _ in range(2))
        assert one is not None
        assert two is not None
        np.testing.assert_array_equal(one.cam_from_local.matrix(), two.cam_from_local.matrix())
        assert one.camera == two.camera


@pytest.mark.parametrize("source", ["request", "estimated"])
@pytest.mark.parametrize(
    "kind", ["none", "few", "one place", "one pixel", "line", "noise", "behind", "huge", "duplicates"]
)
def test_degenerate_matches_give_no_pose_or_a_finite_one(source: str, kind: str) -> None:
    rng = np.random.default_rng(0)
    pixels, points, _ = scene(0, 40)
    if kind == "none":
        pixels, points = pixels[:0], points[:0]
    elif kind == "few":
        pixels, points = pixels[:7], points[:7]
    elif kind == "one place":
        points = np.repeat(points[:1], 40, axis=0)
    elif kind == "one pixel":
        pixels = np.repeat(pixels[:1], 40, axis=0)
    elif kind == "line":
        points = points[0] + np.linspace(0, 20, 40)[:, None] * [1.0, 0.5, 0.1]
        pixels = CAMERA.project(POSE.act(points))
    elif kind == "noise":
        pixels = rng.uniform(0, 800, pixels.shape)
    elif kind == "behind":
        pixels = 1000 - pixels
    elif kind == "huge":
        points = points * 1e7
    elif kind == "duplicates":
        pixels, points = np.repeat(pixels[:4], 10, axis=0), np.repeat(points[:4], 10, axis=0)
    camera = CAMERA if source == "request" else Camera.from_focal(1000, 800, 1200.0)
    found = estimate_pose(pixels, points, camera, source, OPTIONS)  # type: ignore[arg-type]
    if kind in ("none", "few"):
        assert found is None
    if found is None:
        return
    found = refine_pose(pixels, points, found, OPTIONS)
    rows = found.inliers
    if rows.sum() >= 4:
        covariances = np.tile(np.eye(3) * 1e-4, (int(rows.sum()), 1, 1))
        measured = pose_uncertainty(pixels[rows], points[rows], covariances, found, OPTIONS)
        assert np.isfinite(measured.covariance).all()
        eigenvalues = np.linalg.eigvalsh(measured.covariance)
        assert eigenvalues[0] >= -1e-9 * eigenvalues[-1]


def test_a_pose_that_points_on_a_line_leave_open_is_not_called_certain() -> None:
    """They fix neither the turn about the line nor the way around it."""
    points = np.array([-10.0, -5.0, 2.0]) + np.linspace(0, 20, 40)[:, None] * [1.0, 0.5, 0.1]
    rng = np.random.default_rng(0)
    pixels = CAMERA.project(POSE.act(points)) + rng.normal(0, 0.3, (40, 2))
    pose = PoseHypothesis(
        cam_from_local=POSE,
        camera=CAMERA,
        camera_source="request",
        inliers=np.ones(40, dtype=bool),
    )
    measured = pose_uncertainty(pixels, points, np.zeros((40, 3, 3)), pose, OPTIONS)
    assert np.sqrt(np.linalg.eigvalsh(measured.covariance[3:, 3:])[-1]) > 50.0


def test_points_behind_the_camera_are_infinitely_wrong() -> None:
    points = POSE.inverse().act(np.array([[0.0, 0, 5], [0, 0, -5], [0, 0, 0]]))
    error = reprojection_errors(np.full((3, 2), [500.0, 400.0]), points, CAMERA, POSE)
    assert error[0] == pytest.approx(0.0, abs=1e-6)
    assert (error[1:] == np.inf).all()


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        Camera(model="PINHOLE", width=1000, height=800, params=(900.0, 910.0, 500.0, 400.0)),
        Camera(
            model="OPENCV",
            width=1000,
            height=800,
            params=(900.0, 910.0, 500.0, 400.0, -0.1, 0.02, 1e-3, -1e-3),
        ),
        Camera(
            model="OPENCV_FISHEYE", width=1000, height=800, params=(700.0, 700.0, 500, 400, 0.01, 0, 0, 0)
        ),
    ],
    ids=lambda camera: camera.model,
)
def test_jacobians_against_the_perturbation_they_promise(camera: Camera) -> None:
    """R_true = exp(dtheta) R and C_true = C + dC of local_from_cam, composed and projected."""
    points = box_points(np.random.default_rng(1), 12)
    by_point, by_pose = pixel_jacobians(camera, POSE, points)
    local_from_cam = POSE.inverse()
    step = 1e-6
    for axis in range(6):
        ends = []
        for sign in (1, -1):
            delta = np.zeros(6)
            delta[axis] = sign * step
            moved = Rigid3(
                rotation=so3_exp(delta[:3]) @ local_from_cam.rotation,
                translation=local_from_cam.translation + delta[3:],
            )
            ends.append(camera.project(moved.inverse().act(points)))
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(by_pose[:, :, axis], expected, rtol=1e-4, atol=2e-3)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = 1e-5
        expected = (
            camera.project(POSE.act(points + offset)) - camera.project(POSE.act(points - offset))
        ) / 2e-5
        np.testing.assert_allclose(by_point[:, :, axis], expected, rtol=1e-4, atol=1e-3)


def normalised_squared_error(found: Rigid3, covariance: np.ndarray) -> float:
    """Squared error of the pose against POSE, in units of the covariance's axes (rotation, centre)."""
    delta = np.concatenate([so3_log(POSE.rotation.T @ found.rotation), POSE.center - found.center])
    return float(delta @ np.linalg.solve(covariance, delta))


@pytest.mark.parametrize(("noise_px", "tolerance_rel"), [(0.3, 0.01), (1.5, 0.01), (0.5, 0.0025)])
def test_the_covariance_is_that_of_the_errors(noise_px: float, tolerance_rel: float) -> None:
    """Pixel noise unknown to it, and points wrong by their own covariance: the mean of chi-square is 6."""
    options = replace(OPTIONS, tolerance_rel=tolerance_rel)
    rng = np.random.default_rng(5)
    sigma_m = np.array([0.02, 0.02, 0.05])
    values = []
    for _ in range(300):
        points = box_points(rng, 60)
        pixels, inside = pixels_inside(CAMERA, POSE, points)
        points, pixels = points[inside], pixels[inside]
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
        # Points share the scale of the pixel noise, which one factor is measured for.
        mapped = points + rng.normal(0, 1, points.shape) * sigma_m * noise_px
        start = PoseHypothesis(
            cam_from_local=POSE,
            camera=CAMERA,
            camera_source="request",
            inliers=np.ones(len(points), dtype=bool),
        )
        found = refine_pose(pixels, mapped, start, options)
        rows = found.inliers
        covariances = np.tile(np.diag(sigma_m**2), (int(rows.sum()), 1, 1))
        measured = pose_uncertainty(pixels[rows], mapped[rows], covariances, found, options)
        values.append(normalised_squared_error(found.cam_from_local, measured.covariance))
    assert np.mean(values) == pytest.approx(6.0, rel=0.12)


def test_price_of_the_robust_loss_is_the_ratio_of_the_variances_that_both_estimates_have() -> None:
    rng = np.random.default_rng(5)

    def residuals(samples: int, size: int) -> np.ndarray:
        sigma = np.where(rng.random((samples, size, 1)) < 0.85, 0.2, 1.2)
        return rng.normal(size=(samples, size, 2)) * sigma

    drawn = residuals(3000, 150)
    robust = np.zeros((3000, 1, 2))
    for _ in range(40):  # a location by reweighting, Cauchy loss of scale 1
        weight = 1.0 / (1.0 + np.sum((drawn - robust) ** 2, axis=2, keepdims=True))
        robust = np.sum(weight * drawn, axis=1, keepdims=True) / np.sum(weight, axis=1, keepdims=True)
    ratio = np.var(robust) / np.var(drawn.mean(axis=1))
    assert ratio < 0.6
    assert _price_of_robustness(residuals(1, 100_000)[0], 1.0, 2) == pytest.approx(ratio, rel=0.08)


def test_price_of_the_robust_loss_on_gaussian_residuals_is_above_one_and_close_to_it() -> None:
    narrow = np.random.default_rng(6).normal(0.0, 0.3, (100_000, 2))
    assert 1.0 < _price_of_robustness(narrow, 1.0, 6) < 1.1
