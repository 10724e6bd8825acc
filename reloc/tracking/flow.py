"""Sparse optical flow: where patches of one frame lie in another, checked by the way back."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from reloc.tracking.options import FlowOptions

_HALF_PX = 0.5  # OpenCV's pixel (0, 0) is a centre, ours a corner


def follow(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    pixels: FloatArray,
    guess: FloatArray,
    options: FlowOptions,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where patches around `pixels` (n, 2) of one frame (h, w) lie in another.

    Args:
        guess: (n, 2) about there.

    Returns:
        Pixels (n, 2) float64, and which (n,) of them are to be trusted.
    """
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
    height, width = before.shape
    enlarged = max(width, height) / options.reference_side_px
    window = max(2 * round(0.5 * (options.window_px * enlarged - 1.0)) + 1, 5)  # odd
    settings: dict[str, Any] = {
        "winSize": (window, window),
        "maxLevel": options.levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, options.iterations, 0.01),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-4,
    }
    start = (pixels - _HALF_PX).astype(np.float32)
    aimed = (guess - _HALF_PX).astype(np.float32)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, aimed.copy(), **settings)
    # The way back starts from as far off as the way there did.
    back_guess = there + (start - aimed)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, back_guess, **settings)
    good = (found.reshape(-1) == 1) & (found_back.reshape(-1) == 1)
    good &= np.linalg.norm(back - start, axis=1) < options.max_back_px * enlarged
    result = there.astype(np.float64) + _HALF_PX
    inside = (result >= 0).all(axis=1) & (result[:, 0] < width) & (result[:, 1] < height)
    return result, np.asarray(good & inside)
