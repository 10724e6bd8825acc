"""Compiled loops of SIFT: extrema, orientations, descriptors; import them through `compiled_module`.

Method: Lowe, Distinctive image features from scale-invariant keypoints (2004), with the constants of OpenCV's
SIFT, and two differences. Keypoints are chosen before they are described. And a descriptor is a sum over
`SAMPLES` a side in the keypoint's own turned frame, whose weights are the same for all, about its place to a
fraction of a pixel; OpenCV sums over all pixels of the window around the next pixel.

An octave is (layers + 3, h, w) float32, images each blurred by a part of an octave more than the one before.
A keypoint is a row (6,) float32: x, y and scale (the blur's sigma) in the octave's pixels, where the centre
of the top-left pixel is (0, 0); octave; layer, which is the octave's image; response.
"""

import math

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled

# Said here, not imported: Numba keeps what it has compiled until this file changes.
X, Y, SCALE, OCTAVE, LAYER, RESPONSE = range(6)
DIRECTIONS = 36  # bins of an orientation's histogram
_BORDER = 5  # pixels in which no extremum is looked for
_STEPS = 5  # of an extremum's refinement
_CELLS, _BINS = 4, 8  # cells a side of a descriptor, and directions in each
SAMPLES = 4 * (_CELLS + 1)  # a side: four a cell, and half a cell beyond them on all sides


