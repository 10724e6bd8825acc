"""Compiled loops over pixels: depth, closing of holes, colours; see `compiled_module`.

Depths are handled as their inverses, "nearness": zero is nothing at all, and planes are linear in the pixel.
Every loop works on rows `first` to `end` of the picture, so that threads can share it.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.render.compiled import compiled
from featuredb.render.draw_loops import lies_on, project

Bytes = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

_SAME_SURFACE = 2.0  # spacings in depth between neighbouring points of one surface, however steep
_MOMENTS = 9  # n, u, v, uu, uv, vv, w, uw, vw


@compiled
def nearness_of_index(
    xyz: Float32, index: Int32, pose: Float64, nearness: Float32, first: int, end: int
) -> None:
    """Fill nearness (h, w) from each pixel's point; zero where there is none."""
    for y in range(first, end):
        for x in range(index.shape[1]):
            i = index[y, x]
            nearness[y, x] = 0.0
            if i >= 0:
                nearness[y, x] = 1.0 / (
                    pose[2, 0] * xyz[i, 0] + pose[2, 1] * xyz[i, 1] + pose[2, 2] * xyz[i, 2] + pose[2, 3]
                )


@compiled
def plane_moments(
    xyz: Float32,
    index: Int32,
    pose: Float64,
    lens: Float64,
    side: int,
    moments: Float64,
    first: int,
    end: int,
) -> None:
    """Add up, per block of side x side pixels, the moments of the points that lie in pixels showing them.

    Args:
        moments: (blocks down, blocks across, 9) changed; u and v from the block's middle, w is nearness.
        first, end: rows of blocks.
    """
    height, width = index.shape
    for y in range(first * side, min(end * side, height)):
        for x in range(width):
            i = index[y, x]
            if i < 0:
                continue
            u, v, w = _seen_at(xyz, i, pose, lens)
            if not (int(np.floor(u)) == x and int(np.floor(v)) == y):
                continue
            m = moments[y // side, x // side]
            u -= (x // side + 0.5) * side
            v -= (y // side + 0.5) * side
            m[0] += 1.0
            m[1] += u
            m[2] += v
            m[3] += u * u
            m[4] += u * v
            m[5] += v * v
            m[6] += w
            m[7] += u * w
            m[8] += v * w


@compiled
def _seen_at(xyz: Float32, i: int, pose: Float64, lens: Float64) -> tuple[float, float, float]:
    """Pixel and nearness of a point."""
    px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    u, v = project(x, y, z, lens)
    return u, v, 1.0 / z


@compiled
def plane_slopes(moments: Float64, side: int, planes: Float64, first: int, end: int) -> None:
    """Fit each block's plane of nearness to the points of the block and those around it.

    Args:
        planes: (blocks down, blocks across, 3) changed: nearness at the block's middle and its slopes across
            and down; NaN where even three blocks around hold too few points.
        first, end: rows of blocks.
    """
    for by in range(first, end):
        for bx in range(moments.shape[1]):
            planes[by, bx] = np.nan
            for reach in range(1, 4):
                t = _moments_around(moments, side, by, bx, reach)
                if t[0] >= 8.0:  # three make a plane; with eight one stray point does not turn it
                    _fit_plane(t, planes[by, bx])
                    break


@compiled
def _moments_around(moments: Float64, side: int, by: int, bx: int, reach: int) -> Float64:
    """Sum of the moments of the blocks within `reach`, about the middle of block (by, bx)."""
    t = np.zeros(9)
    for ny in range(max(by - reach, 0), min(by + reach + 1, moments.shape[0])):
        for nx in range(max(bx - reach, 0), min(bx + reach + 1, moments.shape[1])):
            m = moments[ny, nx]
            if m[0] == 0.0:
                continue
            du, dv = (nx - bx) * side, (ny - by) * side
            t[0] += m[0]
            t[1] += m[1] + du * m[0]
            t[2] += m[2] + dv * m[0]
            t[3] += m[3] + 2.0 * du * m[1] + du * du * m[0]
            t[4] += m[4] + du * m[2] + dv * m[1] + du * dv * m[0]
            t[5] += m[5] + 2.0 * dv * m[2] + dv * dv * m[0]
            t[6] += m[6]
            t[7] += m[7] + du * m[6]
            t[8] += m[8] + dv * m[6]
    return t


@compiled
def _fit_plane(t: Float64, plane: Float64) -> None:
    """Least squares from moments; the plane stays as it is where the points lie on a line."""
    n = t[0]
    suu, suv, svv = t[3] - t[1] * t[1] / n, t[4] - t[1] * t[2] / n, t[5] - t[2] * t[2] / n
    suw, svw = t[7] - t[1] * t[6] / n, t[8] - t[2] * t[6] / n
    det = suu * svv - suv * suv
    if det > 1e-3 * suu * svv:
        plane[1] = (svv * suw - suv * svw) / det
        plane[2] = (suu * svw - suv * suw) / det
        plane[0] = (t[6] - plane[1] * t[1] - plane[2] * t[2]) / n


@compiled
def tilt_splats(
    xyz: Float32,
    index: Int32,
    apart_m: Float32,
    pose: Float64,
    lens: Float64,
    planes: Float64,
    side: int,
    nearness: Float32,
    first: int,
    end: int,
) -> None:
    """Tilt each splat along its block's plane, where its own point lies on that plane."""
    focal = 0.5 * (lens[0] + lens[1])
    for y in range(first, end):
        for x in range(index.shape[1]):
            i = index[y, x]
            plane = planes[y // side, x // side]
            if i < 0 or not np.isfinite(plane[0]):
                continue
            u, v, w = _seen_at(xyz, i, pose, lens)
            if lies_on(plane, side, y // side, x // side, u, v, w, apart_m[y, x], focal):
                # Beyond half of its own, a change of nearness comes from a plane that does not reach so far.
                change = plane[1] * (x + 0.5 - u) + plane[2] * (y + 0.5 - v)
                nearness[y, x] = w + max(-0.5 * w, min(0.5 * w, change))


@compiled
def close_holes(
    nearness: Float32,
    apart_m: Float32,
    closed: Float32,
    radii: Int32,
    focal: float,
    reach_per_spacing: float,
    filled: Float32,
    source: Int32,
    first: int,
    end: int,
) -> None:
    """Find pixels between splats of one surface, empty or showing what lies behind, and their nearness.

    Args:
        closed: (k, h, w) morphological closings of `nearness` by squares of the k growing radii.
        reach_per_spacing: the widest radius that may close a hole, as a share of the points' distance.
        filled: (h, w) changed: `nearness`, or that of the surface which closes the hole.
        source: (h, w) changed: 0, or the radius within which the surface's pixels lie.
    """
    for y in range(first, end):
        for x in range(nearness.shape[1]):
            own = nearness[y, x]
            filled[y, x] = own
            source[y, x] = 0
            for k in range(len(radii) - 1, -1, -1):
                level = closed[k, y, x]
                if level <= own:
                    break  # closings by smaller squares are lower still
                if own > 0.0 and 1.0 / own - 1.0 / level < _SAME_SURFACE * apart_m[y, x]:
                    break
                value, apart = _surface_around(nearness, apart_m, y, x, radii[k], level)
                if value == 0.0 or reach_per_spacing * apart * focal * level < radii[k] - 0.5:
                    continue
                if own > 0.0 and 1.0 / own - 1.0 / value < _SAME_SURFACE * apart:
                    continue
                filled[y, x] = value
                source[y, x] = radii[k]
                break


@compiled
def _surface_around(
    nearness: Float32, apart_m: Float32, y: int, x: int, radius: int, level: float
) -> tuple[float, float]:
    """Weighted mean nearness of the pixels around that lie on the surface at `level`, and their spacing."""
    total, value, apart = 0.0, 0.0, 0.0
    step = 1 + radius // 5
    for ny in range(y - radius, y + radius + 1, step):
        for nx in range(x - radius, x + radius + 1, step):
            if not (0 <= ny < nearness.shape[0] and 0 <= nx < nearness.shape[1]):
                continue
            w = nearness[ny, nx]
            if w > 0.0 and abs(1.0 / w - 1.0 / level) < _SAME_SURFACE * apart_m[ny, nx]:
                weight = _weight(ny - y, nx - x)
                total += weight
                value += weight * w
                apart += weight * apart_m[ny, nx]
    if total == 0.0:
        return 0.0, 0.0
    return value / total, apart / total


@compiled
def _weight(dy: int, dx: int) -> float:
    return 1.0 / (0.5 + dy * dy + dx * dx) ** 2


@compiled
def paint(
    values: Bytes,
    index: Int32,
    nearness: Float32,
    filled: Float32,
    apart_m: Float32,
    source: Int32,
    picture: Bytes,
    first: int,
    end: int,
) -> None:
    """Fill picture (h, w, c) with the values (n, c) of the pixels' points; closed holes from around them."""
    total = np.zeros(values.shape[1])
    for y in range(first, end):
        for x in range(index.shape[1]):
            radius, i = source[y, x], index[y, x]
            if radius == 0:
                for c in range(values.shape[1]):
                    picture[y, x, c] = values[i, c] if i >= 0 else 0
                continue
            weights = 0.0
            total[:] = 0.0
            step = 1 + radius // 5  # a hundred or so of the pixels around are enough
            for ny in range(y - radius, y + radius + 1, step):
                for nx in range(x - radius, x + radius + 1, step):
                    if not (0 <= ny < index.shape[0] and 0 <= nx < index.shape[1]):
                        continue
                    j, w = index[ny, nx], nearness[ny, nx]
                    if j < 0 or abs(1.0 / w - 1.0 / filled[y, x]) >= 2.0 * _SAME_SURFACE * apart_m[ny, nx]:
                        continue
                    weight = _weight(ny - y, nx - x)
                    weights += weight
                    for c in range(values.shape[1]):
                        total[c] += weight * values[j, c]
            for c in range(values.shape[1]):
                picture[y, x, c] = np.uint8(total[c] / weights + 0.5) if weights > 0.0 else 0


@compiled
def finish(filled: Float32, source: Int32, index: Int32, depth: Float32, first: int, end: int) -> None:
    """Depth from nearness, NaN where nothing is; the index of closed holes becomes -1."""
    for y in range(first, end):
        for x in range(index.shape[1]):
            depth[y, x] = 1.0 / filled[y, x] if filled[y, x] > 0.0 else np.nan
            if source[y, x] > 0:
                index[y, x] = -1
