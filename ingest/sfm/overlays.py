"""What photos have in common without showing the same place: watermarks, borders, and copies of a picture.

A watermark or a frame stands at the same pixels of all photos that it was put on. Its features match
perfectly, and would tie together photos of different towns.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

# Pixels are those of an image of this longer side, on which keypoints are located.
_REFERENCE_SIDE_PX = 1600
# Matches that move less between photos of one size stand still. Hands and drones move by tens of pixels from
# one photo to the next.
_STILL_PX = 1.5
# Up to this share of the matches, those that stand still are dropped and the rest is judged by itself; above
# it, they are either all there is, or the camera stood still.
_MOST_STILL = 0.5
# Matches that stand still within less than this share of the picture are an overlay; a camera that stands
# still has them all over.
_OVERLAY_AREA = 0.25
_COPY_PX = 2.0  # of matches of two encodings of one picture, cut and resized as may be
_COPY_SHARE = 0.9  # of the verified matches that fit one shift and zoom
_COPY_TURN_DEG = 0.3  # between the two; people cut and scale what they copy
# Of the smaller picture's area that lies in the other. Neighbours of a flight over flat ground fit a shift
# and zoom as well, but overlap in part.
_COPY_INSIDE = 0.95
_COPY_MATCHES = 50  # fewer say nothing

Size = tuple[int, int]
"""Width and height, pixels."""


def without_overlay(
    xy_a: NDArray[np.float32],
    xy_b: NDArray[np.float32],
    size_a: Size,
    size_b: Size,
    matches: NDArray[np.uint32],
) -> NDArray[np.uint32]:
    """Matches (m, 2) without those that stand still as a watermark or a frame does.

    Args:
        xy_a, xy_b: keypoints (n, 2) of both photos.
    """
    if size_a != size_b or not len(matches):
        return matches
    a, b = xy_a[matches[:, 0]].astype(np.float64), xy_b[matches[:, 1]].astype(np.float64)
    zoom = max(1.0, max(size_a) / _REFERENCE_SIDE_PX)
    still = np.linalg.norm(a - b, axis=1) <= _STILL_PX * zoom
    if still.mean() > _MOST_STILL and _area(a[still], size_a) >= _OVERLAY_AREA:
        return matches
    return np.asarray(matches[~still])


def is_copy(a: FloatArray, b: FloatArray, size_a: Size, size_b: Size) -> bool:
    """Whether verified matches are those of two copies of one picture, one perhaps cut or framed.

    Args:
        a, b: (m, 2) pixels of both.
    """
    if len(a) < _COPY_MATCHES:
        return False
    zoom = max(1.0, max(*size_a, *size_b) / _REFERENCE_SIDE_PX)
    scale, shift = _zoom_and_shift(a, b)
    errors = np.linalg.norm(scale * a + shift - b, axis=1)
    if (errors <= _COPY_PX * zoom).mean() < _COPY_SHARE:
        return False
    turned, _ = cv2.estimateAffinePartial2D(a, b, method=cv2.LMEDS)
    if turned is None or abs(np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))) > _COPY_TURN_DEG:
        return False
    return _inside(scale, shift, size_a, size_b) >= _COPY_INSIDE


def _zoom_and_shift(a: FloatArray, b: FloatArray) -> tuple[float, FloatArray]:
    """b = scale * a + shift, by medians: robust against a few matches that do not fit."""
    middle_a, middle_b = np.median(a, axis=0), np.median(b, axis=0)
    far = np.abs(a - middle_a)
    ratios = np.abs(b - middle_b)[far > 0.1 * far.max()] / far[far > 0.1 * far.max()]
    scale = float(np.median(ratios)) if ratios.size else 1.0
    return scale, np.asarray(np.median(b - scale * a, axis=0))


def _inside(scale: float, shift: FloatArray, size_a: Size, size_b: Size) -> float:
    """Share of the smaller picture's area that the other shows as well, in pixels of b."""
    corner = shift + scale * np.array(size_a, dtype=np.float64)
    both = np.minimum(corner, size_b) - np.maximum(shift, 0.0)
    smaller = min(scale**2 * size_a[0] * size_a[1], float(size_b[0] * size_b[1]))
    return float(np.clip(both, 0.0, None).prod() / smaller)


def _area(points: FloatArray, size: Size) -> float:
    """Share of the picture that the points spread over: the box of the middle 90 % of each coordinate."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(((high - low) / np.array(size)).prod())
