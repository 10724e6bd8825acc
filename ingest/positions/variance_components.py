"""Components of variance of a linear model whose noise is white beside a random walk.

Estimated by restricted maximum likelihood (Patterson, Thompson 1971) under a prior, and integrated over
(importance sampling around the modes), so that few observations give wide answers.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from featuredb.geometry.arrays import FloatArray

NOISE_SHARE, _DRIFT_SHARE = 0.5, 0.4  # of the stated sigma: the middle of what they may be
NOISE_SPREAD, _DRIFT_SPREAD = 1.0, 1.5  # of their logarithms
_SPREADS = np.array([NOISE_SPREAD] * 2 + [_DRIFT_SPREAD] * 2)
_SAMPLES = 128
_DELTA = 0.1  # of a logarithm
_PROPOSAL = 5.0  # degrees of freedom of the t from which components are drawn
_RANGE = 7.0  # of logarithms: a thousand times more or less


@dataclass(frozen=True, slots=True, eq=False)
class MixedModel:
    """A linear problem whose noise is independent once its components are given.

    Observations along all axes are in a basis where noise and walk are independent.

    Attributes:
        group: (m,) 0 horizontal, 1 vertical.
        residual: (m,). jacobian: (m, p). walk: (m,) variance of a unit walk over that of unit noise.
        known: (k, p) whitened Jacobian, off: (k,) residuals, of what is known beside them.
        least: variance of an observation that is no component's; covariances leave it to whoever reads them.
    """

    group: NDArray[np.intp]
    residual: FloatArray
    jacobian: FloatArray
    walk: FloatArray
    known: FloatArray
    off: FloatArray
    least: float = 0.0
    _squares: FloatArray = field(init=False)  # (m, p * p) of rows of the Jacobian: normal matrices are sums

    def __post_init__(self) -> None:
        squares = self.jacobian[:, :, None] * self.jacobian[:, None, :]
        object.__setattr__(self, "_squares", squares.reshape(len(squares), -1))

    def cost(self, theta: FloatArray, stated: FloatArray | None) -> FloatArray:
        """Minus twice the logarithm of the restricted likelihood, with the prior where `stated` is given.

        Args:
            theta: (..., 4); so many are the costs.
        """
        matrix, right, rest = self._normal(theta)
        step = np.linalg.solve(matrix, right[..., None])[..., 0]
        cost = rest + _log_determinant(matrix) - (right * step).sum(axis=-1)
        return np.asarray(cost if stated is None else cost + (_off(theta, stated) ** 2).sum(axis=-1))

    def most_likely(
        self, start: FloatArray, stated: FloatArray | None, least: FloatArray | None = None
    ) -> FloatArray:
        """Logarithms (4,) of white noise and drift, horizontal and vertical."""
        bounds = [(value - _RANGE, value + _RANGE) for value in start]
        if least is not None:
            bounds[:2] = [(float(low), high) for low, (_, high) in zip(least, bounds, strict=False)]
        return np.asarray(minimize(self._cost_and_slope, start, (stated,), "L-BFGS-B", True, bounds=bounds).x)

    def solution(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Steps (..., p) and their covariances; what nothing tells is as wide as it can be."""
        matrix, right, _ = self._normal(theta)
        step = np.linalg.solve(matrix, right[..., None])[..., 0]
        covariance = np.linalg.inv(replace(self, least=0.0)._normal(theta)[0])
        return np.asarray(step, dtype=np.float64), np.asarray(covariance, dtype=np.float64)

    def modes(self, start: FloatArray, stated: FloatArray) -> list[FloatArray]:
        """The most likely components, best first: from those at hand, and as if all were drift or noise."""
        away = np.array([[-1.0, -1.0, 3.0, 3.0], [-1.0, 1.0, 3.0, -1.0], [1.0, -1.0, -1.0, 3.0]])
        starts = [start, *(prior_mean(stated) + away)]
        found = [self.most_likely(at, stated) for at in starts]
        return sorted(found, key=lambda theta: float(self.cost(theta, stated)))

    def integrated(self, modes: list[FloatArray], stated: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the step over what the components may be."""
        widths = np.array([self._widths(mode, stated) for mode in modes])
        draws = np.random.default_rng(0).standard_t(_PROPOSAL, (len(modes), _SAMPLES // len(modes), 4))
        at = (np.array(modes)[:, None] + widths[:, None] * draws).reshape(-1, 4)
        off = (at[:, None] - np.array(modes)) / widths
        parts = -0.5 * (_PROPOSAL + 1.0) * np.log1p(off**2 / _PROPOSAL).sum(axis=2)
        density = np.logaddexp.reduce(parts - np.log(widths).sum(axis=1), axis=1)
        log_weight = -0.5 * self.cost(at, stated) - density
        weights = np.exp(log_weight - log_weight.max())
        weights /= weights.sum()
        steps, covariances = self.solution(at)
        mean = weights @ steps
        spread = np.tensordot(weights, covariances, 1) + (weights[:, None] * steps).T @ steps
        return mean, spread - np.outer(mean, mean)

    def _variances(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(..., m) of noise and of drift."""
        white, drift = np.exp(2.0 * theta[..., :2]), np.exp(2.0 * theta[..., 2:])
        return white[..., self.group], drift[..., self.group] * self.walk

    def _normal(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal matrices (..., p, p), right sides (..., p), and the costs (...,) that no step changes."""
        variance = self.least + sum(self._variances(theta))
        by_variance, size = 1.0 / variance, self.jacobian.shape[1]
        matrix = (by_variance @ self._squares).reshape(*theta.shape[:-1], size, size)
        right = by_variance @ (self.jacobian * self.residual[:, None]) + self.known.T @ self.off
        rest = by_variance @ self.residual**2 + self.off @ self.off + np.log(variance).sum(axis=-1)
        return matrix + self.known.T @ self.known, right, rest

    def _cost_and_slope(self, theta: FloatArray, stated: FloatArray | None) -> tuple[float, FloatArray]:
        """`cost` and its derivative (4,)."""
        matrix, right, rest = self._normal(theta)
        covariance = np.linalg.inv(matrix)
        step = covariance @ right
        cost = rest + _log_determinant(matrix) - right @ step
        white, drift = self._variances(theta)
        variance = self.least + white + drift
        left = (self.residual - self.jacobian @ step) ** 2
        left += ((self.jacobian @ covariance) * self.jacobian).sum(axis=1)
        by_variance = 2.0 * (1.0 / variance - left / variance**2)
        slope = np.concatenate([np.bincount(self.group, by_variance * of, 2) for of in (white, drift)])
        if stated is not None:
            off = _off(theta, stated)
            cost, slope = cost + (off**2).sum(), slope + 2.0 * off / _SPREADS
        return float(cost), slope

    def _widths(self, theta: FloatArray, stated: FloatArray) -> FloatArray:
        """(4,) standard deviations of the components, each by itself."""
        aside = _DELTA * np.eye(4)
        bend = self.cost(theta + aside, stated) + self.cost(theta - aside, stated)
        bend -= 2.0 * self.cost(theta, stated)
        return np.asarray(1.0 / np.sqrt(np.maximum(bend / (2.0 * _DELTA**2), 1.0 / _DRIFT_SPREAD**2)))


def _log_determinant(matrix: FloatArray) -> FloatArray:
    """Of positive definite matrices (..., p, p)."""
    roots = np.diagonal(np.linalg.cholesky(matrix), axis1=-2, axis2=-1)
    return np.asarray(2.0 * np.log(roots).sum(axis=-1))


def _off(theta: FloatArray, stated: FloatArray) -> FloatArray:
    """(..., 4) from the middle of the prior, in its standard deviations."""
    return np.asarray((theta - prior_mean(stated)) / _SPREADS)


def prior_mean(stated: FloatArray) -> FloatArray:
    """Logarithms (4,) of the components by `stated` sigmas, horizontal and vertical (2,)."""
    return np.asarray(np.log(np.concatenate([NOISE_SHARE * stated, _DRIFT_SHARE * stated])))


def stated_sigma(sigmas: FloatArray) -> float:
    """The median of those that are known, metres; one where none is."""
    known = sigmas[np.isfinite(sigmas)]
    return float(np.median(known)) if len(known) else 1.0
