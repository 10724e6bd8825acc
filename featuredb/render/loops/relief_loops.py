"""Compiled loop that shades a depth image; see `compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.render.compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@compiled
def shade(
    depth: Float32,
    rays_x: Float32,
    rays_y: Float32,
    to_light: Float64,
    step: int,
    steepest: float,
    ambient: float,
    picture: NDArray[np.uint8],
    first: int,
    end: int,
) -> None:
    """Lambert's law on normals from differences over `step` pixels, on rows `first` to `end`.

    Args:
        rays_x, rays_y: (h, w), pixel rays (x, y, 1).
        to_light: (3,) unit vector, camera axes.
        steepest: change of depth per metre across the line of sight that still is one surface.
        ambient: share of the light that falls from everywhere.
        picture: (h, w) changed; zero where no normal can be had.
    """
    for y in range(first, end):
        for x in range(depth.shape[1]):
            picture[y, x] = 0
            if not depth[y, x] > 0.0:
                continue
            ax, ay, az = _difference(depth, rays_x, rays_y, y, x, 0, step, steepest)
            bx, by, bz = _difference(depth, rays_x, rays_y, y, x, step, 0, steepest)
            # Across times down points away from the camera (x right, y down, z forward).
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            if norm > 0.0:
                lit = (nx * to_light[0] + ny * to_light[1] + nz * to_light[2]) / norm
                light = ambient + (1.0 - ambient) * max(lit, 0.0)
                picture[y, x] = max(1, int(255.0 * light + 0.5))


@compiled
def _difference(
    depth: Float32, rays_x: Float32, rays_y: Float32, y: int, x: int, dy: int, dx: int, steepest: float
) -> tuple[float, float, float]:
    """The step in space along a surface from before a pixel to behind it; zero where it has no neighbours.

    Of the two halves the one across a depth edge is left out.
    """
    z = depth[y, x]
    before_y, before_x, after_y, after_x = y, x, y, x
    if _same_surface(depth, rays_x, rays_y, y, x, y - dy, x - dx, steepest):
        before_y, before_x = y - dy, x - dx
    if _same_surface(depth, rays_x, rays_y, y, x, y + dy, x + dx, steepest):
        after_y, after_x = y + dy, x + dx
    z0, z1 = depth[before_y, before_x], depth[after_y, after_x]
    if before_y == after_y and before_x == after_x:
        z0 = z1 = z
    return (
        rays_x[after_y, after_x] * z1 - rays_x[before_y, before_x] * z0,
        rays_y[after_y, after_x] * z1 - rays_y[before_y, before_x] * z0,
        z1 - z0,
    )


@compiled
def _same_surface(
    depth: Float32, rays_x: Float32, rays_y: Float32, y: int, x: int, ny: int, nx: int, steepest: float
) -> bool:
    if not (0 <= ny < depth.shape[0] and 0 <= nx < depth.shape[1] and depth[ny, nx] > 0.0):
        return False
    z = depth[y, x]
    across = z * np.hypot(rays_x[ny, nx] - rays_x[y, x], rays_y[ny, nx] - rays_y[y, x])
    return bool(abs(depth[ny, nx] - z) < steepest * across)
