"""Draws points as z-buffered splats: which point each pixel shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.compiled import compiled_module
from featuredb.render.lens import lens_vector
from featuredb.render.threads import mapped


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatOptions:
    """Sizes of splats.

    Attributes:
        near_m: nothing closer is drawn.
        finest_px: points closer together than this in the picture are left to coarser levels.
        radius_per_spacing: radius of a splat, as a share of the distance between points.
        max_radius_px: of a splat.
    """

    near_m: float = 0.3  # a camera does not stand in a wall
    # Two to three points a pixel at most: more cost time and show nothing.
    finest_px: float = 0.6
    # Half a spacing leaves pinholes in a square lattice (0.71 would not), and widens silhouettes least;
    # holes are closed afterwards, where it is known on which side the surface ends.
    radius_per_spacing: float = 0.5
    # A point that would be larger stands for nothing that a camera so near would see.
    max_radius_px: float = 24.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockPlanes:
    """Surfaces in blocks of side x side pixels.

    Attributes:
        planes: (blocks down, blocks across, 3) float64: nearness (1/m) at the block's middle and its slopes
            per pixel across and down; NaN where unknown. Of shape (0, 0, 3) before anything is known.
        side: pixels.
    """

    planes: FloatArray
    side: int


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
    surface: BlockPlanes | None = None,
) -> Splats:
    """Draw the nodes `rows` of a cloud; the result does not depend on the number of threads.

    Where a surface is given, splats lie in it; else they face the camera.
    """
    loops = compiled_module("featuredb.render.draw_loops")
    nodes, lens = cloud.nodes, lens_vector(camera)
    pose = cam_from_local.matrix()[:3]
    shape = (camera.height, camera.width)
    known = surface or BlockPlanes(planes=np.empty((0, 0, 3)), side=1)
    # Nodes of points less than this apart are not drawn, so what is drawn may be twice as far apart.
    sizes = np.array(
        [options.near_m, options.radius_per_spacing, 2.0 * options.finest_px, options.max_radius_px]
    )

    def draw_part(part: NDArray[np.intp]) -> Splats:
        key, index = np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int32)
        apart = np.empty(shape, np.float32)
        runs = np.column_stack([nodes.start[part], nodes.count[part]])
        by_run = cloud.spacing_m is None
        spacing = nodes.spacing_m[part] if cloud.spacing_m is None else cloud.spacing_m
        drawn = loops.draw(
            cloud.xyz, runs, spacing, by_run, known.planes, known.side, pose, lens, sizes, key, index, apart
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


def _balanced(rows: NDArray[np.intp], count: NDArray[np.int64], parts: int) -> list[NDArray[np.intp]]:
    """Rows cut into runs of about equally many points."""
    ends = np.cumsum(count[rows])
    if len(ends) == 0 or parts == 1:
        return [rows]
    cuts = np.searchsorted(ends, ends[-1] * np.arange(1, parts) / parts)
    return np.split(rows, cuts)
