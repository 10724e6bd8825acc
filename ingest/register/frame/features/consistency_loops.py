"""Compiled loop of the local consistency; import it through `featuredb.compiled.compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled
from featuredb.geometry.arrays import FloatArray

# No neighbour nearer than this share of the photo's longer side: keypoints of one structure agree with each
# other by construction.
_MIN_GAP_REL = 0.006
# Of a neighbour's place, as a share of its distance; what slopes and perspective do to a similarity within
# the reach.
_TOLERANCE = 0.15
_TOLERANCE_FLOOR_REL = 0.002  # and at least this share of the longer side, the noise of keypoints
_MAX_TURN = np.radians(45.0)  # largest rotation between photo and reference
_MAX_LOG_ZOOM = np.log(2.0)  # largest change of scale between them, either way


@compiled
def neighbour_support(
    photo: FloatArray,
    reference: FloatArray,
    neighbour: NDArray[np.int64],
    side_px: float,
    area_px: float,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Largest number of neighbours of each match that one similarity moves to where they are.

    Args:
        photo, reference: (m, 2) pixels. neighbour: (m, k) rows, -1 where there are fewer.
        side_px: longer side of the photo. area_px: over which false matches are spread.

    Returns:
        Support (m,); expected number of chance hits at the winning similarity (m,).
    """
    m, k = neighbour.shape
    support = np.zeros(m, np.int64)
    expected = np.zeros(m)
    px, py, qx, qy = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    reach = np.empty(k)
    min_gap, floor = _MIN_GAP_REL * side_px, _TOLERANCE_FLOOR_REL * side_px
    for i in range(m):
        n = 0
        best = 1.0
        for c in range(k):
            j = neighbour[i, c]
            if j < 0 or j == i:
                continue
            dx, dy = photo[j, 0] - photo[i, 0], photo[j, 1] - photo[i, 1]
            far = np.sqrt(dx * dx + dy * dy)
            if far < min_gap:
                continue
            px[n], py[n] = dx, dy
            qx[n], qy[n] = reference[j, 0] - reference[i, 0], reference[j, 1] - reference[i, 1]
            reach[n] = max(_TOLERANCE * far, floor)
            n += 1
        for h in range(n):
            square = px[h] * px[h] + py[h] * py[h]
            a = (qx[h] * px[h] + qy[h] * py[h]) / square
            b = (qy[h] * px[h] - qx[h] * py[h]) / square
            size = a * a + b * b
            if size <= 0.0:
                continue
            zoom, turn = 0.5 * np.log(size), np.arctan2(b, a)
            if abs(zoom) > _MAX_LOG_ZOOM or abs(turn) > _MAX_TURN:
                continue
            scale = np.sqrt(size)
            count = 0
            for c in range(n):
                ex = a * px[c] - b * py[c] - qx[c]
                ey = b * px[c] + a * py[c] - qy[c]
                limit = reach[c] * scale
                if ex * ex + ey * ey <= limit * limit:
                    count += 1
            if count > support[i]:
                support[i] = count
                best = scale
        for c in range(n):
            expected[i] += np.pi * (reach[c] * best) ** 2 / area_px
    return support, expected
