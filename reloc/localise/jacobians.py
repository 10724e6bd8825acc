"""Derivatives of pixels by points, pose and lens."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from reloc.localise.lens_prior import lens_of, whole_lens


def pixel_jacobians(
    camera: Camera, cam_from_local: Rigid3, points: FloatArray, *, lens: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the pixels of points (k, 3), in front of the camera.

    Returns:
        By the points (k, 2, 3), and by the pose (k, 2, 6): a small rotation of the camera about the local
        axes (rad), then a displacement of its centre (m): R_true = R(dtheta) R, C_true = C + dC for
        local_from_cam = (R, C). With `lens` by its parameters, too, (k, 2, 6 + n), n as in `lens_of`.
    """
    in_camera = cam_from_local.act(points)
    if lens:
        by_camera, by_lens = lens_jacobians(camera, in_camera)
    else:
        by_camera, by_lens = camera.projection_jacobian(in_camera), np.zeros((len(points), 2, 0))
    by_point = by_camera @ cam_from_local.rotation
    by_turn = by_point @ skew(points - cam_from_local.center)
    return by_point, np.concatenate([by_turn, -by_point, by_lens], axis=2)


def lens_jacobians(camera: Camera, in_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of pixels by points (k, 2, 3) in camera axes, and by the lens (k, 2, n), n as in `lens_of`.

    In closed form: pixel = (f, f (1 + aspect)) d(u, v) + c with (u, v) = (x, y) / z and Brown's distortion d.
    """
    lens = lens_of(camera)
    focal, _, _, k1, aspect, k2, p1, p2 = whole_lens(lens)
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
    by_lens = [
        bent * [1.0, 1.0 + aspect],
        np.tile([1.0, 0.0], (len(in_camera), 1)),
        np.tile([0.0, 1.0], (len(in_camera), 1)),
        scale * squared[:, None] * uv,
        focal * bent * [0.0, 1.0],
        scale * (squared**2)[:, None] * uv,
        scale * first,
        scale * second,
    ]
    return by_camera, np.stack(by_lens[: len(lens)], axis=2)
