"""Pose and lens together, where the lens is not known: robust least squares with priors on the intrinsics.

A photo of a nearly flat scene hardly tells focal length from height, nor a curved field from a bent lens.
The priors keep the estimate where lenses are, and the covariance says what the photo could not tell.
"""

from dataclasses import dataclass

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from reloc.jacobians import chain_to_pose


@dataclass(frozen=True, slots=True, kw_only=True)
class LensPriors:
    """Standard deviations of what is known of a lens before the photo is looked at.

    Attributes:
        exif_focal_rel: EXIF focal lengths of well-behaved cameras are within 1 to 3 %, by rounding of the
            35 mm equivalent mostly; wide, because cropped pictures and video-like modes miss by tens of
            percent, and one photo alone has to get away from that.
        unknown_focal_rel: without EXIF: a factor of two either way.
        radial: k1 of consumer lenses is within a few hundredths, phones' wide lenses up to 0.1.
        center_rel: principal points of consumer cameras lie within 1 % of the longer side of the middle.
    """

    exif_focal_rel: float = 0.15
    unknown_focal_rel: float = 0.7
    radial: float = 0.04
    center_rel: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibrated:
    """Pose and camera together.

    Attributes:
        lens_information: (4,) inverse variances of what was known beforehand of focal length, principal point
            and radial distortion, in the order of the camera's parameters.
    """

    cam_from_local: Rigid3
    camera: Camera
    lens_information: FloatArray


def calibrate(
    pixels: FloatArray,
    points: FloatArray,
    start_pose: Rigid3,
    start_camera: Camera,
    prior_focal_px: float,
    focal_sigma_rel: float,
    noise_px: float,
    priors: LensPriors,
) -> Calibrated:
    """Refine pose, focal length, radial distortion and principal point of a SIMPLE_RADIAL camera.

    Gauss-Newton with Cauchy weights; converges in a few steps from a RANSAC pose.

    Args:
        pixels, points: (k, 2), (k, 3), mostly inliers.
        noise_px: residuals of this size are normal; scale of the Cauchy loss. How much the pixels count
            against the priors follows from the residuals at the start.

    Raises:
        InvalidValueError: the camera is not SIMPLE_RADIAL.
    """
    if start_camera.model != "SIMPLE_RADIAL":
        raise InvalidValueError(f"calibrate: expected a SIMPLE_RADIAL camera, found {start_camera.model}")
    pose, camera = start_pose, start_camera
    longer = max(camera.width, camera.height)
    prior_mean = np.array([prior_focal_px, camera.width / 2, camera.height / 2, 0.0])
    prior_sigma = np.array(
        [
            focal_sigma_rel * prior_focal_px,
            priors.center_rel * longer,
            priors.center_rel * longer,
            priors.radial,
        ]
    )
    problem = _Problem(
        pixels=pixels,
        points=points,
        noise_px=noise_px,
        trust=(noise_px / _measured_noise_px(pixels, points, pose, camera, noise_px)) ** 2,
        prior_mean=prior_mean,
        prior_sigma=prior_sigma,
    )
    pose, camera = _minimise(problem, pose, camera)
    return Calibrated(cam_from_local=pose, camera=camera, lens_information=1.0 / prior_sigma**2)


