"""The radius that holds a share of a Gaussian's errors."""

import numpy as np
from scipy.special import gammaincinv

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
    return float(np.sqrt(gammaincinv(mean**2 / variance, share) * variance / mean))
