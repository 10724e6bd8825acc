"""The radius that holds a share of a Gaussian's errors; without SciPy, whose import takes time."""

import math
from statistics import NormalDist

import numpy as np

from featuredb.geometry.arrays import FloatArray


def error_radius(covariance: FloatArray, share: float = 0.68) -> float:
    """Radius around a Gaussian's mean that holds a share of it, for covariances (d, d), d = 1, 2 or 3.

    The squared distance is a weighted sum of chi-squares; a gamma distribution with its mean and variance
    (Satterthwaite) is exact for d = 1 and for equal weights, and within 2 % in radius in between.
    """
    weights = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean, variance = float(weights.sum()), float(2.0 * (weights**2).sum())
    if mean <= 0.0:
        return 0.0
    return math.sqrt(_gamma_quantile(mean**2 / variance, share) * variance / mean)


def _gamma_quantile(shape: float, share: float) -> float:
    """Of the gamma distribution of unit scale: Newton's steps from Wilson and Hilferty's approximation."""
    third = 1.0 / (9.0 * shape)
    x = shape * max(1.0 - third + NormalDist().inv_cdf(share) * math.sqrt(third), 0.05) ** 3
    for _ in range(20):
        term = total = 1.0 / shape  # the series of the incomplete gamma function
        k = shape
        while term > 1e-16 * total:
            k += 1.0
            term *= x / k
            total += term
        density = math.exp((shape - 1.0) * math.log(x) - x - math.lgamma(shape))
        step = (total * x * density - share) / density
        x = max(x - step, 0.1 * x)
        if abs(step) < 1e-13 * x:
            break
    return x
