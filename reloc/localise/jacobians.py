"""Derivatives of pixels by points and pose, through any camera model."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3


def pixel_jacobians(
    camera: Camera, cam_from_local: Rigid3, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the pixels of points (k, 3), in front of the camera.

    Returns:
        By the points (k, 2, 3), and by the pose (k, 2, 6): a small rotation of the camera about the local
        axes (rad), then a displacement of its centre (m): R_true = R(dtheta) R, C_true = C + dC for
        local_from_cam = (R, C).
    """
    by_camera = camera.projection_jacobian(cam_from_local.act(points))
    return chain_to_pose(by_camera, cam_from_local, points)


def chain_to_pose(
    by_camera: FloatArray, cam_from_local: Rigid3, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives as in `pixel_jacobians` from those by the points in camera axes, `by_camera` (k, 2, 3)."""
    by_point = by_camera @ cam_from_local.rotation
    x, y, z = (points - cam_from_local.center).T
    zero = np.zeros_like(x)
    crosses = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return by_point, np.concatenate([by_point @ crosses, -by_point], axis=2)
