"""Covariances of a reconstruction's points and poses, from the Jacobians of their observations.

Model: pixel = project(cam_from_local x) + noise, noise isotropic with the variance that the residuals show.
A point's covariance holds the cameras fixed, a pose's holds the points at their own covariance: both
are relative to the map's gauge; the placement's covariance comes on top.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew

_MAX_SIGMA_M = 1e4  # points on nearly parallel rays; keeps the matrix invertible and float32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """Every observation's residual and derivatives.

    Attributes:
        residual: (m, 2) observed minus projected, pixels.
        by_point: (m, 2, 3) derivative of the projection by the point, pixels per metre, local axes.
        by_pose: (m, 2, 6) by the left perturbation (omega, nu) of cam_from_local.
        point_of, photo_of: (m,) index of point and photo.
    """

    residual: FloatArray
    by_point: FloatArray
    by_pose: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]


def linearise(
    cameras: Sequence[Camera],
    camera_of: NDArray[np.int64],
    poses: Sequence[Rigid3],
    points: FloatArray,
    point_of: NDArray[np.int64],
    photo_of: NDArray[np.int64],
    xy: FloatArray,
) -> Linearised:
    """Residuals and Jacobians of observations xy (m, 2) of points (n, 3) in photos with poses cam_from_local.

    Args:
        camera_of: camera of each photo.
    """
    in_camera = in_cameras(poses, points, point_of, photo_of)
    camera_seen = camera_of[photo_of]
    by_camera_point = np.zeros((len(xy), 2, 3))
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(camera_seen == index)
        by_camera_point[rows] = camera.projection_jacobian(in_camera[rows])
    by_pose = np.zeros((len(xy), 2, 6))
    by_pose[:, :, :3] = -by_camera_point @ skew(in_camera)
    by_pose[:, :, 3:] = by_camera_point
    return Linearised(
        residual=xy - projected(cameras, camera_seen, in_camera),
        by_point=by_camera_point @ np.array([p.rotation for p in poses]).reshape(-1, 3, 3)[photo_of],
        by_pose=by_pose,
        point_of=point_of,
        photo_of=photo_of,
    )


def in_cameras(
    poses: Sequence[Rigid3], points: FloatArray, point_of: NDArray[np.int64], photo_of: NDArray[np.int64]
) -> FloatArray:
    """(m, 3) observed points (n, 3) in the axes of their cameras; poses are cam_from_local."""
    rotations = np.array([p.rotation for p in poses]).reshape(-1, 3, 3)
    translations = np.array([p.translation for p in poses]).reshape(-1, 3)
    turned = np.einsum("mij,mj->mi", rotations[photo_of], points[point_of])
    return np.asarray(turned + translations[photo_of])


def projected(cameras: Sequence[Camera], camera_seen: NDArray[np.int64], in_camera: FloatArray) -> FloatArray:
    """Pixels (m, 2) of points (m, 3) in the axes of the cameras (m,) that see them."""
    pixels = np.full((len(in_camera), 2), np.nan)
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(camera_seen == index)
        pixels[rows] = camera.project(in_camera[rows])
    return pixels


def residual_variance(linear: Linearised, photos: int, points: int) -> float:
    """Variance of one pixel coordinate, square pixels, with the degrees of freedom of bundle adjustment."""
    freedom = linear.residual.size - 6 * photos - 3 * points + 7
    return float((linear.residual**2).sum()) / max(freedom, 1)


def point_covariances(linear: Linearised, points: int, variance_px2: float) -> FloatArray:
    """(n, 3, 3) square metres, cameras held fixed."""
    information = np.zeros((points, 3, 3))
    np.add.at(information, linear.point_of, np.swapaxes(linear.by_point, 1, 2) @ linear.by_point)
    information += np.eye(3) * (variance_px2 / _MAX_SIGMA_M**2)
    return np.asarray(np.linalg.inv(information) * variance_px2)


def pose_covariances(
    linear: Linearised, photos: int, point_covariance: FloatArray, variance_px2: float
) -> FloatArray:
    """(k, 6, 6) of each cam_from_local's left perturbation, given points with the given covariances."""
    spread = linear.by_point @ point_covariance[linear.point_of] @ np.swapaxes(linear.by_point, 1, 2)
    weight = np.linalg.inv(spread + variance_px2 * np.eye(2))
    information = np.zeros((photos, 6, 6))
    np.add.at(information, linear.photo_of, np.swapaxes(linear.by_pose, 1, 2) @ weight @ linear.by_pose)
    return np.asarray(np.linalg.inv(information))


def upper_triangle(covariances: FloatArray) -> NDArray[np.float32]:
    """(n, 6) float32 xx, xy, xz, yy, yz, zz of (n, 3, 3)."""
    rows, columns = np.triu_indices(3)
    return covariances[:, rows, columns].astype(np.float32)
