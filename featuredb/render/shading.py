"""Shaded relief from depth alone: a picture of scans that have neither colour nor intensity."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import pixel_rays
from featuredb.render.renderer import Rendering

_WIDEST_STEP_PX = 12  # as the largest splat


# Cartography's light: where it comes from, clockwise from north and above the horizon. Photos are taken under
# all azimuths.
_LIGHT_AZIMUTH_DEG, _LIGHT_ELEVATION_DEG = 315.0, 45.0
_AMBIENT = 0.25  # share of the light that falls from everywhere: keeps surfaces apart that are turned away
# A steeper change of depth counts as an edge: 84 degrees; ground seen at 6 degrees is still ground.
_STEEPEST_SLOPE = float(np.tan(np.radians(84.0)))


def shaded_relief(rendering: Rendering) -> NDArray[np.uint8]:
    """(h, w) uint8: how brightly the surfaces are lit, zero where nothing is seen.

    Normals come from differences of depth over the distance between neighbouring points in the picture,
    never across a depth edge.
    """
    x, y = pixel_rays(rendering.camera)
    points = np.stack([x * rendering.depth, y * rendering.depth, rendering.depth], axis=2)
    step = point_distance_px(rendering)
    # Down times across points towards the camera (x right, y down, z forward).
    normal = np.cross(_along_surface(points, x, y, step, 0), _along_surface(points, x, y, 0, step))
    azimuth, elevation = np.radians([_LIGHT_AZIMUTH_DEG, _LIGHT_ELEVATION_DEG])
    to_light = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    length = np.linalg.norm(normal, axis=2)
    lit = normal @ (rendering.cam_from_local.rotation @ to_light).astype(np.float32)
    light = _AMBIENT + (1.0 - _AMBIENT) * np.maximum(lit / np.maximum(length, np.float32(1e-30)), 0.0)
    return np.where(length > 0.0, np.rint(255.0 * light), 0.0).astype(np.uint8)


def _along_surface(
    points: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32], down: int, right: int
) -> NDArray[np.float32]:
    """(h, w, 3) the step in space along a surface from before a pixel to behind it; zero without neighbours.

    Of the two halves the one across a depth edge is left out.

    Args:
        points: (h, w, 3) in camera axes, NaN where nothing is seen. x, y: (h, w) rays of the pixels.
        down, right: pixels to the neighbour behind.
    """
    height, width = x.shape
    result = np.zeros_like(points)
    if down >= height or right >= width:
        return result  # no pixel has a neighbour
    first, second = np.s_[: height - down, : width - right], np.s_[down:, right:]
    apart = np.hypot(x[second] - x[first], y[second] - y[first]) * np.float32(_STEEPEST_SLOPE)
    change = points[second] - points[first]
    for here in (first, second):
        same = np.abs(change[..., 2]) < apart * points[here][..., 2]
        result[here] += np.where(same[..., None], change, np.float32(0.0))
    return result


def point_distance_px(rendering: Rendering) -> int:
    """How far apart neighbouring points are in the picture, in whole pixels from 1 up."""
    index = rendering.index
    both = (index[:, 1:] >= 0) & (index[:, :-1] >= 0)
    pairs = int(np.count_nonzero(both))
    changes = int(np.count_nonzero(both & (index[:, 1:] != index[:, :-1])))
    if changes == 0:
        return 1
    return min(max(round(pairs / changes), 1), _WIDEST_STEP_PX)
