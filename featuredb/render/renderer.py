"""Draws a point cloud as a camera with distortion sees it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module, mapped, over_rows, thread_count
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera, pixel_rays
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import CloudNodes, PointCloud
from featuredb.render.splats import FINEST_PX, NEAR_M, BlockPlanes, Splats, draw_splats, project_points


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendering:
    """A point cloud seen by a camera; pixel (row, column) has its centre at (column + 0.5, row + 0.5).

    Attributes:
        camera: whose width and height the images have, distortion included.
        cam_from_local: the pose in the frame of the cloud.
        depth: (h, w) float32, metres along the optical axis; NaN where nothing is seen.
        index: (h, w) int32, row of the cloud that the pixel shows; -1 where nothing is seen, and where a
            hole was closed from its surroundings.
        rgb: (h, w, 3) uint8 or None; zero where depth is NaN.
        intensity: (h, w) uint8 or None; zero where depth is NaN.
    """

    camera: Camera
    cam_from_local: Rigid3
    depth: NDArray[np.float32]
    index: NDArray[np.int32]
    rgb: NDArray[np.uint8] | None
    intensity: NDArray[np.uint8] | None
    points_drawn: int

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(h, w) bool: pixels that show the scan, closed holes included."""
        return np.isfinite(self.depth)


# Splats wider than this show which way they lie; then there are few, and drawing them again is cheap.
_WORTH_REDRAWING_PX = 2.5
_BORDER_SAMPLES = 33  # per side of the image; between two the border bends by less than the margin
_MARGIN = 0.02  # of the tangent, for that bend and for splats that reach in from outside
_WIDEST_TAN = 50.0  # 89 degrees: a border that sees further, or nothing at all, culls nothing on its side
_MOMENTS = 9  # of plane_loops.plane_moments
_BLOCK_PER_SPACING = 1.5  # blocks of three by three then hold about twenty points for a plane
_SMALLEST_BLOCK_PX = 4  # smaller ones cost more and see only the points' noise
_DENSE_PX = 2.0  # where nearly every pixel shows a point of its own, every fourth is enough for a plane
_RADII_PX = (1, 2, 3, 5, 8, 13, 21, 32)  # of closings; each is tried from the largest down


# Holes are closed within this share of the distance between points. Points thrown at random leave holes of up
# to about two spacings between them; half of that on each side.
_REACH_PER_SPACING = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How a cloud is drawn. For a cheaper picture ask for fewer pixels: `camera.scaled_to`.

    Attributes:
        attributes: colour and intensity too; False draws depth and index only.
        threads: 0 takes as many as the process may use, up to four.
    """

    attributes: bool = True
    threads: int = 0


def render(
    cloud: PointCloud, camera: Camera, cam_from_local: Rigid3, options: RenderOptions | None = None
) -> Rendering:
    """What the camera sees of the cloud, in colour, intensity, depth and by index.

    The same picture whatever the number of threads; safe to call from several threads at once.
    """
    options = options or RenderOptions()
    threads = thread_count(options.threads)
    rows = visible_nodes(cloud.nodes, camera, cam_from_local, near_m=NEAR_M, finest_px=FINEST_PX)
    points = project_points(cloud, rows, camera, cam_from_local, threads, attributes=options.attributes)
    splats = draw_splats(points, camera, threads)
    focal_px, planes = camera.focal_px, BlockPlanes.unknown()
    apart = apart_px(splats, focal_px)
    if len(apart):
        planes = block_planes(splats, float(np.median(apart)), threads)
        if np.quantile(apart, 0.95) > _WORTH_REDRAWING_PX:
            splats = draw_splats(points, camera, threads, planes)
    surfaces = surfaces_of(splats, planes, focal_px, threads)
    surfaces = close_holes(surfaces, splats, planes, focal_px, threads)
    rgb, intensity = _painted(surfaces.paint, cloud, options.attributes)
    return Rendering(
        camera=camera,
        cam_from_local=cam_from_local,
        depth=surfaces.depth,
        index=surfaces.index,
        rgb=rgb,
        intensity=intensity,
        points_drawn=int(points.count.sum()),
    )


def _painted(
    paint: NDArray[np.uint32], cloud: PointCloud, attributes: bool
) -> tuple[NDArray[np.uint8] | None, NDArray[np.uint8] | None]:
    """Colours (h, w, 3) and intensity (h, w), those that the cloud has and that are wanted."""
    channels = paint.astype("<u4").view(np.uint8).reshape(*paint.shape, 4)
    with_rgb, with_intensity = (attributes and of is not None for of in (cloud.rgb, cloud.intensity))
    return (
        np.ascontiguousarray(channels[..., :3]) if with_rgb else None,
        np.ascontiguousarray(channels[..., 3]) if with_intensity else None,
    )


def visible_nodes(
    nodes: CloudNodes, camera: Camera, cam_from_local: Rigid3, *, near_m: float, finest_px: float
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
    # Radii of closings, up to what the widest spacing in the picture asks for.
    widest_px = _REACH_PER_SPACING * float(apart_px(splats, focal_px).max(initial=0.0))
    radii = np.array([r for r in _RADII_PX if r == _RADII_PX[0] or r < widest_px + 0.5], np.int32)
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
