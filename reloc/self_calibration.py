"""Pose and lens together, where the lens is not known: robust least squares with priors on the intrinsics.

A photo of a nearly flat scene hardly tells focal length from height, nor a curved field from a bent lens.
The priors keep the estimate where lenses are, and the covariance says what the photo could not tell.
"""

from dataclasses import dataclass, replace

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
        whole_lens: OPENCV's parameters are estimated, and not SIMPLE_RADIAL's alone. What a lens has beyond
            one radial coefficient leaves a pattern that passes for another focal length, and the covariance
            knows nothing of it: photos of a drone's lens had errors of 0.39 m at the median and 3.2 m at
            most, their squared normalised errors a mean of 66 where 3 is right; with whole lenses 0.17 m,
            0.6 m and 2.6 (`tools/video_map.py`).
        second_radial, tangential, aspect: k2; p1 and p2; the second focal length over the first, less one.
    """

    exif_focal_rel: float = 0.15
    unknown_focal_rel: float = 0.7
    radial: float = 0.04
    center_rel: float = 0.01
    whole_lens: bool = True
    second_radial: float = 0.04
    tangential: float = 0.001
    aspect: float = 0.001


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibrated:
    """Pose and camera together.

    Attributes:
        lens_information: (4,) or (8,) inverse variances of what was known beforehand of the lens, in the
            order of `lens_of`.
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
    """Refine pose and lens: OPENCV's parameters, or SIMPLE_RADIAL's where the priors say so.

    Gauss-Newton with Cauchy weights; converges in a few steps from a RANSAC pose.

    Args:
        pixels, points: (k, 2), (k, 3), mostly inliers.
        noise_px: residuals of this size are normal; scale of the Cauchy loss. How much the pixels count
            against the priors follows from the residuals at the start.

    Raises:
        InvalidValueError: the camera is of another model.
    """
    pose, count = start_pose, 8 if priors.whole_lens else 4
    camera = _with_lens(start_camera, _whole(lens_of(start_camera))[:count])
    longer = max(camera.width, camera.height)
    prior_mean = np.array([prior_focal_px, camera.width / 2, camera.height / 2, 0.0, 0.0, 0.0, 0.0, 0.0])[
        :count
    ]
    prior_sigma = np.array(
        [
            focal_sigma_rel * prior_focal_px,
            priors.center_rel * longer,
            priors.center_rel * longer,
            priors.radial,
            priors.aspect,
            priors.second_radial,
            priors.tangential,
            priors.tangential,
        ]
    )[:count]
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


def lens_of(camera: Camera) -> FloatArray:
    """Parameters of a lens, (4,) of SIMPLE_RADIAL or (8,) of OPENCV: f, cx, cy, k1, aspect, k2, p1, p2.

    Raises:
        InvalidValueError: the camera is of another model.
    """
    if camera.model == "SIMPLE_RADIAL":
        return np.asarray(camera.params)
    if camera.model == "OPENCV":
        fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
        return np.array([fx, cx, cy, k1, fy / fx - 1.0, k2, p1, p2])
    raise InvalidValueError(
        f"calibrate: expected a SIMPLE_RADIAL or an OPENCV camera, found one that is {camera.model}"
    )


def _whole(lens: FloatArray) -> FloatArray:
    """(8,) with what a SIMPLE_RADIAL lens has not."""
    return np.concatenate([lens, np.zeros(8 - len(lens))])


def _with_lens(camera: Camera, lens: FloatArray) -> Camera:
    """A camera of the same pictures with these parameters, in the order of `lens_of`."""
    if len(lens) == 4:
        return replace(camera, model="SIMPLE_RADIAL", params=tuple(lens))
    f, cx, cy, k1, aspect, k2, p1, p2 = lens
    return replace(camera, model="OPENCV", params=(f, f * (1.0 + aspect), cx, cy, k1, k2, p1, p2))


def joint_jacobians(
    camera: Camera, cam_from_local: Rigid3, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of pixels by points (k, 2, 3), and by pose and lens (k, 2, 6 + n), n as in `lens_of`.

    In closed form: pixel = (f, f (1 + aspect)) d(u, v) + c with (u, v) = (x, y) / z and Brown's distortion d.
    """
    lens = lens_of(camera)
    focal, _, _, k1, aspect, k2, p1, p2 = _whole(lens)
    in_camera = cam_from_local.act(points)
    depth = in_camera[:, 2]
    uv = in_camera[:, :2] / depth[:, None]
    u, v = uv.T
    squared = u * u + v * v
    stretch, slope = 1.0 + (k1 + k2 * squared) * squared, 2.0 * (k1 + 2.0 * k2 * squared)
    scale = focal * np.array([1.0, 1.0 + aspect])
    first = np.stack([2.0 * u * v, squared + 2.0 * v * v], axis=1)  # by p1
    second = np.stack([squared + 2.0 * u * u, 2.0 * u * v], axis=1)  # by p2
    bent = stretch[:, None] * uv + p1 * first + p2 * second
    across = slope * u * v + 2.0 * (p1 * u + p2 * v)
    along_u = stretch + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    along_v = stretch + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v
    by_uv = scale[:, None] * np.stack([along_u, across, across, along_v], axis=1).reshape(-1, 2, 2)
    by_camera = np.concatenate([by_uv, -by_uv @ uv[:, :, None]], axis=2) / depth[:, None, None]
    by_point, by_pose = chain_to_pose(by_camera, cam_from_local, points)
    by_lens = [
        bent * [1.0, 1.0 + aspect],
        np.tile([1.0, 0.0], (len(points), 1)),
        np.tile([0.0, 1.0], (len(points), 1)),
        scale * squared[:, None] * uv,
        focal * bent * [0.0, 1.0],
        scale * (squared**2)[:, None] * uv,
        scale * first,
        scale * second,
    ]
    return by_point, np.concatenate([by_pose, np.stack(by_lens[: len(lens)], axis=2)], axis=2)


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
    """Normal equations of one Levenberg-Marquardt step: (6 + n, 6 + n) and (6 + n,)."""

    information: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Measurements and priors; parameters are pose (6), then the lens as in `lens_of`."""

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
        prior = ((lens_of(camera) - self.prior_mean) / self.prior_sigma) ** 2
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
        gradient[6:] += (self.prior_mean - lens_of(camera)) / self.prior_sigma**2
        return _System(information=information, gradient=gradient)


def _step(pose: Rigid3, camera: Camera, delta: FloatArray) -> tuple[Rigid3, Camera]:
    rotation = pose.rotation @ so3_exp(delta[:3]).T
    center = pose.center + delta[3:6]
    lens = lens_of(camera)
    moved = lens + delta[6:]
    moved[0] = np.clip(moved[0], 0.7 * lens[0], 1.4 * lens[0])  # one step's reach
    return Rigid3(rotation=rotation, translation=-rotation @ center), _with_lens(camera, moved)