@compiled
def extrema(
    octave: NDArray[np.float32], number: int, sigma: float, first: int, end: int, contrast: float, edge: float
) -> NDArray[np.float32]:
    """Keypoints (n, 6) of an octave's rows from first to end: extrema of its differences in place and scale.

    Args:
        number: of the octave, which the keypoints name. sigma: blur of its first image, pixels.
        contrast, edge: OpenCV's thresholds; of responses in grey levels from 0 to 1.
    """
    _, height, width = octave.shape
    found = np.empty((1024, 6), np.float32)
    count = 0
    layers = len(octave) - 3
    rows = np.empty((layers + 2, 3, width), np.float32)  # of the differences: three at a time
    cube = np.empty((3, 3, 3), np.float32)
    mask = np.zeros((width + 7) // 8 * 8, np.uint8)
    words = mask.view(np.uint64)
    limit = np.float32(0.5 * contrast / layers * 255.0)
    first, end = max(first, _BORDER), min(end, height - _BORDER)
    for y in range(first - 1, end + 1):
        _difference(octave, y, rows)
        if y <= first:
            continue
        above, here, below = (y - 2) % 3, (y - 1) % 3, y % 3
        for layer in range(1, layers + 1):
            _beyond_ten(rows, layer, above, here, below, limit, mask)
            for word in range(len(words)):
                if words[word] == 0:
                    continue
                for x in range(max(8 * word, _BORDER), min(8 * word + 8, width - _BORDER)):
                    if mask[x] == 0 or not _is_extremum(rows, layer, above, here, below, x):
                        continue
                    if count == len(found):
                        found = np.concatenate((found, np.empty_like(found)))
                    if _refined(octave, sigma, layer, y - 1, x, contrast, edge, cube, found[count]):
                        found[count, OCTAVE] = number
                        count += 1
    return found[:count]


@compiled
def _difference(octave: NDArray[np.float32], y: int, rows: NDArray[np.float32]) -> None:
    for layer in range(len(rows)):
        low, high, out = octave[layer, y], octave[layer + 1, y], rows[layer, y % 3]
        for x in range(len(out)):
            out[x] = high[x] - low[x]


@compiled
def _beyond_ten(
    rows: NDArray[np.float32],
    layer: int,
    above: int,
    here: int,
    below: int,
    limit: np.float32,
    mask: NDArray[np.uint8],
) -> None:
    """Where a row is beyond the limit, its eight neighbours and the next layers. No branches: vectorised."""
    row, up, down = rows[layer, here], rows[layer, above], rows[layer, below]
    finer, coarser = rows[layer - 1, here], rows[layer + 1, here]
    for x in range(1, len(row) - 1):
        value = row[x]
        most = max(row[x - 1], row[x + 1], up[x - 1], up[x], up[x + 1], down[x - 1], down[x], down[x + 1])
        most = max(most, finer[x], coarser[x])
        least = min(row[x - 1], row[x + 1], up[x - 1], up[x], up[x + 1], down[x - 1], down[x], down[x + 1])
        least = min(least, finer[x], coarser[x])
        mask[x] = ((value > limit) & (value >= most)) | ((value < -limit) & (value <= least))


@compiled
def _is_extremum(rows: NDArray[np.float32], layer: int, above: int, here: int, below: int, x: int) -> bool:
    sign = np.float32(1.0) if rows[layer, here, x] > 0 else np.float32(-1.0)
    value = sign * rows[layer, here, x]
    for k in range(layer - 1, layer + 2):
        for y in (above, here, below):
            row = rows[k, y]
            if value < sign * row[x - 1] or value < sign * row[x] or value < sign * row[x + 1]:
                return False
    return True


@compiled
def _refined(
    octave: NDArray[np.float32],
    sigma: float,
    layer: int,
    y: int,
    x: int,
    contrast: float,
    edge: float,
    d: NDArray[np.float32],
    out: NDArray[np.float32],
) -> bool:
    """Put an extremum where a parabola through its neighbours has it; False: it is none, weak, or an edge."""
    layers = len(octave) - 3
    _, height, width = octave.shape
    scale = np.float32(1.0 / 255.0)
    for _ in range(_STEPS):
        for k in range(3):
            low, high = octave[layer + k - 1], octave[layer + k]
            for i in range(3):
                for j in range(3):
                    d[k, i, j] = (high[y + i - 1, x + j - 1] - low[y + i - 1, x + j - 1]) * scale
        gx, gy, gs = (
            0.5 * (d[1, 1, 2] - d[1, 1, 0]),
            0.5 * (d[1, 2, 1] - d[1, 0, 1]),
            0.5 * (d[2, 1, 1] - d[0, 1, 1]),
        )
        twice = 2.0 * d[1, 1, 1]
        xx, yy, ss = (
            d[1, 1, 2] + d[1, 1, 0] - twice,
            d[1, 2, 1] + d[1, 0, 1] - twice,
            d[2, 1, 1] + d[0, 1, 1] - twice,
        )
        xy = 0.25 * (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0])
        xs = 0.25 * (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0])
        ys = 0.25 * (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1])
        # The inverse of the Hessian by its cofactors.
        a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
        determinant = xx * a + xy * b + xs * c
        if determinant == 0.0:
            return False
        dx = -(a * gx + b * gy + c * gs) / determinant
        dy = -(b * gx + (xx * ss - xs * xs) * gy + (xs * xy - xx * ys) * gs) / determinant
        ds = -(c * gx + (xs * xy - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
        if abs(dx) < 0.5 and abs(dy) < 0.5 and abs(ds) < 0.5:
            response = abs(d[1, 1, 1] + 0.5 * (gx * dx + gy * dy + gs * ds))
            curvature = xx * yy - xy * xy
            if response * layers < contrast or curvature <= 0.0:
                return False
            if (xx + yy) ** 2 * edge >= (edge + 1.0) ** 2 * curvature:
                return False
            out[X], out[Y], out[LAYER], out[RESPONSE] = x + dx, y + dy, layer, response
            out[SCALE] = sigma * 2.0 ** ((layer + ds) / layers)
            return True
        if abs(dx) > width or abs(dy) > height or abs(ds) > layers:
            return False
        x, y, layer = x + int(np.rint(dx)), y + int(np.rint(dy)), layer + int(np.rint(ds))
        if not (1 <= layer <= layers and _BORDER <= x < width - _BORDER and _BORDER <= y < height - _BORDER):
            return False
    return False


@compiled
def _eighths(dy: np.float32, dx: np.float32) -> np.float32:
    """Direction of a gradient in eighths of a turn, [0, 8], to 0.005 degrees; without branches."""
    ax, ay = abs(dx), abs(dy)
    z = min(ax, ay) / (max(ax, ay) + np.float32(1e-20))
    square = z * z
    turn = np.float32(-0.0117212) * square + np.float32(0.05265332)
    turn = turn * square - np.float32(0.11643287)
    turn = turn * square + np.float32(0.19354346)
    turn = turn * square - np.float32(0.33262347)
    turn = (turn * square + np.float32(0.99997726)) * z * np.float32(4.0 / math.pi)
    turn = np.float32(2.0) - turn if ay > ax else turn
    turn = np.float32(4.0) - turn if dx < 0 else turn
    return np.float32(8.0) - turn if dy < 0 else turn


@compiled
def orientations(
    octave: NDArray[np.float32], keypoints: NDArray[np.float32], angles: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Orientations of keypoints (n, 6), degrees clockwise from the x axis, into the first places of `angles`.

    Args:
        angles: (n, 18), of each the highest peak first.

    Returns:
        (n,) how many each keypoint has; none where its surroundings are flat, or it lies outside.
    """
    _, height, width = octave.shape
    counts = np.zeros(len(keypoints), np.int64)
    histogram = np.empty(DIRECTIONS, np.float32)
    strength, turn = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(len(keypoints)):
        inside = -1.0 < keypoints[row, X] < width and -1.0 < keypoints[row, Y] < height
        if not (inside and 0.0 < keypoints[row, SCALE] < width + height):  # nor is what is no number
            continue
        image = octave[int(keypoints[row, LAYER])]
        x, y = int(np.rint(keypoints[row, X])), int(np.rint(keypoints[row, Y]))
        window = 1.5 * keypoints[row, SCALE]
        radius = int(np.rint(3.0 * window))
        first, last = max(x - radius, 1), min(x + radius, width - 2)
        weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / window) ** 2).astype(np.float32)
        histogram[:] = 0.0
        for i in range(max(y - radius, 1), min(y + radius, height - 2) + 1):
            above, here, below = image[i - 1], image[i], image[i + 1]
            of_row = weights[radius + i - y]
            for k in range(last - first + 1):
                j = first + k
                dx, dy = here[j + 1] - here[j - 1], below[j] - above[j]
                strength[k] = np.sqrt(dx * dx + dy * dy) * of_row * weights[radius + j - x]
                turn[k] = _eighths(dy, dx) * np.float32(DIRECTIONS / 8) + np.float32(0.5)
            for k in range(last - first + 1):
                histogram[int(turn[k]) % DIRECTIONS] += strength[k]
        counts[row] = _peaks(histogram, angles[row])
    return counts


@compiled
def _peaks(histogram: NDArray[np.float32], angles: NDArray[np.float32]) -> int:
    """Directions of peaks of at least 0.8 of the highest, which comes first."""
    smooth = np.empty(DIRECTIONS, np.float32)
    for k in range(DIRECTIONS):
        far = histogram[k - 2] + histogram[(k + 2) % DIRECTIONS]
        near = histogram[k - 1] + histogram[(k + 1) % DIRECTIONS]
        smooth[k] = (far + np.float32(4.0) * near + np.float32(6.0) * histogram[k]) / np.float32(16.0)
    top = int(smooth.argmax())
    count = 0
    for step in range(DIRECTIONS):
        k = (top + step) % DIRECTIONS
        left, middle, right = smooth[k - 1], smooth[k], smooth[(k + 1) % DIRECTIONS]
        if middle > left and middle > right and middle >= np.float32(0.8) * smooth[top]:
            place = k + 0.5 * (left - right) / (left - 2.0 * middle + right)
            angles[count] = place * (360.0 / DIRECTIONS) % 360.0
            count += 1
    return count


@compiled
def descriptors(
    octave: NDArray[np.float32],
    keypoints: NDArray[np.float32],
    angles: NDArray[np.float32],
    places: NDArray[np.float32],
    cells: NDArray[np.int64],
    weights: NDArray[np.float32],
) -> NDArray[np.float32]:
    """SIFT (n, 128) of keypoints (n, 6) turned by angles (n,), clipped at a fifth of its length.

    Args:
        places, cells, weights: of the samples, by `sample_table`.
    """
    _, height, width = octave.shape
    found = np.empty((len(keypoints), _CELLS * _CELLS * _BINS), np.float32)
    histogram = np.empty((_CELLS + 2) ** 2 * _BINS, np.float32)  # with a rim that is left out
    next_row = (_CELLS + 2) * _BINS
    strength, turn = np.empty(len(places), np.float32), np.empty(len(places), np.float32)
    for row in range(len(keypoints)):
        image = octave[int(keypoints[row, LAYER])].ravel()
        angle = np.float32(angles[row] * (math.pi / 180.0))
        cell_px = np.float32(3.0) * keypoints[row, SCALE]
        along, across = cell_px * np.cos(angle), cell_px * np.sin(angle)
        x, y = keypoints[row, X] + np.float32(0.5), keypoints[row, Y] + np.float32(0.5)
        for k in range(len(places)):
            u, v = places[k, 0], places[k, 1]
            j, i = math.floor(x + u * along - v * across), math.floor(y + u * across + v * along)
            if 0 < j < width - 1 and 0 < i < height - 1:
                at = i * width + j
                strength[k], turn[k] = image[at + 1] - image[at - 1], image[at + width] - image[at - width]
            else:
                strength[k], turn[k] = 0.0, 0.0
        for k in range(len(places)):
            dx, dy = strength[k], turn[k]
            strength[k] = np.sqrt(dx * dx + dy * dy)
            turn[k] = angles[row] / np.float32(45.0) - _eighths(dy, dx) + np.float32(16.0)
        histogram[:] = 0.0
        for k in range(len(places)):
            whole = int(turn[k])
            second = strength[k] * (turn[k] - np.float32(whole))
            first = strength[k] - second
            low, high = cells[k] + (whole & 7), cells[k] + ((whole + 1) & 7)
            histogram[low] += first * weights[k, 0]
            histogram[high] += second * weights[k, 0]
            histogram[low + _BINS] += first * weights[k, 1]
            histogram[high + _BINS] += second * weights[k, 1]
            histogram[low + next_row] += first * weights[k, 2]
            histogram[high + next_row] += second * weights[k, 2]
            histogram[low + next_row + _BINS] += first * weights[k, 3]
            histogram[high + next_row + _BINS] += second * weights[k, 3]
        total = np.float32(0.0)
        for i in range(_CELLS):
            for k in range(_CELLS * _BINS):
                value = histogram[(i + 1) * next_row + _BINS + k]
                found[row, i * _CELLS * _BINS + k] = value
                total += value * value
        limit = np.float32(0.2) * np.sqrt(total)
        for k in range(found.shape[1]):
            found[row, k] = min(found[row, k], limit)
    return found


def sample_table() -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Samples of a descriptor: places (s, 2) in cells from its middle, x along its orientation; where in the
    histogram (s,) the first of four cells is that share each; their weights (s, 4), with the window's.
    """
    side = (np.arange(SAMPLES) + 0.5) * ((_CELLS + 1) / SAMPLES) - (_CELLS + 1) / 2.0
    v, u = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    rows, columns = v + (_CELLS - 1) / 2.0, u + (_CELLS - 1) / 2.0
    row, column = np.floor(rows), np.floor(columns)
    down, right = rows - row, columns - column
    shares = np.column_stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    window = np.exp(-(u**2 + v**2) * (2.0 / _CELLS**2))
    cells = ((row + 1) * (_CELLS + 2) + column + 1) * _BINS
    return (
        np.column_stack([u, v]).astype(np.float32),
        cells.astype(np.int64),
        (shares * window[:, None]).astype(np.float32),
    )
