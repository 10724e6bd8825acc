"""The ladder of lens models, SIMPLE_RADIAL, RADIAL, OPENCV: its rungs, and what one gains over the last."""

from dataclasses import replace

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera

MORE_OF_RADIAL = 1  # the second radial coefficient
MORE_OF_OPENCV = 5  # the other focal length, two tangential coefficients, the principal point


def as_radial(camera: Camera) -> Camera:
    """The same SIMPLE_RADIAL lens with a second coefficient of zero."""
    return replace(camera, model="RADIAL", params=(*camera.params, 0.0))


def as_opencv(camera: Camera) -> Camera:
    """The same RADIAL lens with two focal lengths and tangential coefficients of zero."""
    f, cx, cy, k1, k2 = camera.params
    return replace(camera, model="OPENCV", params=(f, f, cx, cy, k1, k2, 0.0, 0.0))


def center_shift_rel(camera: Camera) -> float:
    """Distance of an OPENCV lens's principal point from the image's middle, as a share of the longer side."""
    x, y = camera.params[2:4]
    offset = np.hypot(x - 0.5 * camera.width, y - 0.5 * camera.height)
    return float(offset / max(camera.width, camera.height))


def information_gain(before: FloatArray, after: FloatArray, more_parameters: int) -> float:
    """Drop of twice the negative log-likelihood, over the criterion's penalty for the parameters.

    Residuals (m, 2) of the same observations, Cauchy-distributed with the scale that `before` shows.
    Schwarz, Estimating the dimension of a model, 1978.
    """
    scale = 1.4826 * max(float(np.median(np.abs(before))), 1e-6)
    drop = 2.0 * (_cauchy_cost(before, scale) - _cauchy_cost(after, scale))
    return float(drop / (more_parameters * np.log(before.size)))


def _cauchy_cost(residuals: FloatArray, scale: float) -> float:
    squared = np.sum(residuals**2, axis=1) / scale**2
    return float(np.log1p(np.where(np.isfinite(squared), squared, 1e12)).sum())
