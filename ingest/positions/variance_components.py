"""Components of variance of a linear model whose noise is white beside a random walk.

Estimated by restricted maximum likelihood (Patterson, Thompson 1971) under a prior, and integrated over
(importance sampling around the modes), so that few observations give wide answers.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from featuredb.geometry.arrays import FloatArray

NOISE_SHARE, _DRIFT_SHARE = 0.5, 0.4  # of the stated sigma: the middle of what they may be
NOISE_SPREAD, _DRIFT_SPREAD = 1.0, 1.5  # of their logarithms
_SAMPLES = 128
_DELTA = 0.1  # of a logarithm
_PROPOSAL = 5.0  # degrees of freedom of the t from which components are drawn
_RANGE = 7.0  # of logarithms: a thousand times more or less


@dataclass(frozen=True, slots=True, eq=False)
class ModelAxis:
    """Observations along one axis in a basis where noise and walk are independent.

    Attributes:
        group: 0 horizontal, 1 vertical.
        residual: (m,). jacobian: (m, p). walk: (m,) variance of a unit walk over that of unit noise.
    """

    group: int
    residual: FloatArray
    jacobian: FloatArray
    walk: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MixedModel:
    """A linear problem whose noise is independent once its components are given.

    Attributes:
        axes: east, north, up.
        known: (m, p) whitened Jacobian, off: (m,) residuals, of what is known beside them.
        least: variance of an observation that is no component's; covariances leave it to whoever reads them.
    """

    axes: list[ModelAxis]
    known: FloatArray
    off: FloatArray
    least: float = 0.0

    def cost(self, theta: FloatArray, stated: FloatArray | None) -> float:
        """Minus twice the logarithm of the restricted likelihood, with the prior where `stated` is given."""
        return self._cost_and_slope(theta, stated)[0]

    def most_likely(
        self, start: FloatArray, stated: FloatArray | None, least: FloatArray | None = None
    ) -> FloatArray:
        """Logarithms (4,) of white noise and drift, horizontal and vertical."""
        bounds = [(value - _RANGE, value + _RANGE) for value in start]
        if least is not None:
            bounds[:2] = [(float(low), high) for low, (_, high) in zip(least, bounds, strict=False)]
        return np.asarray(minimize(self._cost_and_slope, start, (stated,), "L-BFGS-B", True, bounds=bounds).x)

    def solution(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Step (7,) and its covariance; what nothing tells is as wide as it can be."""
        matrix, right, _, _ = self._normal(theta)
        return (
            np.asarray(np.linalg.solve(matrix, right)),
            np.asarray(np.linalg.inv(replace(self, least=0.0)._normal(theta)[0])),
        )

    def modes(self, start: FloatArray, stated: FloatArray) -> list[FloatArray]:
        """The most likely components, best first: from those at hand, and as if all were drift or noise."""
        away = np.array([[-1.0, -1.0, 3.0, 3.0], [-1.0, 1.0, 3.0, -1.0], [1.0, -1.0, -1.0, 3.0]])
        starts = [start, *(prior_mean(stated) + away)]
        found = [self.most_likely(at, stated) for at in starts]
        return sorted(found, key=lambda theta: self.cost(theta, stated))

    def integrated(self, modes: list[FloatArray], stated: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the step over what the components may be."""
        widths = np.array([self._widths(mode, stated) for mode in modes])
        draws = np.random.default_rng(0).standard_t(_PROPOSAL, (len(modes), _SAMPLES // len(modes), 4))
        at = (np.array(modes)[:, None] + widths[:, None] * draws).reshape(-1, 4)
        off = (at[:, None] - np.array(modes)) / widths
        parts = -0.5 * (_PROPOSAL + 1.0) * np.log1p(off**2 / _PROPOSAL).sum(axis=2)
        density = np.logaddexp.reduce(parts - np.log(widths).sum(axis=1), axis=1)
        log_weight = np.array([-0.5 * self.cost(theta, stated) for theta in at]) - density
        weights = np.exp(log_weight - log_weight.max())
        weights /= weights.sum()
        mean, spread = np.zeros(8), np.zeros((8, 8))
        for theta, weight in zip(at, weights.tolist(), strict=True):
            step, covariance = self.solution(theta)
            mean += weight * step
            spread += weight * (covariance + np.outer(step, step))
        return mean, spread - np.outer(mean, mean)

    def _normal(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Normal matrix (p, p), right side (p,), sums of squared residuals and logarithms of variances."""
        matrix, right = self.known.T @ self.known, self.known.T @ self.off
        squared, logs = float(self.off @ self.off), 0.0
        for axis in self.axes:
            variance = self.least + np.exp(2.0 * theta[axis.group])
            variance = variance + np.exp(2.0 * theta[2 + axis.group]) * axis.walk
            scaled = axis.jacobian / variance[:, None]
            matrix = matrix + axis.jacobian.T @ scaled
            right = right + scaled.T @ axis.residual
            squared += float((axis.residual**2 / variance).sum())
            logs += float(np.log(variance).sum())
        return matrix, right, squared, logs

    def _cost_and_slope(self, theta: FloatArray, stated: FloatArray | None) -> tuple[float, FloatArray]:
        """`cost` and its derivative (4,)."""
        matrix, right, squared, logs = self._normal(theta)
        factor, lower = cho_factor(matrix)
        covariance = cho_solve((factor, lower), np.eye(len(matrix)))
        step = covariance @ right
        cost = logs + 2.0 * float(np.log(np.diag(factor)).sum()) + squared - float(right @ step)
        slope = np.zeros(4)
        for axis in self.axes:
            white, drift = np.exp(2.0 * theta[axis.group]), np.exp(2.0 * theta[2 + axis.group]) * axis.walk
            variance = self.least + white + drift
            left = (axis.residual - axis.jacobian @ step) ** 2
            left += ((axis.jacobian @ covariance) * axis.jacobian).sum(axis=1)
            by_variance = 2.0 * (1.0 / variance - left / variance**2)
            slope[axis.group] += white * float(by_variance.sum())
            slope[2 + axis.group] += float((drift * by_variance).sum())
        if stated is not None:
            spread = np.array([NOISE_SPREAD] * 2 + [_DRIFT_SPREAD] * 2)
            off = (theta - prior_mean(stated)) / spread
            cost += float((off**2).sum())
            slope += 2.0 * off / spread
        return cost, slope

    def _widths(self, theta: FloatArray, stated: FloatArray) -> FloatArray:
        """(4,) standard deviations of the components, each by itself."""
        base, widths = self.cost(theta, stated), np.empty(4)
        for k in range(4):
            step = np.zeros(4)
            step[k] = _DELTA
            bend = self.cost(theta + step, stated) + self.cost(theta - step, stated) - 2.0 * base
            widths[k] = 1.0 / np.sqrt(max(bend / (2.0 * _DELTA**2), 1.0 / _DRIFT_SPREAD**2))
        return widths


def prior_mean(stated: FloatArray) -> FloatArray:
    """Logarithms (4,) of the components by `stated` sigmas, horizontal and vertical (2,)."""
    return np.asarray(np.log(np.concatenate([NOISE_SHARE * stated, _DRIFT_SHARE * stated])))


def stated_sigma(sigmas: FloatArray) -> float:
    """The median of those that are known, metres; one where none is."""
    known = sigmas[np.isfinite(sigmas)]
    return float(np.median(known)) if len(known) else 1.0
