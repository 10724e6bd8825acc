"""Compiled loops over the pixels of a picture: what splats show; see `compiled_module`.

Depths are handled as their inverses, "nearness": zero is nothing at all, and planes are linear in the pixel.
What a pixel is painted with, three colours and an intensity, lies in the four bytes of one number. Every loop
works on rows `first` to `end` of the picture, so that threads can share it.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled
from featuredb.render.loops.draw_loops import NOTHING, lies_on, slot_of

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
UInt32 = NDArray[np.uint32]
UInt64 = NDArray[np.uint64]


@compiled
def show_splats(
    seen: Float32,
    shows: UInt32,
    nearest: UInt64,
    planes: Float64,
    side: int,
    focal: float,
    nearness: Float32,
    apart_m: Float32,
    depth: Float32,
    index: Int32,
    paint: UInt32,
    first: int,
    end: int,
) -> None:
    """What each pixel shows of its point. Where the point lies on its block's plane, its splat is tilted.

    Args:
        seen, shows, nearest: see draw_loops.
        planes, side: see `plane_loops.plane_slopes`; of shape (0, 0, 3) where nothing is known.
        nearness: (h, w) changed, 1/m; zero where there is no point.
        apart_m: (h, w) changed: distance between points of the surface; zero where there is no point.
        depth: (h, w) changed: metres, NaN where there is no point.
        index: (h, w) changed: row of the cloud, -1 where there is no point.
        paint: (h, w) changed: red, green, blue and intensity from the lowest byte up.
    """
    for y in range(first, end):
        last = np.int64(-1)  # slot
        block_row = y // side
        u, v, w, apart, tilt_x, tilt_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        column, column_end, tilted = -1, 0, False
        for x in range(nearest.shape[1]):
            packed = nearest[y, x]
            if x == column_end:
                column, column_end, tilted = column + 1, column_end + side, False
            if packed == NOTHING:
                nearness[y, x] = 0.0
                apart_m[y, x] = 0.0
                depth[y, x] = np.nan
                index[y, x] = -1
                paint[y, x] = 0
                continue
            slot = slot_of(packed)
            if slot != last:  # neighbours mostly show the same point
                last, tilted = slot, False
                u, v = np.float64(seen[slot, 0]), np.float64(seen[slot, 1])
                w, apart = 1.0 / np.float64(seen[slot, 2]), np.float64(seen[slot, 3])
            if not tilted:
                tilted = True
                tilt_x = tilt_y = 0.0
                if block_row < planes.shape[0] and column < planes.shape[1]:
                    at, slope_u = planes[block_row, column, 0], planes[block_row, column, 1]
                    slope_v = planes[block_row, column, 2]
                    du, dv = u - (column + 0.5) * side, v - (block_row + 0.5) * side
                    if lies_on(at, slope_u, slope_v, du, dv, w, apart, focal):
                        tilt_x, tilt_y = slope_u, slope_v
            # Beyond half of its own, a change of nearness comes from a plane that ends before.
            change = tilt_x * (x + 0.5 - u) + tilt_y * (y + 0.5 - v)
            value = w + max(-0.5 * w, min(0.5 * w, change))
            nearness[y, x] = value
            apart_m[y, x] = apart
            depth[y, x] = 1.0 / value
            index[y, x] = shows[slot, 0]
            paint[y, x] = shows[slot, 1]
