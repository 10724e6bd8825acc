"""Focal lengths that EXIF's cannot be: is a reconstruction with the lens held at EXIF's the better one?

A rolling shutter, or a bad pair to begin with, leads mapping astray: photos stay outside or end in a wrong
basin, out of which no adjustment finds. Where most lenses are impossible after mapping, the photos are mapped
again with EXIF's focal lengths, which stay until the final adjustment. That attempt counts where the photos
support it better than chance explains; else EXIF may be what is wrong.
"""

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtr, ndtri

from ingest.colmap.adjust import residuals_of
from ingest.colmap.bridge import Model

logger = logging.getLogger(__name__)

_EXIF_SPREAD = 0.3  # of the logarithm of a focal length over EXIF's: pictures are cut, scaled, zoomed
_RATE = 0.001  # of such focal lengths are further off; of attempts that are as good seem so much better


def impossible(found_px: ArrayLike, exif_px: ArrayLike) -> NDArray[np.bool_]:
    """Which focal lengths (n,) cannot be, by those of EXIF; NaN where EXIF says none."""
    off = np.abs(np.log(np.asarray(found_px, np.float64) / np.asarray(exif_px, np.float64)))
    return np.asarray(off > -ndtri(_RATE / 2.0) * _EXIF_SPREAD)


def mostly_impossible(models: Sequence[Model], exif_px: Sequence[float | None]) -> bool:
    """Whether most photos of the models have such a focal length.

    Args:
        exif_px: of all photos.
    """
    wrong: list[bool] = []
    for model in models:
        found = [model.cameras[int(c)].focal_px for c in model.camera_of]
        told = [np.nan if exif_px[row] is None else exif_px[row] for row in model.rows.tolist()]
        wrong += impossible(found, np.array(told, dtype=np.float64)).tolist()
    return 2 * sum(wrong) > len(wrong)


def better_supported(
    held: Sequence[Model],
    free: Sequence[Model],
    keypoints: Sequence[NDArray[np.float32]],
    limit_px: float,
    dilution: float,
) -> bool:
    """Whether the photos support the models with the lens held better than chance explains.

    The variances of both attempts' residuals against their redundancy are compared (F test). Where one has
    less redundancy, as it has fewer photos or shorter tracks, what it lacks counts as off by the limit.

    Args:
        keypoints: (n, 2) of all photos.
        limit_px: beyond which observations are dropped.
        dilution: observations that count as one.
    """
    (held_sum, held_checks), (free_sum, free_checks) = (
        _squares_and_redundancy(models, keypoints, limit_px) for models in (held, free)
    )
    most = max(held_checks, free_checks)
    if not most:
        return False
    of_held = held_sum + (most - held_checks) * limit_px**2 / 2.0
    of_free = free_sum + (most - free_checks) * limit_px**2 / 2.0
    ratio = of_held / max(of_free, 1e-12)
    logger.info("variance with the lens held over that of a free one: %.3f, of %d checks", ratio, most)
    return bool(fdtr(most / dilution, most / dilution, ratio) < _RATE)


def _squares_and_redundancy(
    models: Sequence[Model], keypoints: Sequence[NDArray[np.float32]], limit_px: float
) -> tuple[float, int]:
    """Sum of the residuals' squares, none more than the limit's, and coordinates beyond what is estimated."""
    total, checks = 0.0, 0
    for model in models:
        block = model.block(model.pixels([keypoints[row] for row in model.rows.tolist()]))
        residuals, _, _ = residuals_of(block)
        total += float(np.minimum((residuals**2).sum(axis=1), limit_px**2).sum())
        estimated = 3 * len(model.xyz) + 6 * len(model.rows) + sum(len(c.params) for c in model.cameras) - 7
        checks += max(2 * len(residuals) - estimated, 0)
    return total, checks
