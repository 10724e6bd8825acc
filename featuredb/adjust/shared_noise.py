"""What neighbouring residuals share: sums over a part of a photo vary more than independent ones would."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray


def shared_variance_px2(
    residuals: FloatArray, pixels: FloatArray, photo_of: NDArray[np.int64], side_px: float
) -> float:
    """Variance of a coordinate of the residuals, times their design effect; arguments as there."""
    if len(residuals) == 0:
        return 0.0
    return _variance_px2(residuals) * design_effect(residuals, pixels, photo_of, side_px)


def design_effect(
    residuals: FloatArray, pixels: FloatArray, photo_of: NDArray[np.int64], side_px: float
) -> float:
    """How much more sums over parts of photos vary than without what neighbours share; at least 1.

    Kish, Survey Sampling, 1965, 8.2.

    Args:
        residuals, pixels: (m, 2). photo_of: (m,) their photos.
        side_px: longer side of the photos, of which a part is a quarter.
    """
    if len(residuals) == 0:
        return 1.0
    squared = (residuals**2).sum(axis=1)
    weighted = residuals / (1.0 + squared / max(4.0 * _variance_px2(residuals), 1e-12))[:, None]
    place = np.floor(4.0 * pixels / side_px).astype(np.int64)
    place -= place.min(axis=0)
    code = (photo_of * (place[:, 0].max() + 1) + place[:, 0]) * (place[:, 1].max() + 1) + place[:, 1]
    part = np.unique(code, return_inverse=True)[1]
    sums = np.stack([np.bincount(part, weights=weighted[:, k]) for k in range(2)])
    return max(1.0, float((sums**2).sum() / max((weighted**2).sum(), 1e-12)))


def _variance_px2(residuals: FloatArray) -> float:
    return (1.4826 * float(np.median(np.abs(residuals)))) ** 2
