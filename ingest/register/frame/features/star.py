"""Where the scan is looked at from: a star of poses around the prior (paper, section 2.3)."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame_registration import FramePrior


@dataclass(frozen=True, slots=True, kw_only=True)
class StarOptions:
    """How the star is laid out.

    Attributes:
        arm_sigmas: the views to the sides stand so many standard deviations of the prior away: pooled with
            the middle one they show what 95 of 100 true poses see.
        min_arm_share, max_arm_share: of the width that the camera sees; nearer views show nothing new,
            farther ones nothing in common with the middle one.
        max_zoom: a view along the optical axis comes nearer, or goes farther, by at most this factor.
            SIFT bridges a factor of 2 in scale, appearance of splats less.
        min_zoom: and by at least this one: the change of scale helps even a good prior.
        upright_reach_deg: features without orientation survive a rotation of the image by so much.
        full_circle_sigma_deg: from here on a heading is taken as unknown.
    """

    arm_sigmas: float = 1.5
    min_arm_share: float = 0.08
    max_arm_share: float = 0.4
    min_zoom: float = 1.12
    max_zoom: float = 1.4
    upright_reach_deg: float = 15.0
    full_circle_sigma_deg: float = 75.0


def star_poses(prior: FramePrior, depth_m: float, camera: Camera, options: StarOptions) -> list[Rigid3]:
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
        wanted = options.arm_sigmas * float(np.hypot(_sigma_along(prior, axis), turned_m))
        arm = np.clip(wanted, options.min_arm_share * seen_m, options.max_arm_share * seen_m)
        offsets += [arm * axis, -arm * axis]
    zoom = 1.0 + options.arm_sigmas * _sigma_along(prior, forward) / depth_m
    zoom = float(np.clip(zoom, options.min_zoom, options.max_zoom))
    offsets += [depth_m * (1.0 - 1.0 / zoom) * forward, -depth_m * (zoom - 1.0) * forward]
    return [_pose(rotation, center + offset) for offset in offsets]


def fan_headings_deg(sigma_heading_deg: float, options: StarOptions) -> list[float]:
    """Turns about the vertical that upright features need, 0 first; the full circle if nothing is known."""
    step = 2.0 * options.upright_reach_deg
    if sigma_heading_deg >= options.full_circle_sigma_deg:
        return [i * step for i in range(round(360.0 / step))]
    reach = 2.0 * sigma_heading_deg  # 95 of 100 priors
    side = max(int(np.ceil((reach - options.upright_reach_deg) / step)), 0)
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
