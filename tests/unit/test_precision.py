"""Covariances of points and poses against finite differences, simulation and pycolmap."""

import numpy as np
import pycolmap
from scipy.optimize import least_squares

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from ingest.colmap.precision import (
    Linearised,
    linearise,
    point_covariances,
    pose_covariances,
    residual_variance,
    upper_triangle,
)
from tests.support.planar_map import view

_CAMERA = Camera(
    model="OPENCV", width=1600, height=1200, params=(1400, 1390, 800, 600, 0.05, -0.02, 1e-3, -5e-4)
)
_POSES = [view(-10, -8, 45, 5, 10), view(12, 0, 47, 12, 40), view(0, 9, 44, 0, 300), view(5, -3, 50, 8, 120)]


def _scene(points: int, noise_px: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, and index of point and photo and pixel of observations in all photos."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-10, 10, (points, 2)), rng.uniform(-3, 6, points)])
    point_of = np.repeat(np.arange(points), len(_POSES))
    photo_of = np.tile(np.arange(len(_POSES)), points)
    xy = np.array(
        [_CAMERA.project(_POSES[k].act(xyz[i]))[0] for i, k in zip(point_of, photo_of, strict=True)]
    )
    return xyz, point_of, photo_of, xy + rng.normal(0, noise_px, xy.shape)


def _linear(xyz: np.ndarray, point_of: np.ndarray, photo_of: np.ndarray, xy: np.ndarray) -> Linearised:
    return linearise([_CAMERA], np.zeros(4, np.int64), _POSES, xyz, point_of, photo_of, xy)


def test_jacobians_are_derivatives_of_the_projection() -> None:
    xyz, point_of, photo_of, xy = _scene(5, 0.0, seed=0)
    linear = _linear(xyz, point_of, photo_of, xy)
    assert np.abs(linear.residual).max() < 1e-9
    step = 1e-5
    for row, (i, k) in enumerate(zip(point_of, photo_of, strict=True)):
        for axis in range(3):
            move = np.eye(3)[axis] * step
            numeric = _CAMERA.project(_POSES[k].act(xyz[i] + move)) - _CAMERA.project(
                _POSES[k].act(xyz[i] - move)
            )
            np.testing.assert_allclose(linear.by_point[row, :, axis], numeric[0] / (2 * step), atol=1e-4)
        for axis in range(6):
            move = np.eye(6)[axis] * step
            ahead, back = Rigid3.exp(move) @ _POSES[k], Rigid3.exp(-move) @ _POSES[k]
            numeric = _CAMERA.project(ahead.act(xyz[i])) - _CAMERA.project(back.act(xyz[i]))
            np.testing.assert_allclose(
                linear.by_pose[row, :, axis], numeric[0] / (2 * step), atol=2e-2, rtol=1e-5
            )


def test_point_covariance_matches_the_scatter_of_triangulations() -> None:
    """Triangulate by an independent optimiser from many noisy observations of one point."""
    xyz, point_of, photo_of, exact = _scene(1, 0.0, seed=1)
    predicted = point_covariances(_linear(xyz, point_of, photo_of, exact), 1, 0.7**2)[0]
    rng = np.random.default_rng(2)
    found = []
    for _ in range(400):
        noisy = exact + rng.normal(0, 0.7, exact.shape)

        def residual(x: np.ndarray, noisy: np.ndarray = noisy) -> np.ndarray:
            return np.concatenate(
                [_CAMERA.project(pose.act(x))[0] - o for pose, o in zip(_POSES, noisy, strict=True)]
            )

        found.append(least_squares(residual, xyz[0]).x)
    errors = np.array(found) - xyz[0]
    scores = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(predicted), errors)
    assert 2.6 < scores.mean() < 3.4  # chi-square with three degrees of freedom


def test_pose_covariance_is_pycolmaps_for_exact_points() -> None:
    """pycolmap perturbs a pose its own way; in our way it must be the same matrix."""
    xyz, point_of, photo_of, xy = _scene(60, 0.0, seed=3)
    linear = _linear(xyz, point_of, photo_of, xy)
    ours = pose_covariances(linear, 4, np.zeros((60, 3, 3)), 1.0)[1]
    rows = photo_of == 1
    pose = pycolmap.Rigid3d(_POSES[1].matrix()[:3])
    answer = pycolmap.refine_absolute_pose(
        pose,
        xy[rows],
        xyz[point_of[rows]],
        np.ones(rows.sum(), bool),
        _CAMERA.to_pycolmap(),
        return_covariance=True,
    )
    theirs = np.asarray(answer["covariance"])
    # Ours perturbs the whole pose from the left, t -> t + omega x t + nu. pycolmap rotates and moves apart,
    # and its rotation is Ceres' tangent of a quaternion, half the angle: omega = 2 delta.
    turn = 2.0 * np.eye(3)
    ours_from_theirs = np.block([[turn, np.zeros((3, 3))], [skew(_POSES[1].translation) @ turn, np.eye(3)]])
    expected = ours_from_theirs @ theirs @ ours_from_theirs.T
    np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-9)


def test_uncertain_points_make_poses_uncertain() -> None:
    xyz, point_of, photo_of, xy = _scene(60, 0.0, seed=4)
    linear = _linear(xyz, point_of, photo_of, xy)
    exact = pose_covariances(linear, 4, np.zeros((60, 3, 3)), 1.0)
    vague = pose_covariances(linear, 4, np.tile(np.eye(3) * 0.5**2, (60, 1, 1)), 1.0)
    # Half a metre at 45 m and 1400 px is some 15 px, against one pixel of noise.
    ratio = np.sqrt(vague[0, 5, 5] / exact[0, 5, 5])
    assert 8 < ratio < 20


def test_residual_variance_counts_the_degrees_of_freedom() -> None:
    xyz, point_of, photo_of, xy = _scene(200, 0.8, seed=5)
    linear = _linear(xyz, point_of, photo_of, xy)
    # Nothing was fitted here, so all residuals are noise; the divisor is what is tested.
    expected = (linear.residual**2).sum() / (2 * 800 - 3 * 200 - 6 * 4 + 7)
    assert residual_variance(linear, 4, 200) == expected


def test_upper_triangle_has_the_order_of_the_map() -> None:
    matrix = np.array([[[1.0, 2, 3], [2, 4, 5], [3, 5, 6]]])
    np.testing.assert_array_equal(upper_triangle(matrix), [[1, 2, 3, 4, 5, 6]])
