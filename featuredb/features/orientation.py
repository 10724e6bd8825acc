"""Orientations of keypoints whose program has kept none: the extractor's own, in its own scale space.

Method: Lowe, Distinctive image features from scale-invariant keypoints (2004), section 5, with the constants
of OpenCV's SIFT: a histogram of 36 gradient directions, weighted by a Gaussian of 1.5 times the keypoint's
scale, smoothed, its highest peak refined by a parabola. Lowe makes a keypoint of every further peak; here is
only that one.
"""

from collections import defaultdict
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.describe import octave_and_layer, shrunk_for
from featuredb.features.extractor import OCTAVE_LAYERS, SIGMA
from featuredb.geometry.arrays import FloatArray

_BINS = 36
_WINDOW = 1.5  # standard deviation of the window, in scales of the keypoint
_REACH = 3.0  # of the window, in its standard deviations
_CAMERA_BLUR = 0.5  # of any photo, in its pixels


def orientations_at(
    gray: NDArray[np.uint8],
    xy: NDArray[np.float32],
    scale: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Orientation (n,) of given keypoints: degrees in [0, 360), clockwise from the x axis.

    Args:
        gray: (h, w) uint8.
        xy: (n, 2) full-size pixels, centre of the top-left pixel (0.5, 0.5). scale: (n,) diameters in pixels.
    """
    angles = np.zeros(len(xy), np.float32)
    if not len(xy):
        return angles
    small, places, diameters = shrunk_for(gray, xy, scale)
    wanted: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row, diameter in enumerate(diameters.tolist()):
        wanted[octave_and_layer(diameter)].append(row)
    for octave, base in _octaves(small, max(octave for octave, _ in wanted)):
        for layer in sorted(layer for at, layer in wanted if at == octave):
            strength, direction = _gradients(_layer(base, layer))
            for row in wanted[octave, layer]:
                x, y = (places[row] * 2.0**-octave).tolist()
                histogram = _histogram(strength, direction, x, y, float(diameters[row]) / 2.0 * 2.0**-octave)
                angles[row] = _peak_deg(histogram)
    return angles % np.float32(360.0)


def _octaves(small: NDArray[np.uint8], last: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """The first image of each octave, from the doubled photo on, blurred by SIGMA of its own pixels."""
    height, width = small.shape
    doubling = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    base: NDArray[np.float32] = np.asarray(
        cv2.warpAffine(
            small.astype(np.float32), doubling, (2 * width, 2 * height), borderMode=cv2.BORDER_REFLECT
        ),
        dtype=np.float32,
    )
    base = _blurred(base, (SIGMA**2 - (2.0 * _CAMERA_BLUR) ** 2) ** 0.5)
    for octave in range(-1, last + 1):
        yield octave, base
        base = np.ascontiguousarray(_layer(base, OCTAVE_LAYERS)[::2, ::2])


def _layer(base: NDArray[np.float32], layer: int) -> NDArray[np.float32]:
    """An octave's image with the blur of a layer."""
    if layer == 0:
        return base
    return _blurred(base, SIGMA * (4.0 ** (layer / OCTAVE_LAYERS) - 1.0) ** 0.5)


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.float32)


def _gradients(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Length of the gradient and the bin of its direction, both (h, w); zero on the border."""
    dx, dy = np.zeros_like(image), np.zeros_like(image)
    dx[1:-1, 1:-1] = image[1:-1, 2:] - image[1:-1, :-2]
    dy[1:-1, 1:-1] = image[2:, 1:-1] - image[:-2, 1:-1]
    strength, turn = cv2.cartToPolar(dx, dy, angleInDegrees=True)
    bins = np.rint(np.asarray(turn) * (_BINS / 360.0)).astype(np.int64) % _BINS
    return np.asarray(strength, dtype=np.float32), bins


def _histogram(
    strength: NDArray[np.float32], bins: NDArray[np.int64], x: float, y: float, scale_px: float
) -> FloatArray:
    """Smoothed histogram (36,) of the directions around a place."""
    column, row = round(x), round(y)
    reach = round(_REACH * _WINDOW * scale_px)
    rows = np.arange(max(row - reach, 0), min(row + reach + 1, strength.shape[0]))
    columns = np.arange(max(column - reach, 0), min(column + reach + 1, strength.shape[1]))
    if not len(rows) or not len(columns):
        return np.zeros(_BINS)
    fall = -0.5 / (_WINDOW * scale_px) ** 2
    weights = np.outer(np.exp(fall * (rows - row) ** 2), np.exp(fall * (columns - column) ** 2))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    raw = np.bincount(bins[window].ravel(), (weights * strength[window]).ravel(), minlength=_BINS)
    near, far = np.roll(raw, 1) + np.roll(raw, -1), np.roll(raw, 2) + np.roll(raw, -2)
    return np.asarray((far + 4.0 * near + 6.0 * raw) / 16.0, dtype=np.float64)


def _peak_deg(histogram: FloatArray) -> float:
    """Direction of the highest bin, by the parabola through it and its neighbours; 0 where there is none."""
    top = int(np.argmax(histogram))
    left, middle, right = histogram[top - 1], histogram[top], histogram[(top + 1) % _BINS]
    bend = left - 2.0 * middle + right
    shift = 0.0 if bend == 0.0 else 0.5 * (left - right) / bend
    return float((top + shift) * 360.0 / _BINS % 360.0)
