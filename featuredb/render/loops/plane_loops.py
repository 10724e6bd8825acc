"""Compiled loops that find the planes which points in view lie on; see `compiled_module`.

Depths are handled as their inverses, "nearness": planes are linear in the pixel. Every loop works on rows of
blocks `first` to `end`, so that threads can share it.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled
from featuredb.render.loops.draw_loops import NOTHING, slot_of

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt64 = NDArray[np.uint64]


@compiled
def plane_moments(
    seen: Float32, nearest: UInt64, side: int, stride: int, moments: Float64, first: int, end: int
) -> None:
    """Add up, per block of side x side pixels, the moments of the points that lie in pixels showing them.

    Args:
        seen, nearest: see draw_loops.
        stride: every how many-th pixel is asked.
        moments: (blocks down, blocks across, 9) changed: n, u, v, uu, uv, vv, w, uw, vw; u and v from the
            picture's middle, w is nearness.
    """
    height, width = nearest.shape
    middle_u, middle_v = 0.5 * width, 0.5 * height
    for y in range(first * side, min(end * side, height), stride):
        for x in range((y // stride) % stride, width, stride):
            packed = nearest[y, x]
            if packed == NOTHING:
                continue
            slot = slot_of(packed)
            u, v = np.float64(seen[slot, 0]), np.float64(seen[slot, 1])
            if not (int(np.floor(u)) == x and int(np.floor(v)) == y):
                continue
            w = 1.0 / np.float64(seen[slot, 2])
            row, column = y // side, x // side
            u -= middle_u
            v -= middle_v
            moments[row, column, 0] += 1.0
            moments[row, column, 1] += u
            moments[row, column, 2] += v
            moments[row, column, 3] += u * u
            moments[row, column, 4] += u * v
            moments[row, column, 5] += v * v
            moments[row, column, 6] += w
            moments[row, column, 7] += u * w
            moments[row, column, 8] += v * w


@compiled
def plane_slopes(
    moments: Float64, side: int, height: int, width: int, planes: Float64, first: int, end: int
) -> None:
    """Fit each block's plane of nearness to the points of the block and those around it.

    Args:
        height, width: of the picture.
        planes: (blocks down, blocks across, 3) changed: nearness at the block's middle and its slopes across
            and down; NaN where even three blocks around hold too few points.
    """
    t = np.empty(9)
    for by in range(first, end):
        for bx in range(moments.shape[1]):
            planes[by, bx] = np.nan
            for reach in range(1, 4):
                t[:] = 0.0
                for ny in range(max(by - reach, 0), min(by + reach + 1, moments.shape[0])):
                    for nx in range(max(bx - reach, 0), min(bx + reach + 1, moments.shape[1])):
                        for c in range(9):
                            t[c] += moments[ny, nx, c]
                if t[0] >= 8.0:  # three make a plane; with eight one stray point does not turn it
                    u, v = (bx + 0.5) * side - 0.5 * width, (by + 0.5) * side - 0.5 * height
                    planes[by, bx, 0], planes[by, bx, 1], planes[by, bx, 2] = _plane(
                        *(t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8], u, v)
                    )
                    break


@compiled
def _plane(
    n: float,
    su: float,
    sv: float,
    uu: float,
    uv: float,
    vv: float,
    sw: float,
    uw: float,
    vw: float,
    u: float,
    v: float,
) -> tuple[float, float, float]:
    """Least squares from moments: nearness at (u, v) and its slopes; NaN where the points lie on a line."""
    suu, suv, svv = uu - su * su / n, uv - su * sv / n, vv - sv * sv / n
    suw, svw = uw - su * sw / n, vw - sv * sw / n
    det = suu * svv - suv * suv
    if not det > 1e-3 * suu * svv:
        return np.nan, np.nan, np.nan
    slope_u = (svv * suw - suv * svw) / det
    slope_v = (suu * svw - suv * suw) / det
    return sw / n + slope_u * (u - su / n) + slope_v * (v - sv / n), slope_u, slope_v
