"""Covariance of a registered frame: what the residuals say, and what all of them share."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame.prior_fit import prior_information
from ingest.register.frame_registration import FramePrior
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, pose_uncertainty


def frame_covariance(
    pixels: FloatArray,
    points: FloatArray,
    pose: PoseHypothesis,
    spacing_m: float,
    depth_m: float,
    options: PoseOptions,
    correlated_inliers: float,
    shared_point_share: float,
    prior: FramePrior | None = None,
) -> FloatArray:
    """Covariance (6, 6) of the left perturbation of cam_from_local.

    Residuals of neighbouring correspondences are not independent: they come from one render of one scan. So
    `correlated_inliers` of them count as one. What all share, a shift of the whole scan's appearance by a
    part of its point spacing, shows in no residual and is added to the position.

    Args:
        pixels, points: (k, 2), (k, 3) of the inliers.
        spacing_m: of the scan. depth_m: distance to it.
        shared_point_share: standard deviation of the shared shift, as a share of the spacing.
        prior: that the pose was fitted under, too.
    """
    spread = (0.3 * spacing_m) ** 2 * np.eye(3)  # a point stands for a cell of its spacing
    found = pose_uncertainty(pixels, points, np.broadcast_to(spread, (len(points), 3, 3)), pose, options)
    covariance = correlated_inliers * found.covariance
    shared = (shared_point_share * spacing_m) ** 2
    covariance = covariance + np.diag([shared / depth_m**2] * 3 + [shared] * 3)
    if prior is not None:
        information = np.linalg.inv(covariance) + prior_information(pose.cam_from_local, prior)
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return left_perturbation(covariance, pose.cam_from_local)


def left_perturbation(covariance: FloatArray, cam_from_local: Rigid3) -> FloatArray:
    """From small rotations of the camera about local axes and displacements of its centre.

    With R_wc' = exp(dtheta) R_wc and C' = C + dC: cam_from_local' = exp(-R dtheta, -R dC) cam_from_local.
    """
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = -cam_from_local.rotation
    result = turn @ covariance @ turn.T
    return np.asarray((result + result.T) / 2.0, dtype=np.float64)
