"""Draws points as z-buffered splats: which point each pixel shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import CloudNodes, PointCloud
from featuredb.render.compiled import compiled_module
from featuredb.render.lens import lens_vector
from featuredb.render.threads import mapped

_PLAN_CELLS = 256  # a side of the plan of spacings: finer than the nodes in view, and it stays in the cache


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatOptions:
    """Sizes of splats.

    Attributes:
        near_m: nothing closer is drawn.
        radius_per_spacing: radius of a splat, as a share of the distance between points.
        max_radius_px: of a splat.
    """

    near_m: float = 0.3  # a camera does not stand in a wall
    # Half a spacing leaves pinholes in a square lattice (0.71 would not), and widens silhouettes least;
    # holes are closed afterwards, where it is known on which side the surface ends.
    radius_per_spacing: float = 0.5
    # A point that would be larger stands for nothing that a camera so near would see.
    max_radius_px: float = 12.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splats:
    """What is nearest in each pixel.

    Attributes:
        key: (h, w) float32, the depth that decided, metres; infinity where nothing is.
        index: (h, w) int32 rows of the cloud, -1 where nothing is.
        apart_m: (h, w) float32, distance between points of the surface seen; undefined where nothing is.
        points_drawn: points that fell into the image.
    """

    key: NDArray[np.float32]
    index: NDArray[np.int32]
    apart_m: NDArray[np.float32]
    points_drawn: int


def draw_splats(
    cloud: PointCloud,
    rows: NDArray[np.intp],
    camera: Camera,
    cam_from_local: Rigid3,
    options: SplatOptions,
    threads: int,
) -> Splats:
    """Draw the nodes `rows` of a cloud; the result does not depend on the number of threads."""
    loops = compiled_module("featuredb.render.draw_loops")
    nodes, lens = cloud.nodes, lens_vector(camera)
    pose = cam_from_local.matrix()[:3]
    plan, corner, cell_m = _spacing_plan(nodes, rows)
    shape = (camera.height, camera.width)

    def draw_part(part: NDArray[np.intp]) -> Splats:
        key, index = np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int32)
        apart = np.empty(shape, np.float32)
        runs = np.column_stack([nodes.start[part], nodes.count[part]])
        sizes = options.near_m, options.radius_per_spacing, options.max_radius_px
        where = plan, corner, cell_m
        drawn = loops.draw(
            cloud.xyz, runs, nodes.spacing_m[part], *where, pose, lens, *sizes, key, index, apart
        )
        return Splats(key=key, index=index, apart_m=apart, points_drawn=drawn)

    splats, *others = mapped(draw_part, _balanced(rows, nodes.count, threads), threads)
    for other in others:
        loops.merge(splats.key, splats.index, splats.apart_m, other.key, other.index, other.apart_m)
    return Splats(
        key=splats.key,
        index=splats.index,
        apart_m=splats.apart_m,
        points_drawn=splats.points_drawn + sum(other.points_drawn for other in others),
    )


def _spacing_plan(nodes: CloudNodes, rows: NDArray[np.intp]) -> tuple[NDArray[np.float32], FloatArray, float]:
    """The spacing of the finest node drawn over each cell of a plan, its corner, and its cell's edge.

    Points of a coarse node lie among those of finer ones, and where these are drawn too its splats must
    be no larger than theirs.
    """
    loops = compiled_module("featuredb.render.draw_loops")
    if len(rows) == 0:
        return np.full((1, 1), np.inf, np.float32), np.zeros(2), 1.0
    low, high = nodes.box_min[rows], nodes.box_max[rows]
    # The plan covers the finest nodes; where coarser ones reach out of it, they are not among finer ones.
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
