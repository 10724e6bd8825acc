"""The pose of a frame from pixels of known points: Gauss-Newton with a Cauchy loss, fast enough for video."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.tracking.options import FitOptions

_STILL = 1e-6  # radians, and metres over distance: a thousandth of a pixel
# Least eigenvalue of scaled normal equations that have no one solution: one or two points over and over and
# points on a line have 2e-15 and less; a patch of 10 cm, seen from 50 m, still has 2e-7.
_SINGULAR = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedPose:
    """A pose and how well it is known.

    Attributes:
        cam_from_local: the pose.
        inlier: (n,) bool, pixels within the tolerance.
        residual_px: (n, 2) of all.
        covariance: (6, 6) of the camera's rotation about the local axes (rad) before the displacement of its
            centre (m), as in `reloc.result`; of independent pixels, scaled by their residuals.
    """

    cam_from_local: Rigid3
    inlier: NDArray[np.bool_]
    residual_px: FloatArray
    covariance: FloatArray


def fit_pose(
    camera: Camera, pixels: FloatArray, points: FloatArray, start: Rigid3, options: FitOptions
) -> FittedPose | None:
    """Fit the pose to pixels (n, 2) of points (n, 3); None where the points do not determine it.

    Args:
        start: a pose within some degrees and a few per cent of the distance.
    """
    if len(pixels) < 4:
        return None
    scale = max(camera.width, camera.height) / options.reference_side_px
    seen = camera.unproject(pixels)
    focal, loss = camera.focal_px, options.loss_px * scale
    pose = start
    depth = max(float(np.median(start.act(points)[:, 2])), 1e-6)
    still = np.repeat([1.0, 1.0 / depth], 3)
    for _ in range(options.iterations):
        residual, jacobian = _linearised(pose, points, seen, focal)
        squared = np.einsum("ij,ij->i", residual, residual)
        weight = np.where(np.isfinite(squared), 1.0 / (1.0 + squared / loss**2), 0.0)
        weighted = jacobian * weight[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, jacobian)
        gradient = np.einsum("nki,nk->i", weighted, np.nan_to_num(residual))
        if not _is_determined(normal):
            return None
        step = -np.linalg.solve(normal, gradient)
        pose = Rigid3.exp(step) @ pose
        if np.abs(step * still).max() < _STILL:
            break
    residual, jacobian = _linearised(pose, points, seen, focal)
    distance = np.sqrt(np.einsum("ij,ij->i", residual, residual))
    inlier = np.asarray(distance < options.tolerance_px * scale)
    if inlier.sum() < 4:
        return None
    variance = np.einsum("ij,ij->", residual[inlier], residual[inlier]) / max(2 * inlier.sum() - 6, 1)
    normal = np.einsum("nki,nkj->ij", jacobian[inlier], jacobian[inlier])
    if not _is_determined(normal):
        return None
    covariance = np.linalg.inv(normal) * max(float(variance), 1e-4)
    return FittedPose(
        cam_from_local=pose,
        inlier=inlier,
        residual_px=residual,
        covariance=of_camera(pose, covariance),
    )


def _is_determined(normal: FloatArray) -> bool:
    """Whether normal equations (6, 6) have one solution, whatever the units of its parts.

    LAPACK finds a matrix singular only where a pivot is exactly zero, which depends on the processor.
    """
    scale = np.sqrt(np.diag(normal))
    if not (np.isfinite(normal).all() and scale.all()):
        return False
    return bool(np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] > _SINGULAR)


def _linearised(
    pose: Rigid3, points: FloatArray, seen: FloatArray, focal: float
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 2) in pixels and derivatives (n, 2, 6) by the pose's left perturbation.

    Points behind the camera have residuals of infinity and no derivatives.
    """
    x, y, z = pose.act(points).T
    front = z > 1e-6
    inverse = np.where(front, 1.0 / np.where(front, z, 1.0), 0.0)
    u, v = x * inverse, y * inverse
    jacobian = np.zeros((len(z), 2, 6))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = -u * v, 1.0 + u * u, -v
    jacobian[:, 0, 3], jacobian[:, 0, 5] = inverse, -u * inverse
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = -(1.0 + v * v), u * v, u
    jacobian[:, 1, 4], jacobian[:, 1, 5] = inverse, -v * inverse
    jacobian *= (focal * front)[:, None, None]
    residual = np.empty((len(z), 2))
    residual[:, 0], residual[:, 1] = focal * (u - seen[:, 0]), focal * (v - seen[:, 1])
    residual[~front | ~np.isfinite(seen).all(axis=1)] = np.inf
    return residual, jacobian


def of_camera(pose: Rigid3, covariance: FloatArray) -> FloatArray:
    """From the left perturbation of cam_from_local to a rotation about local axes and a moved centre.

    cam_from_local' = exp(xi) cam_from_local: the camera turns by -R^T omega about the local axes, and its
    centre moves by -R^T nu.
    """
    turn = np.kron(np.eye(2), -pose.rotation.T)
    return np.asarray(turn @ covariance @ turn.T, dtype=np.float64)
