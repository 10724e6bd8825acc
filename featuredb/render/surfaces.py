"""From splats to surfaces: depth between points, and holes closed."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.compiled import compiled_module
from featuredb.render.lens import lens_vector
from featuredb.render.splats import BlockPlanes, Splats
from featuredb.render.threads import mapped, over_rows

_MOMENTS = 9  # of picture_loops.plane_moments
_BLOCK_PER_SPACING = 1.5  # blocks of three by three then hold about twenty points for a plane
_SMALLEST_BLOCK_PX = 4  # smaller ones cost more and see only the points' noise
_DENSE_PX = 2.0  # where nearly every pixel shows a point of its own, every fourth is enough for a plane
_RADII_PX = (1, 2, 3, 5, 8, 13, 21, 32)  # of closings; each is tried from the largest down


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceOptions:
    """How splats become surfaces.

    Attributes:
        close_holes: close what lies between the splats of one surface.
        tilt_splats: lay splats into the surface that the points around them make.
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
    surface: BlockPlanes | None,
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
    index, apart = splats.index, splats.apart_m
    nearness, lens = np.empty(index.shape, np.float32), lens_vector(camera)
    planes, side = (np.empty((0, 0, 3)), 1) if surface is None else (surface.planes, surface.side)
    over_rows(
        lambda first, end: loops.splat_nearness(
            xyz, index, apart, pose, lens, planes, side, nearness, first, end
        ),
        height,
        threads,
    )
    source = np.zeros(index.shape, np.int32)
    if not options.close_holes or splats.points_drawn == 0:
        return Surfaces(nearness=nearness, filled=nearness, source=source)
    reach, focal = options.reach_per_spacing, camera.focal_px
    radii = _radii(splats, reach, focal)
    closed = _closings(nearness, radii, threads)
    filled = np.empty_like(nearness)
    over_rows(
        lambda first, end: loops.close_holes(
            nearness, apart, planes, side, closed, radii, focal, reach, filled, source, first, end
        ),
        height,
        threads,
    )
    return Surfaces(nearness=nearness, filled=filled, source=source)


def apart_px(splats: Splats, focal_px: float) -> NDArray[np.float32]:
    """Distance between points in pixels, of a sixteenth of the pixels that show any."""
    part = slice(None, None, 4), slice(None, None, 4)
    seen = splats.index[part] >= 0
    apart: NDArray[np.float32] = splats.apart_m[part][seen] / splats.key[part][seen] * np.float32(focal_px)
    return apart


def block_planes(
    xyz: NDArray[np.float32], splats: Splats, camera: Camera, cam_from_local: Rigid3, threads: int
) -> BlockPlanes | None:
    """The surfaces that the points in view lie on; None where there are no points."""
    apart = apart_px(splats, camera.focal_px)
    if len(apart) == 0:
        return None
    loops = compiled_module("featuredb.render.picture_loops")
    pose, lens, index = cam_from_local.matrix()[:3], lens_vector(camera), splats.index
    typical = float(np.median(apart))
    side = max(int(np.ceil(_BLOCK_PER_SPACING * typical)), _SMALLEST_BLOCK_PX)
    stride = 2 if typical < _DENSE_PX else 1
    blocks = -(-camera.height // side), -(-camera.width // side)
    moments, planes = np.zeros((*blocks, _MOMENTS)), np.empty((*blocks, 3))
    over_rows(
        lambda first, end: loops.plane_moments(xyz, index, pose, lens, side, stride, moments, first, end),
        blocks[0],
        threads,
    )
    over_rows(lambda first, end: loops.plane_slopes(moments, side, planes, first, end), blocks[0], threads)
    return BlockPlanes(planes=planes, side=side)


def _radii(splats: Splats, reach_per_spacing: float, focal_px: float) -> NDArray[np.int32]:
    """Radii of closings, up to what the widest spacing in the picture asks for."""
    widest = reach_per_spacing * float(apart_px(splats, focal_px).max(initial=0.0))
    return np.array([r for r in _RADII_PX if r == _RADII_PX[0] or r < widest + 0.5], np.int32)


def _closings(nearness: NDArray[np.float32], radii: NDArray[np.int32], threads: int) -> NDArray[np.float32]:
    """Grey-scale closings (k, h, w) by squares of 2 radius + 1 pixels."""
    closed = np.empty((len(radii), *nearness.shape), np.float32)

    def close(k: int) -> None:
        square = np.ones((2 * radii[k] + 1, 2 * radii[k] + 1), np.uint8)
        cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, square, dst=closed[k])

    mapped(close, range(len(radii)), threads)
    return closed
