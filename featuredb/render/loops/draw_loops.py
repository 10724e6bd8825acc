"""Compiled loops that draw points: projection, z-buffered splats; see `compiled_module`.

A z-buffer holds one 64-bit number per pixel: the bits of the depth that decides above the slot of the point,
so that the smaller number is the nearer point and of equals the lower slot: the order of drawing does not
matter.

What is called for every point or pixel takes numbers, not arrays: a call with an array counts who holds it,
with atomic additions that threads fight over.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled

Bytes = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt32 = NDArray[np.uint32]
UInt64 = NDArray[np.uint64]
Lens = tuple[float, ...]

NOTHING = np.uint64(0xFFFFFFFFFFFFFFFF)  # a pixel of the z-buffer where nothing was drawn
_LOW_HALF = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_ONE_PIXEL = 0.75  # a disc of this radius reaches past its pixel's neighbours' middles only in a corner
_AT_ONCE = 256  # points that are projected together: their numbers stay in the fastest cache


@compiled
def project(x: float, y: float, z: float, lens: Lens) -> tuple[float, float]:
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
    return _through_lens(u, v, r2, q, scale, lens)


@compiled
def _through_lens(u: float, v: float, r2: float, q: float, scale: float, lens: Lens) -> tuple[float, float]:
    """Pixel of a direction (u, v, 1) of squared length r2 + 1; q is what the radial factor is a series of."""
    scale *= 1.0 + q * (lens[4] + q * (lens[5] + q * (lens[6] + q * lens[7])))
    scale /= 1.0 + q * (lens[8] + q * (lens[9] + q * lens[10]))
    p1, p2 = lens[11], lens[12]
    du = u * scale + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    dv = v * scale + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v)
    return lens[0] * du + lens[2], lens[1] * dv + lens[3]


@compiled
def project_runs(
    xyz: Float32,
    runs: Int64,
    slots: Int64,
    spacing: Float32,
    by_run: bool,
    pose: Lens,
    lens: Lens,
    near_m: float,
    finest_px: float,
    bounds: tuple[float, float, float, float],
    rgb: Bytes,
    intensity: Bytes,
    seen: Float32,
    shows: UInt32,
) -> Int64:
    """Project runs of points; keep those in the picture. Returns (k,) how many of each run.

    Args:
        runs: (k, 2) first row and count.
        slots: (k,) where in `seen` and `shows` the points of each run begin.
        spacing: metres between points, (n,) for each point, or (k,) for each run if `by_run`.
        pose: the twelve numbers of the 3x4 matrix of cam_from_local, row by row.
        near_m: nothing nearer is kept.
        finest_px: points closer together in the picture stand for points left out, and count as so far apart.
        bounds: lowest and highest u, lowest and highest v that are kept.
        rgb, intensity: (n, 3) and (n,) of the cloud; empty where they are not wanted.
        seen: (m, 4) changed: pixel u, v, depth in metres, distance to the neighbouring points in metres.
        shows: (m, 2) changed: row of the cloud; red, green, blue and intensity from the lowest byte up.
    """
    kept = np.zeros(len(runs), np.int64)
    u, v, z = np.empty(_AT_ONCE), np.empty(_AT_ONCE), np.empty(_AT_ONCE)
    per_depth = finest_px / (0.5 * (lens[0] + lens[1]))
    for k in range(len(runs)):
        slot, end = slots[k], runs[k, 0] + runs[k, 1]
        for first in range(runs[k, 0], end, _AT_ONCE):
            n = min(_AT_ONCE, end - first)
            _project_block(xyz[first : first + n], pose, lens, u, v, z)
            for j in range(n):
                if not (
                    z[j] >= near_m
                    and u[j] > bounds[0]
                    and u[j] < bounds[1]
                    and v[j] > bounds[2]
                    and v[j] < bounds[3]
                ):
                    continue
                seen[slot, 0] = u[j]
                seen[slot, 1] = v[j]
                seen[slot, 2] = z[j]
                shows[slot, 0] = first + j
                slot += 1
        # In loops of their own, which keeps the one above fast.
        for s in range(slots[k], slot):
            apart = spacing[k] if by_run else spacing[shows[s, 0]]
            # What a coarser level leaves out is drawn larger by what there is.
            seen[s, 3] = max(np.float64(apart), per_depth * seen[s, 2])
        _paint(rgb, intensity, shows[slots[k] : slot])
        kept[k] = slot - slots[k]
    return kept


@compiled
def _paint(rgb: Bytes, intensity: Bytes, shows: UInt32) -> None:
    """Fill the second column with colours and intensity of the rows in the first."""
    shows[:, 1] = 0
    if len(rgb):
        for s in range(len(shows)):
            i = shows[s, 0]
            shows[s, 1] = rgb[i, 0] | np.int64(rgb[i, 1]) << 8 | np.int64(rgb[i, 2]) << 16
    if len(intensity):
        for s in range(len(shows)):
            shows[s, 1] |= np.int64(intensity[shows[s, 0]]) << 24


@compiled
def _project_block(points: Float32, pose: Lens, lens: Lens, u: Float64, v: Float64, z: Float64) -> None:
    """Fill u, v and z; where the lens sees nothing, z is negative. No branches, so that it vectorises."""
    if lens[13] != 0.0:
        for j in range(len(points)):
            x, y, depth = _in_camera(points[j, 0], points[j, 1], points[j, 2], pose)
            u[j], v[j] = project(x, y, depth, lens)
            z[j] = depth
        return
    for j in range(len(points)):
        u[j], v[j], z[j] = _in_camera(points[j, 0], points[j, 1], points[j, 2], pose)
    for j in range(len(points)):
        inverse = 1.0 / z[j]
        a, b = u[j] * inverse, v[j] * inverse
        r2 = a * a + b * b
        u[j], v[j] = _through_lens(a, b, r2, r2, 1.0, lens)
        z[j] = z[j] if r2 < lens[14] else -1.0


@compiled
def _in_camera(px: float, py: float, pz: float, pose: Lens) -> tuple[float, float, float]:
    return (
        pose[0] * px + pose[1] * py + pose[2] * pz + pose[3],
        pose[4] * px + pose[5] * py + pose[6] * pz + pose[7],
        pose[8] * px + pose[9] * py + pose[10] * pz + pose[11],
    )


@compiled
def draw(
    seen: Float32,
    slots: Int64,
    kept: Int64,
    planes: Float64,
    side: int,
    focal: float,
    per_spacing: float,
    widest: float,
    nearest: UInt64,
) -> None:
    """Draw runs of projected points into a z-buffer.

    A splat is a disc in the surface that `planes` tells, or facing the camera where they tell none. Its key
    grows from the disc's depth at the middle by half a spacing at the rim, so that of two splats of one
    surface each pixel takes the nearer middle, and a nearer surface still wins.

    Args:
        seen: see `project_runs`.
        slots, kept: (k,) of each run.
        planes, side: see `plane_loops.plane_slopes`; of shape (0, 0, 3) before anything is known.
        per_spacing, widest: radius of a splat per spacing, and at most, in pixels.
        nearest: (h, w) changed.
    """
    height, width = nearest.shape
    per_side = 1.0 / side
    for k in range(len(slots)):
        for slot in range(slots[k], slots[k] + kept[k]):
            u, v = np.float64(seen[slot, 0]), np.float64(seen[slot, 1])
            z, apart = np.float64(seen[slot, 2]), np.float64(seen[slot, 3])
            middle_x, middle_y = int(np.floor(u)), int(np.floor(v))
            if 0 <= middle_x < width and 0 <= middle_y < height:
                nearest[middle_y, middle_x] = min(nearest[middle_y, middle_x], _packed(z, slot))
            radius = min(per_spacing * apart * focal / z, widest)
            if radius <= _ONE_PIXEL:
                continue
            # Slopes of nearness per pixel, as share of the point's own; zero off its block's plane.
            a, b = 0.0, 0.0
            row, column = int(v * per_side), int(u * per_side)
            if 0 <= row < planes.shape[0] and 0 <= column < planes.shape[1]:
                at, slope_u, slope_v = planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]
                du, dv = u - (column + 0.5) * side, v - (row + 0.5) * side
                if lies_on(at, slope_u, slope_v, du, dv, 1.0 / z, apart, focal):
                    a, b = slope_u * z, slope_v * z
            bias, radius2 = 0.5 * apart / (radius * radius), radius * radius
            first_x = max(int(np.ceil(u - radius - 0.5)), 0)
            end_x = min(int(u + radius - 0.5), width - 1) + 1
            first_y = max(int(np.ceil(v - radius - 0.5)), 0)
            end_y = min(int(v + radius - 0.5), height - 1) + 1
            for ty in range(first_y, end_y):
                dy = ty + 0.5 - v
                for tx in range(first_x, end_x):
                    dx = tx + 0.5 - u
                    rise = a * dx + b * dy  # of nearness, as share of it
                    d2 = dx * dx + dy * dy + (rise * focal) * (rise * focal)
                    packed = _packed(z / (1.0 + rise) + bias * d2, slot)
                    # Without a branch that nobody could foretell.
                    packed = packed if d2 <= radius2 else NOTHING
                    nearest[ty, tx] = min(nearest[ty, tx], packed)


@compiled
def _packed(key: float, slot: int) -> np.uint64:
    return (np.uint64(np.float32(key).view(np.uint32)) << _HALF) | np.uint64(slot)


@compiled
def lies_on(
    at: float, slope_u: float, slope_v: float, du: float, dv: float, w: float, apart: float, focal: float
) -> bool:
    """Whether a point of nearness w lies on a plane of nearness, to half a spacing at right angles to it.

    Args:
        at, slope_u, slope_v: nearness in the middle of the plane's block and its slopes; NaN where unknown.
        du, dv: pixels from that middle to the point.
    """
    # The slope of depth per metre across the line of sight is that of nearness per pixel, times focal / w.
    slope2 = (slope_u * slope_u + slope_v * slope_v) * focal * focal
    if not slope2 < 225.0 * w * w:  # 86 degrees, or no plane at all
        return False
    off = at + slope_u * du + slope_v * dv - w
    return bool(off * off < (0.5 * apart * w) ** 2 * (w * w + slope2))


@compiled
def slot_of(packed: np.uint64) -> np.int64:
    """The slot in a pixel of a z-buffer that is not NOTHING."""
    return np.int64(packed & _LOW_HALF)
