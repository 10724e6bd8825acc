"""Derivatives of the exponential of SIM(3)."""

import numpy as np
from scipy.linalg import expm

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew

_SHORT = 1.0  # entries of the adjoint below which the series has converged after a dozen terms


def small_adjoint(tangent: FloatArray) -> FloatArray:
    """(7, 7) matrix of the Lie bracket with (sigma, omega, nu), the derivative of Sim3.adjoint."""
    sigma, omega, nu = float(tangent[0]), tangent[1:4], tangent[4:]
    ad = np.zeros((7, 7))
    ad[1:4, 1:4] = skew(omega)
    ad[4:, 0] = -nu
    ad[4:, 1:4] = skew(nu)
    ad[4:, 4:] = sigma * np.eye(3) + skew(omega)
    return ad


def left_jacobian(tangent: FloatArray) -> FloatArray:
    """J (7, 7) with exp(x + dx) = exp(J dx) exp(x) to first order.

    The integral of exp(t ad) over t in [0, 1]: its series where that is short, else the corner of one matrix
    exponential (Van Loan 1978).
    """
    ad = small_adjoint(np.asarray(tangent, dtype=np.float64))
    size = float(np.abs(ad).max())
    if size < _SHORT:
        total = term = np.eye(7)
        for k in range(2, 30):
            term = term @ ad / k
            total = total + term
            if np.abs(term).max() < 1e-17 * max(1.0, size):
                break
        return total
    both = np.zeros((14, 14))
    both[:7, :7] = ad
    both[:7, 7:] = np.eye(7)
    return np.asarray(expm(both)[:7, 7:], dtype=np.float64)
