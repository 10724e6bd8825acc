"""Flow, pose and landmarks of the tracking, each by itself."""

import cv2
import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from featuredb.simworld.camera.photograph import look_pose
from reloc.tracking.flow_track import Landmarks, follow
from reloc.tracking.options import FlowOptions
from reloc.tracking.pose_fit import fit_pose

CAMERA = Camera(model="RADIAL", width=1280, height=720, params=(970.0, 641.0, 359.0, -0.03, 0.01))
POSE = look_pose([3.0, -2.0, 50.0], 40.0, -60.0)
FLOW = FlowOptions()


def scene(rng: np.random.Generator, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Points that the camera sees, and their true pixels."""
    pixels = rng.uniform((20, 20), (1260, 700), (count, 2))
    rays = np.concatenate([CAMERA.unproject(pixels), np.ones((count, 1))], axis=1)
    points = POSE.inverse().act(rays * rng.uniform(35, 70, (count, 1)))
    return points, CAMERA.project(POSE.act(points))


def off(pose: Rigid3) -> np.ndarray:
    """(6,) rotation about the local axes (rad) and displacement (m) from POSE."""
    return np.concatenate([so3_log(pose.rotation.T @ POSE.rotation), pose.center - POSE.center])


def test_the_pose_is_found_from_nearby_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(1)
    points, pixels = scene(rng)
    pixels[:60] += rng.uniform(-80, 80, (60, 2))
    start = Rigid3.exp([0.02, -0.03, 0.05, 0.6, -0.5, 0.8]) @ POSE
    fitted = fit_pose(CAMERA, pixels, points, start)
    assert fitted is not None
    assert np.linalg.norm(off(fitted.cam_from_local)[3:]) < 0.01
    assert fitted.inlier[60:].all()
    assert fitted.inlier[:60].sum() < 5


def test_the_covariance_is_that_of_many_runs() -> None:
    """Normalised squared errors of a pose with six parameters have a mean of six."""
    rng = np.random.default_rng(2)
    points, pixels = scene(rng, 80)
    errors = []
    for _ in range(300):
        fitted = fit_pose(CAMERA, pixels + rng.normal(0, 0.3, pixels.shape), points, POSE)
        assert fitted is not None
        error = off(fitted.cam_from_local)
        errors.append(float(error @ np.linalg.solve(fitted.covariance, error)))
    assert 5.3 < np.mean(errors) < 7.0


def test_points_behind_the_camera_do_not_count() -> None:
    rng = np.random.default_rng(3)
    points, pixels = scene(rng)
    points[:30] = 2.0 * POSE.center - points[:30]
    fitted = fit_pose(CAMERA, pixels, points, POSE)
    assert fitted is not None
    assert not fitted.inlier[:30].any()
    assert fitted.inlier[30:].all()


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_points_give_no_pose(count: int) -> None:
    points, pixels = scene(np.random.default_rng(4))
    assert fit_pose(CAMERA, pixels[:count], points[:count], POSE) is None


def test_points_that_do_not_determine_a_pose_give_none() -> None:
    points, _ = scene(np.random.default_rng(4))
    along = np.linspace(0.0, 1.0, 20)[:, None]
    for few in (
        np.repeat(points[:1], 20, axis=0),
        np.repeat(points[:2], 20, axis=0),
        points[0] + along * (points[1] - points[0]),
    ):
        assert fit_pose(CAMERA, CAMERA.project(POSE.act(few)), few, POSE) is None
    # A patch of ten centimetres, fifty metres away, does.
    small = points.mean(axis=0) + np.random.default_rng(5).uniform(-0.05, 0.05, (50, 3))
    assert fit_pose(CAMERA, CAMERA.project(POSE.act(small)), small, POSE) is not None


def picture(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.standard_normal((300, 400)), (0, 0), 2.0)
    return np.clip(128 + 400 * noise, 0, 255).astype(np.uint8)


def test_patches_are_followed_where_they_went_and_lost_where_they_vanish() -> None:
    rng = np.random.default_rng(5)
    before = picture(rng)
    turn = np.float64([[0.999, -0.03, 6.4], [0.03, 0.999, -3.3]])
    after = cv2.warpAffine(before, turn, (400, 300), flags=cv2.INTER_CUBIC)
    after[:, :120] = picture(rng)[:, :120]  # something comes in between
    options = FlowOptions(window_px=51)  # at 1280 px: 17 here
    pixels = rng.uniform((30, 40), (360, 260), (150, 2))
    true = (pixels - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
    there, good = follow(before, after, pixels, pixels, options)
    hidden = true[:, 0] < 105
    assert hidden.sum() > 20
    assert good[true[:, 0] > 135].mean() > 0.95
    assert good[hidden].mean() < 0.1
    assert np.linalg.norm((there - true)[good & (true[:, 0] > 135)], axis=1).max() < 0.3


def test_nothing_to_follow_is_nothing_followed() -> None:
    frame = picture(np.random.default_rng(6))
    there, good = follow(frame, frame, np.zeros((0, 2)), np.zeros((0, 2)), FLOW)
    assert len(there) == len(good) == 0


def marks(pixels: np.ndarray, born: int, first: int = 0) -> Landmarks:
    n = len(pixels)
    return Landmarks(
        rows=np.arange(first, first + n),
        points=np.zeros((n, 3)),
        pixels=np.asarray(pixels, dtype=np.float64),
        born=np.full(n, born),
    )


def test_of_many_landmarks_those_that_are_spread_and_new_stay() -> None:
    rng = np.random.default_rng(7)
    crowd = marks(rng.uniform((0, 0), (80, 80), (500, 2)), born=1)
    lone = marks(np.array([[1000.0, 600.0], [640.0, 300.0]]), born=0, first=500)
    newer = marks(np.array([[41.0, 41.0]]), born=2, first=502)
    kept = crowd.joined(lone).joined(newer).spread(20, 16, 9, 1280, 720)
    assert len(kept) == 20
    assert {500, 501, 502} <= set(kept.rows.tolist())


def test_a_point_that_is_matched_again_has_its_new_pixel() -> None:
    old = marks(np.array([[10.0, 10.0], [20.0, 20.0]]), born=1)
    new = marks(np.array([[21.0, 22.0]]), born=5, first=1)
    joined = old.joined(new)
    assert sorted(joined.rows.tolist()) == [0, 1]
    assert joined.pixels[joined.rows == 1].tolist() == [[21.0, 22.0]]
