"""What photos have in common without showing the same place: watermarks, borders, and copies of a picture.

A watermark or a frame stands at the same pixels of all photos that it was put on. Its features match
perfectly, and would tie together photos of different towns.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlayOptions:
    """What counts as an overlay and as a copy. Pixels are those of an image of `reference_side_px`.

    Attributes:
        still_px: matches that move less between photos of one size stand still. Hands and drones move by
            tens of pixels from one photo to the next.
        most_still: up to this share of the matches, those that stand still are dropped and the rest is
            judged by itself; above it, they are either all there is, or the camera stood still.
        overlay_area: matches that stand still within less than this share of the picture are an overlay;
            a camera that stands still has them all over.
        copy_px: of matches of two encodings of one picture, cut and resized as may be.
        copy_share: of the verified matches that fit one shift and zoom.
        copy_turn_deg: between the two; people cut and scale what they copy.
        copy_inside: of the smaller picture's area that lies in the other. Neighbours of a flight over flat
            ground fit a shift and zoom as well, but overlap in part.
        copy_matches: fewer say nothing.
        reference_side_px: keypoints are located on images of about this size.
    """

    still_px: float = 1.5
    most_still: float = 0.5
    overlay_area: float = 0.25
    copy_px: float = 2.0
    copy_share: float = 0.9
    copy_turn_deg: float = 0.3
    copy_inside: float = 0.95
    copy_matches: int = 50
    reference_side_px: int = 1600


Size = tuple[int, int]
"""Width and height, pixels."""


def without_overlay(
    xy_a: NDArray[np.float32],
    xy_b: NDArray[np.float32],
    size_a: Size,
    size_b: Size,
    matches: NDArray[np.uint32],
    options: OverlayOptions,
) -> NDArray[np.uint32]:
    """Matches (m, 2) without those that stand still as a watermark or a frame does.

    Args:
        xy_a, xy_b: keypoints (n, 2) of both photos.
    """
    if size_a != size_b or not len(matches):
        return matches
    a, b = xy_a[matches[:, 0]].astype(np.float64), xy_b[matches[:, 1]].astype(np.float64)
    zoom = max(1.0, max(size_a) / options.reference_side_px)
    still = np.linalg.norm(a - b, axis=1) <= options.still_px * zoom
    if still.mean() > options.most_still and _area(a[still], size_a) >= options.overlay_area:
        return matches
    return np.asarray(matches[~still])


def is_copy(a: FloatArray, b: FloatArray, size_a: Size, size_b: Size, options: OverlayOptions) -> bool:
    """Whether verified matches are those of two copies of one picture, one perhaps cut or framed.

    Args:
        a, b: (m, 2) pixels of both.
    """
    if len(a) < options.copy_matches:
        return False
    zoom = max(1.0, max(*size_a, *size_b) / options.reference_side_px)
    scale, shift = _zoom_and_shift(a, b)
    errors = np.linalg.norm(scale * a + shift - b, axis=1)
    if (errors <= options.copy_px * zoom).mean() < options.copy_share:
        return False
    turned, _ = cv2.estimateAffinePartial2D(a, b, method=cv2.LMEDS)
    if turned is None or abs(np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))) > options.copy_turn_deg:
        return False
    return _inside(scale, shift, size_a, size_b) >= options.copy_inside


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
