"""Draws points as z-buffered splats: which point each pixel shows."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module, mapped
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud

NEAR_M = 0.3  # nothing closer is drawn: a camera does not stand in a wall
# Points closer together than this in the picture are left to coarser levels: two to three points a pixel at
# most, more cost time and show nothing.
FINEST_PX = 0.6
# Radius of a splat as a share of the distance between points. Half a spacing leaves pinholes in a square
# lattice (0.71 would not), and widens silhouettes least; holes are closed afterwards, where it is known on
# which side the surface ends.
_RADIUS_PER_SPACING = 0.5
# A point that would be larger stands for nothing that a camera so near would see.
_MAX_RADIUS_PX = 24.0
# fx, fy, cx, cy; numerator k1..k4 and denominator k1..k3 of the radial factor; tangential p1, p2;
# 1 for a fisheye; square of the tangent beyond which the lens sees nothing.
LENS_SIZE: Final = 15
FISHEYE: Final = 13
FOLD: Final = 14


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockPlanes:
    """Surfaces in blocks of side x side pixels.

    Attributes:
        planes: (blocks down, blocks across, 3) float64: nearness (1/m) at the block's middle and its slopes
            per pixel across and down; NaN where unknown. Of shape (0, 0, 3) before anything is known.
    """

    planes: FloatArray
    side: int

    @classmethod
    def unknown(cls) -> "BlockPlanes":
        return cls(planes=np.empty((0, 0, 3)), side=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProjectedPoints:
    """The points of a cloud that fall into a picture, in slots; each node has as many as it has points.

    Attributes:
        seen: (m, 4) float32 of each slot: pixel u, v, depth in metres, distance to the neighbours in metres.
        shows: (m, 2) uint32 of each slot: row of the cloud, and what it is painted with, see draw_loops.
        first, count: (k,) int64, the slots of each node that hold points; the others hold nothing.
    """

    seen: NDArray[np.float32]
    shows: NDArray[np.uint32]
    first: NDArray[np.int64]
    count: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splats:
    """What is nearest in each pixel.

    Attributes:
        nearest: (h, w) uint64 z-buffer of their slots, see draw_loops.
    """

    points: ProjectedPoints
    nearest: NDArray[np.uint64]


def project_points(
    cloud: PointCloud,
    rows: NDArray[np.intp],
    camera: Camera,
    cam_from_local: Rigid3,
    threads: int,
    *,
    attributes: bool = True,
) -> ProjectedPoints:
    """Where the points of the nodes `rows` fall into the picture, and with `attributes` their paint."""
    loops = compiled_module("featuredb.render.loops.draw_loops")
    nodes, by_run = cloud.nodes, cloud.spacing_m is None
    runs = np.column_stack([nodes.start[rows], nodes.count[rows]])
    ends = np.cumsum(runs[:, 1])
    first = ends - runs[:, 1]
    room = int(ends[-1]) if len(ends) else 0
    seen, shows = np.empty((room, 4), np.float32), np.empty((room, 2), np.uint32)
    pose = tuple(cam_from_local.matrix()[:3].ravel().tolist())
    lens, widest = lens_numbers(camera), _MAX_RADIUS_PX
    bounds = (-widest, camera.width + widest, -widest, camera.height + widest)
    spacing = nodes.spacing_m[rows] if cloud.spacing_m is None else cloud.spacing_m
    none = np.empty(0, np.uint8)
    rgb = cloud.rgb if attributes and cloud.rgb is not None else none.reshape(0, 3)
    intensity = cloud.intensity if attributes and cloud.intensity is not None else none
    # Nodes of points less than this apart are not drawn, so what is drawn may be twice as far apart.
    finest = 2.0 * FINEST_PX

    def project(part: slice) -> NDArray[np.int64]:
        own = spacing[part] if by_run else spacing
        kept: NDArray[np.int64] = loops.project_runs(
            *(cloud.xyz, runs[part], first[part], own, by_run, pose, lens),
            *(NEAR_M, finest, bounds, rgb, intensity, seen, shows),
        )
        return kept

    count = np.concatenate(mapped(project, _balanced(runs[:, 1], threads), threads))
    return ProjectedPoints(seen=seen, shows=shows, first=first, count=count)


def draw_splats(
    points: ProjectedPoints, camera: Camera, threads: int, surface: BlockPlanes | None = None
) -> Splats:
    """Draw projected points; the result does not depend on the number of threads.

    Where a surface is given, splats lie in it; else they face the camera.
    """
    loops = compiled_module("featuredb.render.loops.draw_loops")
    known = surface or BlockPlanes.unknown()

    def draw_part(part: slice) -> NDArray[np.uint64]:
        nearest = np.full((camera.height, camera.width), loops.NOTHING)
        loops.draw(
            *(points.seen, points.first[part], points.count[part], known.planes, known.side),
            *(camera.focal_px, _RADIUS_PER_SPACING, _MAX_RADIUS_PX, nearest),
        )
        return nearest

    nearest, *others = mapped(draw_part, _balanced(points.count, threads), threads)

    for other in others:
        np.minimum(nearest, other, out=nearest)
    return Splats(points=points, nearest=nearest)


def _balanced(count: NDArray[np.int64], parts: int) -> list[slice]:
    """Nodes cut into runs of about equally many points."""
    ends = np.cumsum(count)
    if len(ends) == 0 or parts == 1:
        return [slice(0, len(ends))]
    cuts = [0, *np.searchsorted(ends, ends[-1] * np.arange(1, parts) / parts).tolist(), len(ends)]
    return [slice(first, end) for first, end in pairwise(cuts)]


def lens_numbers(camera: Camera) -> tuple[float, ...]:
    """LENS_SIZE numbers of a camera: focal lengths, principal point, distortion, fold limit.

    The radial factor is (1 + n1 q + n2 q^2 + n3 q^3 + n4 q^4) / (1 + d1 q + d2 q^2 + d3 q^3), q being the
    squared tangent of the angle off the axis, or the squared angle in a fisheye.
    """
    p, one_focal = camera.params, "SIMPLE" in camera.model or "RADIAL" in camera.model
    fx, fy, cx, cy, *k = (p[0], *p) if one_focal else p
    lens = np.zeros(LENS_SIZE)
    lens[:4] = fx, fy, cx, cy
    if camera.model == "OPENCV":
        lens[4:6], lens[11:13] = k[:2], k[2:4]
    elif camera.model == "FULL_OPENCV":
        lens[4:7], lens[11:13], lens[8:11] = (k[0], k[1], k[4]), k[2:4], k[5:8]
    else:
        lens[4 : 4 + len(k)] = k
    lens[FISHEYE] = "FISHEYE" in camera.model
    lens[FOLD] = camera.tan_of_fold**2
    return tuple(lens.tolist())
