"""Pictures made smaller."""

import cv2
import numpy as np
from numpy.typing import NDArray


def fitted_size(width: int, height: int, max_side_px: int | None) -> tuple[int, int]:
    """Width and height of the largest picture of the same shape whose sides are at most `max_side_px`."""
    longer = max(width, height)
    if max_side_px is None or longer <= max_side_px:
        return width, height
    return max(1, round(width * max_side_px / longer)), max(1, round(height * max_side_px / longer))


def shrunk(pixels: NDArray[np.uint8], max_side_px: int | None) -> NDArray[np.uint8]:
    """Pixels (h, w) or (h, w, 3) whose sides are at most `max_side_px`; the same where they are."""
    height, width = pixels.shape[:2]
    size = fitted_size(width, height, max_side_px)
    if size == (width, height):
        return pixels
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
