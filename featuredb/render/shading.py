"""Shaded relief from depth alone: a picture of scans that have neither colour nor intensity."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.rays import pixel_rays
from featuredb.render.compiled import compiled_module
from featuredb.render.rendering import Rendering
from featuredb.render.threads import over_rows, thread_count

_WIDEST_STEP_PX = 12  # as the largest splat


# Cartography's light: where it comes from, clockwise from north and above the horizon. Photos are taken under
# all azimuths.
_LIGHT_AZIMUTH_DEG, _LIGHT_ELEVATION_DEG = 315.0, 45.0
_AMBIENT = 0.25  # share of the light that falls from everywhere: keeps surfaces apart that are turned away
_STEEPEST_DEG = 84.0  # a steeper change of depth counts as an edge; ground seen at 6 degrees is still ground


def shaded_relief(rendering: Rendering) -> NDArray[np.uint8]:
    """(h, w) uint8: how brightly the surfaces are lit, zero where nothing is seen.

    Normals come from differences of depth over the distance between neighbouring points in the picture,
    never across a depth edge.

    Raises:
        MissingExtraError: numba is not installed.
    """
    loops = compiled_module("featuredb.render.loops.relief_loops")
    x, y = pixel_rays(rendering.camera)
    azimuth, elevation = np.radians([_LIGHT_AZIMUTH_DEG, _LIGHT_ELEVATION_DEG])
    to_light = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    to_light = rendering.cam_from_local.rotation @ to_light
    step, steepest = point_distance_px(rendering), float(np.tan(np.radians(_STEEPEST_DEG)))
    picture = np.empty(rendering.depth.shape, np.uint8)
    over_rows(
        lambda first, end: loops.shade(
            rendering.depth, x, y, to_light, step, steepest, _AMBIENT, picture, first, end
        ),
        len(picture),
        thread_count(0),
    )
    return picture


def point_distance_px(rendering: Rendering) -> int:
    """How far apart neighbouring points are in the picture, in whole pixels from 1 up."""
    index = rendering.index
    both = (index[:, 1:] >= 0) & (index[:, :-1] >= 0)
    pairs = int(np.count_nonzero(both))
    changes = int(np.count_nonzero(both & (index[:, 1:] != index[:, :-1])))
    if changes == 0:
        return 1
    return min(max(round(pairs / changes), 1), _WIDEST_STEP_PX)