def joint_jacobians(
    camera: Camera, cam_from_local: Rigid3, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of pixels by points (k, 2, 3), and by pose and SIMPLE_RADIAL intrinsics (k, 2, 10).

    In closed form: pixel = f (1 + k r^2) (u, v) + c with (u, v) = (x, y) / z.
    """
    focal, _, _, radial = camera.params
    in_camera = cam_from_local.act(points)
    depth = in_camera[:, 2]
    uv = in_camera[:, :2] / depth[:, None]
    squared = np.sum(uv**2, axis=1)
    stretch = 1.0 + radial * squared
    by_uv = focal * (stretch[:, None, None] * np.eye(2) + 2.0 * radial * uv[:, :, None] * uv[:, None, :])
    by_camera = np.concatenate([by_uv, -by_uv @ uv[:, :, None]], axis=2) / depth[:, None, None]
    by_point, by_pose = chain_to_pose(by_camera, cam_from_local, points)
    by_focal = (stretch[:, None] * uv)[:, :, None]
    by_center = np.tile(np.eye(2), (len(points), 1, 1))
    by_radial = (focal * squared[:, None] * uv)[:, :, None]
    return by_point, np.concatenate([by_pose, by_focal, by_center, by_radial], axis=2)


def covariance_from_information(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix; what it leaves open gets a huge variance, never a small one."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse * np.outer(scale, scale), dtype=np.float64)


def _measured_noise_px(
    pixels: FloatArray, points: FloatArray, pose: Rigid3, camera: Camera, noise_px: float
) -> float:
    """Deviation of one coordinate by the median residual; between a tenth and twice what is normal."""
    error = np.linalg.norm(camera.project(pose.act(points)) - pixels, axis=1)
    error = error[np.isfinite(error)]
    if len(error) == 0:
        return noise_px
    # 1.1774: median of the length of a two-dimensional unit Gaussian.
    return float(np.clip(np.median(error) / 1.1774, 0.1 * noise_px, 2.0 * noise_px))


def _minimise(problem: "_Problem", pose: Rigid3, camera: Camera) -> tuple[Rigid3, Camera]:
    """Levenberg-Marquardt. Cauchy weights make its steps too short, so longer ones are tried too."""
    damping = 1e-4
    cost = problem.cost(pose, camera)
    for _ in range(20):
        system = problem.linearise(pose, camera)
        before = cost
        while damping < 1e6:
            # The floor keeps the matrix regular where no point says anything of a parameter.
            diagonal = np.maximum(np.diag(system.information), 1e-9)
            step: FloatArray = np.linalg.solve(
                system.information + damping * np.diag(diagonal), system.gradient
            ).astype(np.float64)
            length, moved = problem.best_length(pose, camera, step)
            if moved < cost:
                pose, camera = _step(pose, camera, length * step)
                cost, damping = moved, max(0.3 * damping, 1e-10)
                break
            damping *= 10.0
        if before - cost < 1e-7 * before:
            break
    return pose, camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _System:
    """Normal equations of one Levenberg-Marquardt step: (10, 10) and (10,)."""

    information: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Measurements and priors; parameters are pose (6) then focal, centre x, centre y, radial."""

    pixels: FloatArray
    points: FloatArray
    noise_px: float
    trust: float  # of a pixel: variance that noise_px stands for over the measured one
    prior_mean: FloatArray
    prior_sigma: FloatArray

    def cost(self, pose: Rigid3, camera: Camera) -> float:
        """Half the Cauchy loss in units of the noise plus half the priors' chi-square."""
        residual = camera.project(pose.act(self.points)) - self.pixels
        squared = np.sum(residual**2, axis=1) / self.noise_px**2
        squared = np.where(np.isfinite(squared), squared, 1e6)
        prior = ((np.asarray(camera.params) - self.prior_mean) / self.prior_sigma) ** 2
        return 0.5 * float(self.trust * np.log1p(squared).sum() + prior.sum())

    def best_length(self, pose: Rigid3, camera: Camera, step: FloatArray) -> tuple[float, float]:
        """The best of the lengths 1, 2 and 4 of a step, and the cost there."""
        length, cost = 1.0, self.cost(*_step(pose, camera, step))
        for longer in (2.0, 4.0):
            longer_cost = self.cost(*_step(pose, camera, longer * step))
            if longer_cost >= cost:
                break
            length, cost = longer, longer_cost
        return length, cost

    def linearise(self, pose: Rigid3, camera: Camera) -> _System:
        """Gauss-Newton with the Cauchy weights 1 / (1 + r^2 / s^2)."""
        in_camera = pose.act(self.points)
        # The derivatives reach a little beyond the point: on the fold of the distortion there are none.
        front = (in_camera[:, 2] > 0.1) & np.isfinite(camera.project(in_camera * [1.001, 1.001, 1.0])).all(1)
        _, jacobian = joint_jacobians(camera, pose, self.points[front])
        residual = self.pixels[front] - camera.project(in_camera[front])
        weight = self.trust / (self.noise_px**2 + np.sum(residual**2, axis=1))
        information = np.einsum("nij,n,nik->jk", jacobian, weight, jacobian)
        gradient = np.einsum("nij,n,ni->j", jacobian, weight, residual)
        information[6:, 6:] += np.diag(1.0 / self.prior_sigma**2)
        gradient[6:] += (self.prior_mean - np.asarray(camera.params)) / self.prior_sigma**2
        return _System(information=information, gradient=gradient)


def _step(pose: Rigid3, camera: Camera, delta: FloatArray) -> tuple[Rigid3, Camera]:
    rotation = pose.rotation @ so3_exp(delta[:3]).T
    center = pose.center + delta[3:6]
    params = np.asarray(camera.params) + delta[6:]
    params[0] = np.clip(params[0], 0.7 * camera.params[0], 1.4 * camera.params[0])  # one step's reach
    moved = Camera(model=camera.model, width=camera.width, height=camera.height, params=tuple(params))
    return Rigid3(rotation=rotation, translation=-rotation @ center), moved
