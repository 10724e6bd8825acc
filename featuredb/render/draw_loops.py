"""Compiled loops that draw points: projection, z-buffered splats, pictures; see `compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.render.compiled import compiled

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

_ONE_PIXEL = 0.75  # a disc of this radius reaches past its pixel's neighbours' middles only in a corner


@compiled
def project(x: float, y: float, z: float, lens: Float64) -> tuple[float, float]:
    """Pixel of a point in camera axes by a lens vector; NaN behind the camera and beyond the fold."""
    if z <= 0.0:
        return np.nan, np.nan
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    r2 = u * u + v * v
    if r2 >= lens[14]:
        return np.nan, np.nan
    q, scale = r2, 1.0
    if lens[13] != 0.0 and r2 > 1e-16:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        q, scale = theta * theta, theta / r
    scale *= 1.0 + q * (lens[4] + q * (lens[5] + q * (lens[6] + q * lens[7])))
    if lens[8] != 0.0 or lens[9] != 0.0 or lens[10] != 0.0:
        scale /= 1.0 + q * (lens[8] + q * (lens[9] + q * lens[10]))
    p1, p2 = lens[11], lens[12]
    du = u * scale + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    dv = v * scale + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
    return lens[0] * du + lens[2], lens[1] * dv + lens[3]


@compiled
def project_many(points: Float64, lens: Float64) -> Float64:
    """Pixels (n, 2) of points (n, 3) in camera axes."""
    pixels = np.empty((len(points), 2))
    for i in range(len(points)):
        pixels[i] = project(points[i, 0], points[i, 1], points[i, 2], lens)
    return pixels


@compiled
def draw(
    xyz: Float32,
    runs: Int64,
    spacing: Float32,
    by_run: bool,
    planes: Float64,
    side: int,
    pose: Float64,
    lens: Float64,
    sizes: Float64,
    key: Float32,
    index: Int32,
    apart_m: Float32,
) -> int:
    """Draw runs of points into a depth buffer; returns how many fell into the image.

    A splat is a disc in the surface that `planes` tells, or facing the camera where they tell none. Its key
    grows from the disc's depth at the middle by half a spacing at the rim, so that of two splats of one
    surface each pixel takes the nearer middle, and a nearer surface still wins.

    Args:
        runs: (k, 2) first row and count.
        spacing: metres between points, (n,) for each point, or (k,) for each run if `by_run`.
        planes, side: see `picture_loops.plane_slopes`; of shape (0, 0, 3) before anything is known.
        pose: (3, 4) of cam_from_local.
        sizes: nearest depth in metres, radius per spacing, smallest spacing and largest radius in pixels.
        key, index, apart_m: (h, w), changed: infinity, -1 and anything where nothing was drawn yet; `apart_m`
            becomes the distance between points of the surface that the pixel shows.
    """
    height, width = key.shape
    near_m, per_spacing, finest_px, widest = sizes[0], sizes[1], sizes[2], sizes[3]
    focal = 0.5 * (lens[0] + lens[1])
    drawn = 0
    for k in range(len(runs)):
        for i in range(runs[k, 0], runs[k, 0] + runs[k, 1]):
            px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            if z < near_m:
                continue
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
            u, v = project(x, y, z, lens)
            if not (u > -widest and v > -widest and u < width + widest and v < height + widest):
                continue
            drawn += 1
            # What a coarser level leaves out is drawn larger by what there is.
            apart = np.float32(max(spacing[k if by_run else i], finest_px * z / focal))
            middle_x, middle_y = int(np.floor(u)), int(np.floor(v))
            if 0 <= middle_x < width and 0 <= middle_y < height:
                _put(key, index, apart_m, middle_y, middle_x, np.float32(z), i, apart)
            radius = min(per_spacing * apart * focal / z, widest)
            if radius <= _ONE_PIXEL:
                continue
            a, b = _slopes(planes, side, u, v, z, apart, focal)
            bias = 0.5 * apart / (radius * radius)
            for ty in range(
                max(int(np.ceil(v - radius - 0.5)), 0), min(int(v + radius - 0.5), height - 1) + 1
            ):
                dy = ty + 0.5 - v
                for tx in range(
                    max(int(np.ceil(u - radius - 0.5)), 0), min(int(u + radius - 0.5), width - 1) + 1
                ):
                    dx = tx + 0.5 - u
                    rise = a * dx + b * dy  # of nearness, as share of it
                    d2 = dx * dx + dy * dy + (rise * focal) ** 2
                    if d2 <= radius * radius:
                        _put(key, index, apart_m, ty, tx, np.float32(z / (1.0 + rise) + bias * d2), i, apart)
    return drawn


@compiled
def _slopes(
    planes: Float64, side: int, u: float, v: float, z: float, apart: np.float32, focal: float
) -> tuple[float, float]:
    """Slopes of nearness per pixel, as share of the point's own; zero off its block's plane."""
    row, column = int(v) // side, int(u) // side
    if not (0 <= row < planes.shape[0] and 0 <= column < planes.shape[1]):
        return 0.0, 0.0
    plane = planes[row, column]
    if not lies_on(plane, side, row, column, u, v, 1.0 / z, float(apart), focal):
        return 0.0, 0.0
    return plane[1] * z, plane[2] * z


@compiled
def lies_on(
    plane: Float64, side: int, row: int, column: int, u: float, v: float, w: float, apart: float, focal: float
) -> bool:
    """Whether a point lies on the plane of a block, to half a spacing at right angles to the plane."""
    there = plane[0] + plane[1] * (u - (column + 0.5) * side) + plane[2] * (v - (row + 0.5) * side)
    # The slope of depth per metre across the line of sight is that of nearness per pixel, times focal / w.
    slope2 = (plane[1] * plane[1] + plane[2] * plane[2]) * focal * focal
    if not slope2 < 225.0 * w * w:  # 86 degrees, or no plane at all
        return False
    return bool((there - w) ** 2 < (0.5 * apart * w) ** 2 * (w * w + slope2))


@compiled
def _put(
    key: Float32, index: Int32, apart_m: Float32, y: int, x: int, value: np.float32, i: int, apart: np.float32
) -> None:
    """Keep the nearer; of equals the lower row, so that the order of drawing does not matter."""
    if value < key[y, x] or (value == key[y, x] and i < index[y, x]):
        key[y, x] = value
        index[y, x] = i
        apart_m[y, x] = apart


@compiled
def merge(
    key: Float32, index: Int32, apart_m: Float32, other_key: Float32, other_index: Int32, other_apart: Float32
) -> None:
    """Draw another buffer into this one."""
    for y in range(key.shape[0]):
        for x in range(key.shape[1]):
            i = other_index[y, x]
            if i >= 0:
                _put(key, index, apart_m, y, x, other_key[y, x], i, other_apart[y, x])
