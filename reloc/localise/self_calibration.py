"""Pose and lens together, where the lens is not known: robust least squares with priors on the intrinsics.

A photo of a nearly flat scene hardly tells focal length from height, nor a curved field from a bent lens.
The priors keep the estimate where lenses are, and the covariance says what the photo could not tell.
"""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from reloc.localise.lens_prior import QueryLensPrior, lens_of, pixel_jacobians, whole_lens, with_lens


def calibrate(
    pixels: FloatArray,
    points: FloatArray,
    start_pose: Rigid3,
    start_camera: Camera,
    prior: QueryLensPrior,
    noise_px: float,
) -> tuple[Rigid3, Camera, float]:
    """Refined cam_from_local and lens, of as many parameters as the prior has.

    Gauss-Newton with Cauchy weights; converges in a few steps from a RANSAC pose.

    Args:
        pixels, points: (k, 2), (k, 3), mostly inliers.
        noise_px: residuals of this size are normal; scale of the Cauchy loss. How much the pixels count
            against the priors follows from the residuals at the start.

    Returns:
        With them twice the logarithm of how much likelier the pixels are than at the start.

    Raises:
        InvalidValueError: the camera is of another model.
    """
    problem, camera = _problem(pixels, points, start_pose, start_camera, prior, noise_px)
    found = _minimise(problem, start_pose, camera)
    return *found, 2.0 * (problem.cost_of_pixels(start_pose, camera) - problem.cost_of_pixels(*found))


def score(
    pixels: FloatArray,
    points: FloatArray,
    pose: Rigid3,
    camera: Camera,
    prior: QueryLensPrior,
    noise_px: float,
) -> float:
    """About twice the logarithm of how much likelier `calibrate` would make all, from the first derivatives.

    Rao, Large sample tests of statistical hypotheses, 1948. Arguments as of `calibrate`.
    """
    problem, whole = _problem(pixels, points, pose, camera, prior, noise_px)
    information, gradient = problem.linearise(pose, whole)
    return float(gradient @ covariance_from_information(information) @ gradient)


def _problem(
    pixels: FloatArray,
    points: FloatArray,
    pose: Rigid3,
    camera: Camera,
    prior: QueryLensPrior,
    noise_px: float,
) -> tuple["LensProblem", Camera]:
    """With the camera as one of as many parameters as the prior has."""
    whole = with_lens(camera, whole_lens(lens_of(camera))[: len(prior.mean)])
    trust = (noise_px / measured_noise_px(pixels, points, pose, whole, noise_px)) ** 2
    return LensProblem(pixels=pixels, points=points, noise_px=noise_px, trust=trust, prior=prior), whole


def covariance_from_information(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix; what it leaves open gets a huge variance, never a small one."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse * np.outer(scale, scale), dtype=np.float64)


def measured_noise_px(
    pixels: FloatArray, points: FloatArray, pose: Rigid3, camera: Camera, noise_px: float
) -> float:
    """Deviation of one coordinate by the median residual; between a tenth and twice what is normal."""
    error = np.linalg.norm(camera.project(pose.act(points)) - pixels, axis=1)
    error = error[np.isfinite(error)]
    if len(error) == 0:
        return noise_px
    # 1.1774: median of the length of a two-dimensional unit Gaussian.
    return float(np.clip(np.median(error) / 1.1774, 0.1 * noise_px, 2.0 * noise_px))


def _minimise(problem: "LensProblem", pose: Rigid3, camera: Camera) -> tuple[Rigid3, Camera]:
    """Levenberg-Marquardt. Cauchy weights make its steps too short, so longer ones are tried too."""
    damping = 1e-4
    cost = problem.cost(pose, camera)
    for _ in range(20):
        information, gradient = problem.linearise(pose, camera)
        before = cost
        while damping < 1e6:
            # The floor keeps the matrix regular where no point says anything of a parameter.
            diagonal = np.maximum(np.diag(information), 1e-9)
            damped = information + damping * np.diag(diagonal)
            step = np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
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
class LensProblem:
    """Measurements and priors; parameters are pose (6), then the lens as in `lens_of`."""

    pixels: FloatArray
    points: FloatArray
    noise_px: float
    trust: float  # of a pixel: variance that noise_px stands for over the measured one
    prior: QueryLensPrior

    def cost(self, pose: Rigid3, camera: Camera) -> float:
        """Half the Cauchy loss in units of the noise plus half the priors' chi-square."""
        off = lens_of(camera) - self.prior.mean
        return self.cost_of_pixels(pose, camera) + 0.5 * float(np.sum(off**2 * self.prior.information))

    def cost_of_pixels(self, pose: Rigid3, camera: Camera) -> float:
        """Half the Cauchy loss in units of the noise."""
        residual = camera.project(pose.act(self.points)) - self.pixels
        squared = np.sum(residual**2, axis=1) / self.noise_px**2
        squared = np.where(np.isfinite(squared), squared, 1e6)
        return 0.5 * float(self.trust * np.log1p(squared).sum())

    def best_length(self, pose: Rigid3, camera: Camera, step: FloatArray) -> tuple[float, float]:
        """The best of the lengths 1, 2 and 4 of a step, and the cost there."""
        length, cost = 1.0, self.cost(*_step(pose, camera, step))
        for longer in (2.0, 4.0):
            longer_cost = self.cost(*_step(pose, camera, longer * step))
            if longer_cost >= cost:
                break
            length, cost = longer, longer_cost
        return length, cost

    def linearise(self, pose: Rigid3, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """Normal equations (6 + n, 6 + n) and (6 + n,) with the Cauchy weights 1 / (1 + r^2 / s^2)."""
        in_camera = pose.act(self.points)
        # The derivatives reach a little beyond the point: on the fold of the distortion there are none.
        front = (in_camera[:, 2] > 0.1) & np.isfinite(camera.project(in_camera * [1.001, 1.001, 1.0])).all(1)
        _, jacobian = pixel_jacobians(camera, pose, self.points[front], lens=True)
        residual = self.pixels[front] - camera.project(in_camera[front])
        weight = self.trust / (self.noise_px**2 + np.sum(residual**2, axis=1))
        information = np.einsum("nij,n,nik->jk", jacobian, weight, jacobian)
        gradient = np.einsum("nij,n,ni->j", jacobian, weight, residual)
        information[6:, 6:] += np.diag(self.prior.information)
        gradient[6:] += (self.prior.mean - lens_of(camera)) * self.prior.information
        return information, gradient


def _step(pose: Rigid3, camera: Camera, delta: FloatArray) -> tuple[Rigid3, Camera]:
    lens = lens_of(camera)
    moved = lens + delta[6:]
    moved[0] = np.clip(moved[0], 0.7 * lens[0], 1.4 * lens[0])  # one step's reach
    moved[4:5] = np.clip(moved[4:5], -0.5, 0.5)  # of the second focal length over the first, less one
    return pose_step(pose, delta[:6]), with_lens(camera, moved)


def pose_step(pose: Rigid3, delta: FloatArray) -> Rigid3:
    """A pose moved by a rotation and a displacement (6,) of its centre about the local axes."""
    rotation = pose.rotation @ so3_exp(delta[:3]).T
    return Rigid3(rotation=rotation, translation=-rotation @ (pose.center + delta[3:]))
