"""From splats to surfaces: depth between points, and holes closed."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.render.compiled import compiled_module
from featuredb.render.splats import BlockPlanes, Splats
from featuredb.render.threads import mapped, over_rows

_MOMENTS = 9  # of plane_loops.plane_moments
_BLOCK_PER_SPACING = 1.5  # blocks of three by three then hold about twenty points for a plane
_SMALLEST_BLOCK_PX = 4  # smaller ones cost more and see only the points' noise
_DENSE_PX = 2.0  # where nearly every pixel shows a point of its own, every fourth is enough for a plane
_RADII_PX = (1, 2, 3, 5, 8, 13, 21, 32)  # of closings; each is tried from the largest down


# Holes are closed within this share of the distance between points. Points thrown at random leave holes of up
# to about two spacings between them; half of that on each side.
_REACH_PER_SPACING = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """What the pixels show; see `picture_loops.show_splats`.

    Attributes:
        nearness, apart_m: (h, w) float32 of the splats, 1/m and m.
        depth: (h, w) float32 metres, NaN where nothing is.
        index: (h, w) int32, -1 where nothing is or a hole was closed.
        paint: (h, w) uint32.
    """

    nearness: NDArray[np.float32]
    apart_m: NDArray[np.float32]
    depth: NDArray[np.float32]
    index: NDArray[np.int32]
    paint: NDArray[np.uint32]


def surfaces_of(splats: Splats, planes: BlockPlanes, focal_px: float, threads: int) -> Surfaces:
    """What each pixel shows of its own point, at its depth between the points."""
    loops = compiled_module("featuredb.render.loops.picture_loops")
    shape = splats.nearest.shape
    nearness, apart, depth = (np.empty(shape, np.float32) for _ in range(3))
    index, paint = np.empty(shape, np.int32), np.empty(shape, np.uint32)
    points = splats.points
    over_rows(
        lambda first, end: loops.show_splats(
            *(points.seen, points.shows, splats.nearest, planes.planes, planes.side, focal_px),
            *(nearness, apart, depth, index, paint, first, end),
        ),
        shape[0],
        threads,
    )
    return Surfaces(nearness=nearness, apart_m=apart, depth=depth, index=index, paint=paint)


def close_holes(
    surfaces: Surfaces, splats: Splats, planes: BlockPlanes, focal_px: float, threads: int
) -> Surfaces:
    """The surfaces with holes closed; depth and index are changed in place.

    A hole is a pixel that a morphological closing of nearness by a square brings to the front: it lies
    between parts of a surface on both sides of it, no wider apart than the points' distance allows. A
    straight silhouette is left where it is by a closing, so the surface does not grow over what lies
    behind it. The pixel may be empty, or show a point farther off through the surface.
    """
    loops = compiled_module("featuredb.render.loops.hole_loops")
    s = surfaces
    radii = _radii(splats, focal_px)
    closed = _closings(s.nearness, radii, threads)
    widest = _widest_m(s.apart_m, radii)
    paint = np.empty_like(s.paint)
    over_rows(
        lambda first, end: loops.close_holes(
            *(s.nearness, s.apart_m, s.paint, planes.planes, planes.side, closed, radii, widest, focal_px),
            *(_REACH_PER_SPACING, s.depth, s.index, paint, first, end),
        ),
        len(paint),
        threads,
    )
    return replace(surfaces, paint=paint)


def apart_px(splats: Splats, focal_px: float) -> NDArray[np.float32]:
    """Distance between points in pixels, of a sixteenth of the pixels that show any."""
    loops = compiled_module("featuredb.render.loops.draw_loops")
    part = splats.nearest[::4, ::4]
    seen = splats.points.seen[(part[part != loops.NOTHING] & np.uint64(0xFFFFFFFF)).astype(np.int64)]
    apart: NDArray[np.float32] = seen[:, 3] / seen[:, 2] * np.float32(focal_px)
    return apart


def block_planes(splats: Splats, typical_px: float, threads: int) -> BlockPlanes:
    """The surfaces that the points in view lie on, which are `typical_px` apart in the picture."""
    loops = compiled_module("featuredb.render.loops.plane_loops")
    height, width = splats.nearest.shape
    side = max(int(np.ceil(_BLOCK_PER_SPACING * typical_px)), _SMALLEST_BLOCK_PX)
    stride = 2 if typical_px < _DENSE_PX else 1
    blocks = -(-height // side), -(-width // side)
    moments, planes = np.zeros((*blocks, _MOMENTS)), np.empty((*blocks, 3))
    over_rows(
        lambda first, end: loops.plane_moments(
            splats.points.seen, splats.nearest, side, stride, moments, first, end
        ),
        blocks[0],
        threads,
    )
    over_rows(
        lambda first, end: loops.plane_slopes(moments, side, height, width, planes, first, end),
        blocks[0],
        threads,
    )
    return BlockPlanes(planes=planes, side=side)


def _radii(splats: Splats, focal_px: float) -> NDArray[np.int32]:
    """Radii of closings, up to what the widest spacing in the picture asks for."""
    widest = _REACH_PER_SPACING * float(apart_px(splats, focal_px).max(initial=0.0))
    return np.array([r for r in _RADII_PX if r == _RADII_PX[0] or r < widest + 0.5], np.int32)


def _closings(nearness: NDArray[np.float32], radii: NDArray[np.int32], threads: int) -> NDArray[np.float32]:
    """Grey-scale closings (k, h, w) by squares of 2 radius + 1 pixels."""
    closed = np.empty((len(radii), *nearness.shape), np.float32)

    def close(k: int) -> None:
        square = np.ones((2 * radii[k] + 1, 2 * radii[k] + 1), np.uint8)
        cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, square, dst=closed[k])

    mapped(close, range(len(radii)), threads)
    return closed


def _widest_m(apart_m: NDArray[np.float32], radii: NDArray[np.int32]) -> NDArray[np.float32]:
    """The largest distance between points within each of k radii of tiles: (k, tiles down, tiles across)."""
    tile = compiled_module("featuredb.render.loops.hole_loops").TILE_PX
    rows, columns = (np.arange(0, size, tile) for size in apart_m.shape)
    in_tile = np.maximum.reduceat(np.maximum.reduceat(apart_m, rows, axis=0), columns, axis=1)
    reach = [-(-int(r) // tile) for r in radii]
    return np.stack([cv2.dilate(in_tile, np.ones((2 * r + 1, 2 * r + 1), np.uint8)) for r in reach])
