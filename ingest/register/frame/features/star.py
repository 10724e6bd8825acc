"""Where the scan is looked at from: a star of poses around the prior (paper, section 2.3)."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame_registration import FramePrior

# The views to the sides stand so many standard deviations of the prior away: pooled with the middle one they
# show what 95 of 100 true poses see.
_ARM_SIGMAS = 1.5
# Of the width that the camera sees; nearer views show nothing new, farther ones nothing in common with the
# middle one.
MIN_ARM_SHARE = 0.08
MAX_ARM_SHARE = 0.4
# A view along the optical axis comes nearer, or goes farther, by at most this factor. SIFT bridges a factor
# of 2 in scale, appearance of splats less.
_MAX_ZOOM = 1.4
_MIN_ZOOM = 1.12  # and by at least this one: the change of scale helps even a good prior
UPRIGHT_REACH_DEG = 15.0  # features without orientation survive a rotation of the image by so much
FULL_CIRCLE_SIGMA_DEG = 75.0  # from here on a heading is taken as unknown


def star_poses(prior: FramePrior, depth_m: float, camera: Camera) -> list[Rigid3]:
    """Seven poses: the prior's, two to either side, two up and down the image, nearer and farther.

    Args:
        depth_m: distance along the optical axis to what the prior sees.
        camera: of the photo, for the width that it sees at that distance.

    Returns:
        Poses cam_from_local with the prior's rotation, the prior's own first.
    """
    rotation, center = prior.cam_from_local.rotation, prior.cam_from_local.center
    right, down, forward = rotation
    seen_m = depth_m * min(camera.width, camera.height) / camera.focal_px
    turned_m = depth_m * np.radians(prior.sigma_tilt_deg)
    offsets = [np.zeros(3)]
    for axis in (right, down):
        wanted = _ARM_SIGMAS * float(np.hypot(_sigma_along(prior, axis), turned_m))
        arm = np.clip(wanted, MIN_ARM_SHARE * seen_m, MAX_ARM_SHARE * seen_m)
        offsets += [arm * axis, -arm * axis]
    zoom = 1.0 + _ARM_SIGMAS * _sigma_along(prior, forward) / depth_m
    zoom = float(np.clip(zoom, _MIN_ZOOM, _MAX_ZOOM))
    offsets += [depth_m * (1.0 - 1.0 / zoom) * forward, -depth_m * (zoom - 1.0) * forward]
    return [_pose(rotation, center + offset) for offset in offsets]


def fan_headings_deg(sigma_heading_deg: float) -> list[float]:
    """Turns about the vertical that upright features need, 0 first; the full circle if nothing is known."""
    step = 2.0 * UPRIGHT_REACH_DEG
    if sigma_heading_deg >= FULL_CIRCLE_SIGMA_DEG:
        return [i * step for i in range(round(360.0 / step))]
    reach = 2.0 * sigma_heading_deg  # 95 of 100 priors
    side = max(int(np.ceil((reach - UPRIGHT_REACH_DEG) / step)), 0)
    return [0.0, *(sign * i * step for i in range(1, side + 1) for sign in (1.0, -1.0))]


def turned_about_vertical(cam_from_local: Rigid3, angle_deg: float) -> Rigid3:
    """The camera at the same place, its heading turned clockwise seen from above."""
    a = np.radians(angle_deg)
    turn = np.array([[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return _pose(cam_from_local.rotation @ turn.T, cam_from_local.center)


def _sigma_along(prior: FramePrior, axis: FloatArray) -> float:
    sigma = np.array([prior.sigma_horizontal_m, prior.sigma_horizontal_m, prior.sigma_vertical_m])
    return float(np.linalg.norm(sigma * axis))


def _pose(rotation: FloatArray, center: FloatArray) -> Rigid3:
    return Rigid3(rotation=rotation, translation=-rotation @ center)
