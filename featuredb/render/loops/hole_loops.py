"""Compiled loops that close holes between splats; see `compiled_module`.

Depths are handled as their inverses, "nearness": zero is nothing at all, and planes are linear in the pixel.
A short loop without branches, which vectorises, decides for a row at a time by which closing each pixel might
be closed; those few are then closed one by one.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled
from featuredb.render.loops.draw_loops import lies_on

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
UInt32 = NDArray[np.uint32]
Number = float | np.float32

TILE_PX = 8  # side of the tiles in which the widest spacing is kept
_SAME_SURFACE = np.float32(2.0)  # spacings in depth between neighbours of one surface, however steep
_NOTHING = np.float32(0.0)
# Every second byte of paint: so the sums over the widest ring around a hole, 256 pixels at a radius of 32,
# just fit, 16 bits each.
_EVEN = np.uint32(0x00FF00FF)


@compiled
def close_holes(
    nearness: Float32,
    apart_m: Float32,
    paint: UInt32,
    planes: Float64,
    side: int,
    closed: Float32,
    radii: Int32,
    widest_m: Float32,
    focal: float,
    reach_per_spacing: float,
    depth: Float32,
    index: Int32,
    finished: UInt32,
    first: int,
    end: int,
) -> None:
    """Close holes on rows `first` to `end`: pixels between splats of one surface, or showing what is behind.

    They take their nearness and their paint from the nearest pixels of that surface.

    Args:
        nearness, apart_m, paint: see `picture_loops.show_splats`.
        planes, side: see `plane_loops.plane_slopes`; of shape (0, 0, 3) where nothing is known.
        closed: (k, h, w) morphological closings of `nearness` by squares of the k growing radii.
        widest_m: (k, tiles down, tiles across) no less than any `apart_m` within a radius of a tile's pixels.
        reach_per_spacing: the widest radius that may close a hole, as a share of the points' distance.
        depth: (h, w) changed, metres.
        index: (h, w) changed: -1 where a hole was closed.
        finished: (h, w) changed: the paint with holes closed.
    """
    width = nearness.shape[1]
    chosen, limit = np.empty(width, np.int32), np.empty((len(radii), width), np.float32)
    for y in range(first, end):
        finished[y] = paint[y]
        if y == first or y % TILE_PX == 0:
            for k in range(len(radii)):
                scale = np.float32(reach_per_spacing * focal / (radii[k] - 0.5))
                _spread_tiles(widest_m[k, y // TILE_PX], scale, limit[k])
        chosen[:] = -1
        for k in range(len(radii)):
            _choose(
                *(nearness[y], apart_m[y], closed[k, y], closed[max(k - 1, 0), y], limit[k]),
                *(np.int32(k), np.float32(focal), chosen),
            )
        _search_rings(
            *(nearness, apart_m, paint, planes, side, closed, radii, focal, reach_per_spacing),
            *(y, chosen, depth, index, finished),
        )


@compiled
def _spread_tiles(tiles: Float32, scale: np.float32, row: Float32) -> None:
    """Fill the pixels of a row with the values of its tiles, times scale."""
    for x in range(len(row)):
        row[x] = scale * tiles[x // TILE_PX]


@compiled
def _choose(
    own: Float32,
    apart_m: Float32,
    level: Float32,
    lower: Float32,
    limit: Float32,
    k: np.int32,
    focal: np.float32,
    chosen: Int32,
) -> None:
    """Set chosen to k in the pixels of a row that the k-th closing brings to the front.

    Args:
        own, apart_m: of the pixels.
        level, lower: of this closing and of the one before.
        limit: above one over the nearness of points that are far enough apart for this closing.
    """
    for x in range(len(own)):
        w, closing = own[x], level[x]
        in_front = (closing > w) & (
            (w == _NOTHING) | (closing - w >= _SAME_SURFACE * apart_m[x] * w * closing)
        )
        as_before = (k > 0) & (lower[x] > _NOTHING) & _as_before(closing, lower[x], focal)
        chosen[x] = k if in_front & (not as_before) & (closing * limit[x] >= np.float32(1.0)) else chosen[x]


@compiled
def _as_before(closing: Number, lower: Number, focal: Number) -> bool:
    """Whether a smaller square does as well: points are at least a pixel apart where they are drawn."""
    return bool((closing - lower) * focal < _SAME_SURFACE * lower)


@compiled
def _search_rings(
    nearness: Float32,
    apart_m: Float32,
    paint: UInt32,
    planes: Float64,
    side: int,
    closed: Float32,
    radii: Int32,
    focal: float,
    reach_per_spacing: float,
    y: int,
    chosen: Int32,
    depth: Float32,
    index: Int32,
    finished: UInt32,
) -> None:
    """Close pixels of row y by rings around them, searched outwards until one holds pixels of the surface.

    Args:
        chosen: (w,) the largest closing that may close each pixel, or -1; smaller ones are tried after it.
    """
    height, width = nearness.shape
    for x in np.flatnonzero(chosen >= 0):
        own, own_apart = np.float64(nearness[y, x]), np.float64(apart_m[y, x])
        k, ring = int(chosen[x]), 1
        while k >= 0:
            level = np.float64(closed[k, y, x])
            if level <= own or level - own < _SAME_SURFACE * own_apart * own * level:
                break  # closings by smaller squares are lower still
            if k > 0 and closed[k - 1, y, x] > 0.0 and _as_before(level, closed[k - 1, y, x], focal):
                k, ring = k - 1, 1
                continue
            n, found, apart, off_x, off_y, even, odd = 0, 0.0, 0.0, 0, 0, np.uint32(0), np.uint32(0)
            for dy in range(-ring, ring + 1):
                ny, step = y + dy, 1 if abs(dy) == ring else 2 * ring
                if not 0 <= ny < height:
                    continue
                for dx in range(-ring, ring + 1, step):
                    nx = x + dx
                    if not 0 <= nx < width:
                        continue
                    w, spacing = np.float64(nearness[ny, nx]), np.float64(apart_m[ny, nx])
                    # Never where there is nothing: there, both are zero.
                    if abs(level - w) < _SAME_SURFACE * spacing * w * level:
                        n += 1
                        found += w
                        apart += spacing
                        off_x += dx
                        off_y += dy
                        even += paint[ny, nx] & _EVEN
                        odd += (paint[ny, nx] >> np.uint32(8)) & _EVEN
            if n == 0 and ring < radii[k]:
                ring += 1
                continue
            if n > 0:
                share = 1.0 / n
                found, apart = found * share, apart * share
                if apart * focal * found > 2.0 and len(planes):
                    row, column = y // side, x // side
                    found -= _change(
                        *(planes[row, column, 0], planes[row, column, 1], planes[row, column, 2]),
                        *(x + 0.5 - (column + 0.5) * side, y + 0.5 - (row + 0.5) * side),
                        *(off_x * share, off_y * share, found, apart, focal),
                    )
                if _closes(own, found, apart, level, radii[k], focal, reach_per_spacing):
                    depth[y, x] = 1.0 / found
                    index[y, x] = -1
                    finished[y, x] = _mean_paint(even, odd, share)
                    break
            k, ring = k - 1, 1


@compiled
def _change(
    at: float,
    slope_u: float,
    slope_v: float,
    du: float,
    dv: float,
    off_x: float,
    off_y: float,
    value: float,
    apart: float,
    focal: float,
) -> float:
    """Change of nearness from a pixel to its surface's mean, (off_x, off_y) from it; zero off the plane.

    Args:
        at, slope_u, slope_v: the block's plane.
        du, dv: from the block's middle to the pixel.
        value, apart: nearness and spacing of the surface.
    """
    if not lies_on(at, slope_u, slope_v, du + off_x, dv + off_y, value, apart, focal):
        return 0.0
    return max(-0.5 * value, min(0.5 * value, slope_u * off_x + slope_v * off_y))


@compiled
def _closes(
    own: float, found: float, apart: float, level: float, radius: int, focal: float, reach: float
) -> bool:
    """Whether a surface may close a pixel: its points are far enough apart for the closing, and the pixel
    does not show the surface itself."""
    if reach * apart * focal * level < radius - 0.5:
        return False
    return bool(own == 0.0 or found - own >= _SAME_SURFACE * apart * own * found)


@compiled
def _mean_paint(even: np.uint32, odd: np.uint32, share: float) -> int:
    """Means of sums, rounded; each sum has 16 bits."""
    red, green = int(even & 0xFFFF), int(odd & 0xFFFF)
    blue, intensity = int(even >> 16), int(odd >> 16)
    return (
        int(red * share + 0.5)
        | int(green * share + 0.5) << 8
        | int(blue * share + 0.5) << 16
        | int(intensity * share + 0.5) << 24
    )
