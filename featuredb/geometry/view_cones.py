"""From which side points were seen: the cone of their views, and what a camera should see of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewCones:
    """The sides from which points were seen.

    Attributes:
        direction: (p, 3), mean unit vector from the point to the cameras that saw it.
        spread: (p,), radians between that mean and the outermost view; 0 without any.
    """

    direction: NDArray[np.floating]
    spread: NDArray[np.floating]


def view_cones(
    points: FloatArray, centers: FloatArray, point_of: NDArray[np.integer], center_of: NDArray[np.integer]
) -> ViewCones:
    """Cones of points (p, 3) seen from camera centres (c, 3).

    Args:
        point_of, center_of: (m,) rows of the points and of the centres, one for each observation.
    """
    toward = centers[center_of] - points[point_of]
    unit = toward / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)[:, None]
    direction = np.zeros_like(points, dtype=np.float64)
    np.add.at(direction, point_of, unit)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    outermost = np.ones(len(points))
    np.minimum.at(outermost, point_of, np.einsum("ij,ij->i", direction[point_of], unit))
    return ViewCones(direction=direction, spread=np.arccos(np.clip(outermost, -1.0, 1.0)))


def in_view(
    points: FloatArray, cones: ViewCones, camera: Camera, cam_from_points: Rigid3, beyond_deg: float
) -> NDArray[np.bool_]:
    """(p,) which points project into the image and are seen from a side that is known.

    Args:
        points: (p, 3), in the frame that the pose takes into the camera, as the cones are.
        beyond_deg: how far outside of its cone a point may be seen from.
    """
    pixels = camera.project(cam_from_points.act(points))
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[:, 0] >= 0)
            & (pixels[:, 1] >= 0)
            & (pixels[:, 0] < camera.width)
            & (pixels[:, 1] < camera.height)
        )
    toward = cam_from_points.center - points
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", toward, cones.direction), -1.0, 1.0))
    return np.asarray(inside & (angle <= cones.spread + np.radians(beyond_deg)), dtype=np.bool_)
