"""Draws a point cloud as a camera with distortion sees it."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import CloudNodes, PointCloud
from featuredb.render.compiled import compiled_module
from featuredb.render.culling import visible_nodes
from featuredb.render.lens import lens_vector
from featuredb.render.rendering import Rendering

_PLAN_CELLS = 256  # a side of the plan of spacings: finer than nodes at any level that matters, 256 KiB


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How a cloud is drawn.

    Attributes:
        attributes: colour and intensity too; False draws depth and index only.
        close_holes: close what lies between the splats of one surface.
        near_m: nothing closer is drawn.
        finest_px: points closer together than this in the picture are left to coarser levels.
        radius_per_spacing: radius of a splat, as a share of the distance between points.
        max_radius_px: of a splat.
        threads: 0 takes as many as the process may use, up to four.
    """

    attributes: bool = True
    close_holes: bool = True
    near_m: float = 0.3  # a camera does not stand in a wall
    finest_px: float = 0.6  # two to three points a pixel at most: more cost time and show nothing
    radius_per_spacing: float = 0.6
    max_radius_px: float = 12.0
    threads: int = 0


def render(
    cloud: PointCloud, camera: Camera, cam_from_local: Rigid3, options: RenderOptions | None = None
) -> Rendering:
    """What the camera sees of the cloud, in colour, intensity, depth and by index.

    Raises:
        MissingExtraError: numba is not installed.
    """
    options = options or RenderOptions()
    loops = compiled_module("featuredb.render.draw_loops")
    rows = visible_nodes(
        cloud.nodes, camera, cam_from_local, near_m=options.near_m, finest_px=options.finest_px
    )
    pose = np.hstack([cam_from_local.rotation, cam_from_local.translation[:, None]])
    threads = _thread_count(options.threads)
    _, index, drawn = _draw(cloud, rows, camera, pose, options, threads)
    depth = np.empty(index.shape, np.float32)
    loops.depth_of_index(cloud.xyz, index, pose, depth)
    rgb = intensity = None
    if options.attributes and cloud.rgb is not None:
        rgb = np.empty((*index.shape, 3), np.uint8)
        loops.gather_rgb(cloud.rgb, index, rgb)
    if options.attributes and cloud.intensity is not None:
        intensity = np.empty(index.shape, np.uint8)
        loops.gather_grey(cloud.intensity, index, intensity)
    return Rendering(
        camera=camera,
        cam_from_local=cam_from_local,
        depth=depth,
        index=index,
        rgb=rgb,
        intensity=intensity,
        points_drawn=drawn,
    )


def _draw(
    cloud: PointCloud,
    rows: NDArray[np.intp],
    camera: Camera,
    pose: FloatArray,
    options: RenderOptions,
    threads: int,
) -> tuple[NDArray[np.float32], NDArray[np.int32], int]:
    """Keys and indices (h, w) of the nearest splats, and how many points fell into the image."""
    loops = compiled_module("featuredb.render.draw_loops")
    nodes, lens = cloud.nodes, lens_vector(camera)
    plan, corner, cell_m = _spacing_plan(nodes, rows)
    shape = (camera.height, camera.width)

    def draw_part(part: NDArray[np.intp]) -> tuple[Any, Any, int]:
        key, index = np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int32)
        runs = np.column_stack([nodes.start[part], nodes.count[part]])
        drawn = loops.draw(
            cloud.xyz,
            runs,
            nodes.spacing_m[part],
            plan,
            corner,
            cell_m,
            pose,
            lens,
            options.near_m,
            options.radius_per_spacing,
            options.max_radius_px,
            key,
            index,
        )
        return key, index, drawn

    parts = _balanced(rows, nodes.count, threads)
    results = list(_mapped(draw_part, parts, threads))
    key, index, drawn = results[0]
    for other_key, other_index, other_drawn in results[1:]:
        loops.merge(key, index, other_key, other_index)
        drawn += other_drawn
    return key, index, drawn


def _spacing_plan(nodes: CloudNodes, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], FloatArray, float]:
    """The spacing of the finest node drawn over each cell of a plan, its corner, and its cell's edge."""
    loops = compiled_module("featuredb.render.draw_loops")
    if len(rows) == 0:
        return np.full((1, 1), np.inf, np.float32), np.zeros(2), 1.0
    low, high = nodes.box_min[rows], nodes.box_max[rows]
    # The plan covers the fine nodes, which are small; coarse ones that reach far out of it keep their own.
    fine = nodes.level[rows] == nodes.level[rows].max()
    corner = low[fine, :2].min(axis=0).astype(np.float64)
    extent = float((high[fine, :2].max(axis=0) - corner).max())
    cell_m = max(extent, 1e-3) / (_PLAN_CELLS - 1)
    plan = loops.finest_spacing(low, high, nodes.spacing_m[rows], corner, cell_m, _PLAN_CELLS)
    return plan, corner, cell_m


def _balanced(rows: NDArray[np.intp], count: NDArray[np.int64], parts: int) -> list[NDArray[np.intp]]:
    """Rows cut into runs of about equally many points."""
    ends = np.cumsum(count[rows])
    if len(ends) == 0 or parts == 1:
        return [rows]
    cuts = np.searchsorted(ends, ends[-1] * np.arange(1, parts) / parts)
    return np.split(rows, cuts)


def _mapped(function: Callable[[Any], Any], items: list[Any], threads: int) -> Iterable[Any]:
    """Results in order. Plain threads, since the loops hold no lock and OpenMP's threads forbid a fork."""
    if threads == 1 or len(items) == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


def _thread_count(wanted: int) -> int:
    if wanted < 0:
        raise InvalidValueError(f"RenderOptions.threads: expected 0 or more, found {wanted}")
    return wanted or min(len(os.sched_getaffinity(0)), 4)
