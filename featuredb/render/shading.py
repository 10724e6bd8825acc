"""Shaded relief from depth alone: a picture of scans that have neither colour nor intensity."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.rays import pixel_rays
from featuredb.render.compiled import compiled_module
from featuredb.render.rendering import Rendering
from featuredb.render.threads import over_rows, thread_count

_WIDEST_STEP_PX = 12  # as the largest splat


@dataclass(frozen=True, slots=True, kw_only=True)
class ReliefOptions:
    """The light and the scale of the shading.

    Attributes:
        light_azimuth_deg: where the light comes from, clockwise from north.
        light_elevation_deg: above the horizon.
        ambient: share of the light that falls from everywhere.
        steepest_deg: angle off the picture's plane from which a change of depth counts as an edge.
        threads: as in RenderOptions.
    """

    # Cartography's light. Photos are taken under all azimuths; give the sun's own where it is known.
    light_azimuth_deg: float = 315.0
    light_elevation_deg: float = 45.0
    ambient: float = 0.25  # keeps surfaces apart that are turned away from the light
    steepest_deg: float = 84.0  # ground seen at 6 degrees is still ground
    threads: int = 0


def shaded_relief(rendering: Rendering, options: ReliefOptions | None = None) -> NDArray[np.uint8]:
    """(h, w) uint8: how brightly the surfaces are lit, zero where nothing is seen.

    Normals come from differences of depth over the distance between neighbouring points in the picture,
    never across a depth edge.

    Raises:
        MissingExtraError: numba is not installed.
    """
    options = options or ReliefOptions()
    loops = compiled_module("featuredb.render.loops.relief_loops")
    x, y = pixel_rays(rendering.camera)
    azimuth, elevation = np.radians([options.light_azimuth_deg, options.light_elevation_deg])
    to_light = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    to_light = rendering.cam_from_local.rotation @ to_light
    step, steepest = point_distance_px(rendering), float(np.tan(np.radians(options.steepest_deg)))
    picture = np.empty(rendering.depth.shape, np.uint8)
    over_rows(
        lambda first, end: loops.shade(
            rendering.depth, x, y, to_light, step, steepest, options.ambient, picture, first, end
        ),
        len(picture),
        thread_count(options.threads),
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
