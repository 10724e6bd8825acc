"""Draws a point cloud as a camera with distortion sees it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import CloudNodes, PointCloud
from featuredb.render.rendering import Rendering
from featuredb.render.splats import FINEST_PX, NEAR_M, BlockPlanes, draw_splats, project_points
from featuredb.render.surfaces import apart_px, block_planes, close_holes, surfaces_of
from featuredb.render.threads import thread_count

# Splats wider than this show which way they lie; then there are few, and drawing them again is cheap.
_WORTH_REDRAWING_PX = 2.5
_BORDER_SAMPLES = 33  # per side of the image; between two the border bends by less than the margin
_MARGIN = 0.02  # of the tangent, for that bend and for splats that reach in from outside
_WIDEST_TAN = 50.0  # 89 degrees: a border that sees further, or nothing at all, culls nothing on its side


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
    cloud: PointCloud,
    camera: Camera,
    cam_from_local: Rigid3,
    options: RenderOptions | None = None,
) -> Rendering:
    """What the camera sees of the cloud, in colour, intensity, depth and by index.

    The same picture whatever the number of threads; safe to call from several threads at once.

    Raises:
        MissingExtraError: numba is not installed.
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
