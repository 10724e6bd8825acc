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
def plane_moments(
    xyz: Float32,
    index: Int32,
    pose: Float64,
    lens: Float64,
    side: int,
    stride: int,
    moments: Float64,
    first: int,
    end: int,
) -> None:
    """Add up, per block of side x side pixels, the moments of the points that lie in pixels showing them.

    Args:
        stride: every how many-th pixel is asked.
        moments: (blocks down, blocks across, 9) changed; u and v from the block's middle, w is nearness.
        first, end: rows of blocks.
    """
    height, width = index.shape
    for y in range(first * side, min(end * side, height), stride):
        for x in range((y // stride) % stride, width, stride):
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
def splat_nearness(
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
    """Fill nearness (h, w) from each pixel's point; zero where there is none.

    Where the point lies on its block's plane, the splat is tilted along it.
    """
    focal = 0.5 * (lens[0] + lens[1])
    for y in range(first, end):
        row = y // side
        for x in range(index.shape[1]):
            i = index[y, x]
            if i < 0:
                nearness[y, x] = 0.0
                continue
            u, v, w = _seen_at(xyz, i, pose, lens)
            nearness[y, x] = w
            column = x // side
            if row < planes.shape[0] and column < planes.shape[1]:
                plane = planes[row, column]
                if lies_on(plane, side, row, column, u, v, w, apart_m[y, x], focal):
                    # Beyond half of its own, a change of nearness comes from a plane that ends before.
                    change = plane[1] * (x + 0.5 - u) + plane[2] * (y + 0.5 - v)
                    nearness[y, x] = w + max(-0.5 * w, min(0.5 * w, change))


@compiled
def close_holes(
    nearness: Float32,
    apart_m: Float32,
    planes: Float64,
    side: int,
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
        planes, side: see `plane_slopes`; of shape (0, 0, 3) where nothing is known.
        closed: (k, h, w) morphological closings of `nearness` by squares of the k growing radii.
        reach_per_spacing: the widest radius that may close a hole, as a share of the points' distance.
        filled: (h, w) changed: `nearness`, or that of the surface which closes the hole.
        source: (h, w) changed: 0, or the radius within which the nearest pixels of that surface lie.
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
                if own > 0.0 and level - own < _SAME_SURFACE * apart_m[y, x] * own * level:
                    break
                if k > 0:
                    # Points are at least a pixel apart where they are drawn: a smaller square does as well.
                    lower = closed[k - 1, y, x]
                    if lower > 0.0 and (level - lower) * focal < _SAME_SURFACE * lower:
                        continue
                value, apart, ring = _surface_around(
                    nearness, apart_m, y, x, radii[k], level, planes, side, focal
                )
                if ring == 0 or reach_per_spacing * apart * focal * level < radii[k] - 0.5:
                    continue
                if own > 0.0 and value - own < _SAME_SURFACE * apart * own * value:
                    continue
                filled[y, x] = value
                source[y, x] = ring
                break


@compiled
def _surface_around(
    nearness: Float32,
    apart_m: Float32,
    y: int,
    x: int,
    radius: int,
    level: float,
    planes: Float64,
    side: int,
    focal: float,
) -> tuple[float, float, int]:
    """Nearness of the surface at `level` from its pixels nearest to (y, x), their spacing and distance.

    Rings around the pixel are searched outwards until one holds pixels of that surface; 0 if none does.
    """
    for ring in range(1, radius + 1):
        n, value, apart, off_x, off_y = 0, 0.0, 0.0, 0, 0
        for dy in range(-ring, ring + 1):
            step = 1 if abs(dy) == ring else 2 * ring
            ny = y + dy
            if not 0 <= ny < nearness.shape[0]:
                continue
            for dx in range(-ring, ring + 1, step):
                nx = x + dx
                if not 0 <= nx < nearness.shape[1]:
                    continue
                w = nearness[ny, nx]
                if w > 0.0 and abs(level - w) < _SAME_SURFACE * apart_m[ny, nx] * w * level:
                    n += 1
                    value += w
                    apart += apart_m[ny, nx]
                    off_x += dx
                    off_y += dy
        if n > 0:
            value, apart = value / n, apart / n
            middle_x, middle_y = x + 0.5 + off_x / n, y + 0.5 + off_y / n
            row, column = y // side, x // side
            # Where points are about a pixel apart, a slope between two pixels is not worth its price.
            if apart * focal * value > 2.0 and row < planes.shape[0] and column < planes.shape[1]:
                plane = planes[row, column]
                if lies_on(plane, side, row, column, middle_x, middle_y, value, apart, focal):
                    change = (plane[1] * off_x + plane[2] * off_y) / n
                    value -= max(-0.5 * value, min(0.5 * value, change))
            return value, apart, ring
    return 0.0, 0.0, 0


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
            ring, i = source[y, x], index[y, x]
            if ring == 0:
                for c in range(values.shape[1]):
                    picture[y, x, c] = values[i, c] if i >= 0 else 0
                continue
            n = 0
            total[:] = 0.0
            level = filled[y, x]
            for dy in range(-ring, ring + 1):
                step = 1 if abs(dy) == ring else 2 * ring
                for dx in range(-ring, ring + 1, step):
                    ny, nx = y + dy, x + dx
                    if not (0 <= ny < index.shape[0] and 0 <= nx < index.shape[1]):
                        continue
                    j, w = index[ny, nx], nearness[ny, nx]
                    if j >= 0 and abs(level - w) < 2.0 * _SAME_SURFACE * apart_m[ny, nx] * w * level:
                        n += 1
                        for c in range(values.shape[1]):
                            total[c] += values[j, c]
            for c in range(values.shape[1]):
                picture[y, x, c] = np.uint8(total[c] / n + 0.5) if n > 0 else 0


@compiled
def finish(filled: Float32, source: Int32, index: Int32, depth: Float32, first: int, end: int) -> None:
    """Depth from nearness, NaN where nothing is; the index of closed holes becomes -1."""
    for y in range(first, end):
        for x in range(index.shape[1]):
            depth[y, x] = 1.0 / filled[y, x] if filled[y, x] > 0.0 else np.nan
            if source[y, x] > 0:
                index[y, x] = -1
