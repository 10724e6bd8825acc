"""From splats to surfaces: depth between points, and holes closed."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.compiled import compiled_module
from featuredb.render.lens import lens_vector
from featuredb.render.splats import Splats
from featuredb.render.threads import over_rows

_MOMENTS = 9  # of picture_loops.plane_moments
_BLOCK_PER_SPACING = 1.5  # blocks of three by three then hold about twenty points for a plane
_SMALLEST_BLOCK_PX = 4  # smaller ones cost more and see only the points' noise
_RADII_PX = (1, 2, 3, 4, 6, 8, 12, 16)  # of closings; each is tried from the largest down


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceOptions:
    """How splats become surfaces.

    Attributes:
        close_holes: close what lies between the splats of one surface.
        tilt_splats: give splats the slope of the surface around them, instead of one depth each.
        reach_per_spacing: holes are closed within this share of the distance between points.
    """

    close_holes: bool = True
    tilt_splats: bool = True
    # Points thrown at random leave holes of up to about two spacings between them; half of that on each side.
    reach_per_spacing: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """What the pixels show once splats are surfaces.

    Attributes:
        nearness: (h, w) float32, one over the depth of the splats, 1/m; zero where nothing is.
        filled: (h, w) float32, the same with holes closed.
        source: (h, w) int32: 0, or the radius in pixels within which the surface lies that closed a hole.
    """

    nearness: NDArray[np.float32]
    filled: NDArray[np.float32]
    source: NDArray[np.int32]


def surfaces_of(
    xyz: NDArray[np.float32],
    splats: Splats,
    camera: Camera,
    cam_from_local: Rigid3,
    options: SurfaceOptions,
    threads: int,
) -> Surfaces:
    """Depth of each pixel, between the points too.

    A hole is a pixel that a morphological closing of nearness by a square brings to the front: it lies
    between parts of a surface on both sides of it, no wider apart than the points' distance allows. A
    straight silhouette is left where it is by a closing, so the surface does not grow over what lies
    behind it. The pixel may be empty, or show a point farther off through the surface.
    """
    loops = compiled_module("featuredb.render.picture_loops")
    pose, height = cam_from_local.matrix()[:3], camera.height
    nearness = np.empty(splats.index.shape, np.float32)
    over_rows(
        lambda first, end: loops.nearness_of_index(xyz, splats.index, pose, nearness, first, end),
        height,
        threads,
    )
    apart_px = _apart_px(splats, nearness, camera.focal_px)
    if options.tilt_splats and len(apart_px):
        _tilt(xyz, splats, camera, pose, float(np.median(apart_px)), nearness, threads)
    source = np.zeros(nearness.shape, np.int32)
    if not options.close_holes or not len(apart_px):
        return Surfaces(nearness=nearness, filled=nearness, source=source)
    largest = options.reach_per_spacing * float(apart_px.max())
    radii = np.array([r for r in _RADII_PX if r == _RADII_PX[0] or r < largest + 0.5], np.int32)
    closed = np.stack([_closing(nearness, int(r)) for r in radii])
    filled = np.empty_like(nearness)
    over_rows(
        lambda first, end: loops.close_holes(
            nearness,
            splats.apart_m,
            closed,
            radii,
            camera.focal_px,
            options.reach_per_spacing,
            filled,
            source,
            first,
            end,
        ),
        height,
        threads,
    )
    return Surfaces(nearness=nearness, filled=filled, source=source)


def _apart_px(splats: Splats, nearness: NDArray[np.float32], focal_px: float) -> NDArray[np.float32]:
    """Distance between points in pixels, of a sample of the pixels that show any."""
    part = slice(None, None, 4), slice(None, None, 4)
    seen = splats.index[part] >= 0
    apart: NDArray[np.float32] = splats.apart_m[part][seen] * nearness[part][seen] * np.float32(focal_px)
    return apart


def _tilt(
    xyz: NDArray[np.float32],
    splats: Splats,
    camera: Camera,
    pose: NDArray[np.float64],
    apart_px: float,
    nearness: NDArray[np.float32],
    threads: int,
) -> None:
    """Give each splat the slope of the plane through the points around it."""
    loops = compiled_module("featuredb.render.picture_loops")
    lens, index = lens_vector(camera), splats.index
    side = max(int(np.ceil(_BLOCK_PER_SPACING * apart_px)), _SMALLEST_BLOCK_PX)
    blocks = -(-camera.height // side), -(-camera.width // side)
    moments = np.zeros((*blocks, _MOMENTS))
    over_rows(
        lambda first, end: loops.plane_moments(xyz, index, pose, lens, side, moments, first, end),
        blocks[0],
        threads,
    )
    planes = loops.plane_slopes(moments, side)
    over_rows(
        lambda first, end: loops.tilt_splats(
            xyz, index, splats.apart_m, pose, lens, planes, side, nearness, first, end
        ),
        camera.height,
        threads,
    )


def _closing(nearness: NDArray[np.float32], radius_px: int) -> NDArray[np.float32]:
    """Grey-scale closing by a square of 2 radius + 1 pixels."""
    square = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    closed: NDArray[np.float32] = cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, square)
    return closed
