"""Which nodes of a cloud a camera needs: those in its view, down to the detail that a pixel can show."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import CloudNodes

_BORDER_SAMPLES = 33  # per side of the image; between two the border bends by less than the margin
_MARGIN = 0.02  # of the tangent, for that bend and for splats that reach in from outside
_WIDEST_TAN = 50.0  # 89 degrees: a border that sees further, or nothing at all, culls nothing on its side


def visible_nodes(
    nodes: CloudNodes,
    camera: Camera,
    cam_from_local: Rigid3,
    *,
    near_m: float,
    finest_px: float,
) -> NDArray[np.intp]:
    """Rows of the nodes to draw, in order.

    A node is left out when its box lies beside, behind or before the view, and when the spacing of its
    points is below `finest_px` pixels already at the box's nearest depth: coarser nodes fill the pixels
    without it. Nodes of the coarsest level are never too fine.
    """
    middle = 0.5 * (nodes.box_min.astype(np.float64) + nodes.box_max)
    half = 0.5 * (nodes.box_max.astype(np.float64) - nodes.box_min)
    planes = view_planes(camera) @ cam_from_local.rotation
    inside = np.ones(len(nodes), dtype=bool)
    for normal in planes:
        inside &= (middle - cam_from_local.center) @ normal + half @ np.abs(normal) >= 0.0
    axis = cam_from_local.rotation[2]
    along, reach = (middle - cam_from_local.center) @ axis, half @ np.abs(axis)
    inside &= along + reach >= near_m
    nearest = np.maximum(along - reach, near_m)
    wanted = (nodes.spacing_m * camera.focal_px > finest_px * nearest) | (nodes.level == 0)
    return np.flatnonzero(inside & wanted)


def view_planes(camera: Camera) -> FloatArray:
    """(4, 3) inward normals, camera axes, of planes through the centre that bound what the image sees."""
    f = np.linspace(0.0, 1.0, _BORDER_SAMPLES)
    zero, one = np.zeros_like(f), np.ones_like(f)
    u = np.concatenate([f, f, zero, one]) * camera.width
    v = np.concatenate([zero, one, f, f]) * camera.height
    rays = camera.unproject(np.column_stack([u, v]))
    if not np.isfinite(rays).all():  # the lens does not fill the picture; its rim bounds the view
        rays = np.array([[-_WIDEST_TAN, -_WIDEST_TAN], [_WIDEST_TAN, _WIDEST_TAN]])
    x0, y0 = np.maximum(rays.min(axis=0) - _MARGIN, -_WIDEST_TAN)
    x1, y1 = np.minimum(rays.max(axis=0) + _MARGIN, _WIDEST_TAN)
    return np.array([[1.0, 0.0, -x0], [-1.0, 0.0, x1], [0.0, 1.0, -y0], [0.0, -1.0, y1]])
