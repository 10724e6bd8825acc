"""What a prior says of a pose, and the pose that matches and prior together make most likely."""

from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp, so3_log
from ingest.register.frame.features.matching import FrameMatches
from ingest.register.frame_registration import SIGMAS, FramePrior
from reloc.localise.lens_prior import pixel_jacobians
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, reprojection_errors
from reloc.localise.self_calibration import pose_step

_ROUNDS = 5  # Gauss-Newton; a step of 50 m and 3 degrees leaves a metre to the next
_MIN_MATCHES = 6
# In the fit the prior's deviations count so many times as large. People and devices understate them, and what
# matches leave open stays well within what the verdict bears.
_PRIOR_SLACK = 2.0
CORRELATED_INLIERS = 4.0  # so many count as one measurement, by the errors of photos of the simulated town


def prior_residual(pose: Rigid3, prior: FramePrior) -> FloatArray:
    """Displacement of the centre, tilt about east and north, and turn about the vertical (6,), in the prior's
    standard deviations. An unknown heading counts nothing.
    """
    moved = pose.center - prior.cam_from_local.center
    turn = pose.rotation.T @ prior.cam_from_local.rotation
    heading = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    tilt = so3_log(turn @ so3_exp([0.0, 0.0, -heading]))
    if prior.sigma_heading_deg >= 180.0:
        heading = 0.0
    angles = np.degrees([tilt[0], tilt[1], heading])
    level, tilted = prior.sigma_horizontal_m, prior.sigma_tilt_deg
    sigmas = (level, level, prior.sigma_vertical_m, tilted, tilted, prior.sigma_heading_deg)
    return np.concatenate([moved, angles]) / sigmas


def prior_sigmas(prior: FramePrior, pose: Rigid3) -> float:
    """Distance of a pose from the prior in standard deviations over all axes together."""
    return float(np.linalg.norm(prior_residual(pose, prior)))


def loosened(prior: FramePrior) -> FramePrior:
    """The prior with deviations as the fit takes them; a heading that was unknown stays unknown."""
    return replace(prior, **{name: _PRIOR_SLACK * getattr(prior, name) for name in SIGMAS})


def prior_information(pose: Rigid3, prior: FramePrior) -> FloatArray:
    """Inverse covariance (6, 6) of rotations about local axes (rad) and displacement (m) of the camera."""
    slopes = _prior_slopes(pose, prior)
    return np.asarray(slopes.T @ slopes, dtype=np.float64)


def fitted_under_prior(
    matches: FrameMatches, pose: PoseHypothesis, prior: FramePrior, options: PoseOptions
) -> PoseHypothesis:
    """The most likely pose next to `pose`, given matches with Cauchy residuals and the prior.

    Args:
        options: of the fit that `pose` comes from.

    Returns:
        `pose` itself where the matches are few.
    """
    if len(matches) < _MIN_MATCHES:
        return pose
    tolerance_px = options.tolerance_px(pose.camera)
    here = pose.cam_from_local
    for _ in range(_ROUNDS):
        found = _information(matches, pose.camera, here, tolerance_px)
        if found is None:
            return pose
        information, pull = (part / CORRELATED_INLIERS for part in found)
        slopes = _prior_slopes(here, prior)
        information += slopes.T @ slopes
        pull += slopes.T @ prior_residual(here, prior)
        step = np.asarray(np.linalg.solve(information, -pull), dtype=np.float64)
        here = pose_step(here, step)
    error = reprojection_errors(matches.pixels, matches.points, pose.camera, here)
    return replace(pose, cam_from_local=here, inliers=error < tolerance_px)


def _information(
    matches: FrameMatches, camera: Camera, pose: Rigid3, tolerance_px: float
) -> tuple[FloatArray, FloatArray] | None:
    """Normal equations (6, 6), (6,) of the matches within reach, weighted by Cauchy and their own spread."""
    near = reprojection_errors(matches.pixels, matches.points, camera, pose) < 2.0 * tolerance_px
    if near.sum() < _MIN_MATCHES:
        return None
    pixels, points = matches.pixels[near], matches.points[near]
    residual = camera.project(pose.act(points)) - pixels
    squared = np.sum(residual**2, axis=1)
    weight = 1.0 / (1.0 + squared / (0.25 * tolerance_px) ** 2)
    variance = max(float(weight @ squared / (2.0 * weight.sum())), 1e-4)
    _, jacobian = pixel_jacobians(camera, pose, points)
    information = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) / variance
    return information, np.einsum("n,nij,ni->j", weight, jacobian, residual) / variance


def _prior_slopes(pose: Rigid3, prior: FramePrior) -> FloatArray:
    """Derivative (6, 6) of the prior's residual by rotations about local axes (rad) and displacement (m)."""

    def slope(axis: FloatArray) -> FloatArray:
        ahead, behind = (prior_residual(pose_step(pose, step), prior) for step in (axis, 0.0 - axis))
        return (ahead - behind) / 2e-5

    return np.stack([slope(np.asarray(axis, dtype=np.float64)) for axis in 1e-5 * np.eye(6)], axis=1)
