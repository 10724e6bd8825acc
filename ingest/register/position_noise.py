"""How noisy positions are, estimated together with the similarity that carries a reconstruction to them.

    position_i = S center_i + bias + drift(t_i) + noise_i

For the horizontal axes and the vertical each: noise has heavy tails (Student's t with four degrees of
freedom, as weights of normal ones: Lange, Little, Taylor 1989), drift is a line
and a random walk along the time of the flight, the bias is shared by the flight and cannot be told from the
similarity's translation. What positions say of
themselves is a prior of these components of variance; they are estimated by restricted maximum likelihood
(Patterson, Thompson 1971) under it. Their own uncertainty is integrated over (importance sampling around
the mode), so that few positions give wide answers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.special import gammaln
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian

_TAIL = 4.0  # degrees of freedom of the noise
_ROUNDS = 12  # of weights and components; most settle in five
_MOST_STEP = 0.5  # of the logarithm of the scale and of a turn; further it is not linear
_SETTLED = 1e-3  # of a step over its standard deviation
NOISE_SHARE, _DRIFT_SHARE = 0.5, 0.4  # of the stated sigma: the middle of what they may be
_NOISE_SPREAD, _DRIFT_SPREAD = 1.0, 1.5  # of their logarithms
_TREND = 0.75  # of the variance of a drift at its end: what has one slope all along
_SAMPLES = 128
_UNKNOWN_SCALE, _UNKNOWN_TURN, _UNKNOWN_M = 1.0, 1.8, 1e5  # logarithm, radians: nothing is known
_DELTA = 0.1  # of a logarithm
_PROPOSAL = 5.0  # degrees of freedom of the t from which components are drawn
_LEAST_M = 1e-6
_RANGE = 7.0  # of logarithms: a thousand times more or less
_LEAST_PHOTOS = 3
_MOST_POSITIONS = 400  # more are thinned out evenly in time
_TURNS = 8.0  # local maxima of the likelihood over turns: each is a chance of its own
_INSIDE = 0.999  # of honest positions
_AXES = (np.array([0, 1]), np.array([2]))  # horizontal, vertical
_SIZES = np.array([2.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Standard deviations, metres, of an axis: horizontal and vertical.

    Attributes:
        white: of the noise of one position.
        drift: of the walk from the first position to the last.
    """

    white: tuple[float, float]
    drift: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyFit:
    """The similarity and what it is worth.

    Attributes:
        local_from_sfm: the similarity.
        covariance: (7, 7) of its left perturbation about the local origin, without the bias.
        noise: its most likely components.
        used: (n, 2) horizontal and vertical; others are so far out that one of a thousand honest ones is.
        log_chance: natural logarithm of how often positions that know nothing of the reconstruction fit as
            well, by the ratio of the likelihoods, both with their own components.
    """

    local_from_sfm: Sim3
    covariance: FloatArray
    noise: Noise
    used: NDArray[np.bool_]
    log_chance: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Data:
    """Positions of one reconstruction.

    Attributes:
        positions, sigmas: (n, 3), a coordinate that nobody knows has an infinite sigma.
        walk: (n, n) covariance of a walk of unit variance at its end.
        stated: (2,) median sigma, horizontal and vertical.
    """

    centers: FloatArray
    positions: FloatArray
    sigmas: FloatArray
    walk: FloatArray
    stated: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Axis:
    """Positions along one axis in a basis where noise and walk are independent.

    Attributes:
        group: 0 horizontal, 1 vertical.
        residual: (m,). jacobian: (m, p). walk: (m,) variance of a unit walk over that of unit noise.
    """

    group: int
    residual: FloatArray
    jacobian: FloatArray
    walk: FloatArray


def fit_noisy(
    start: Sim3, centers: FloatArray, positions: FloatArray, sigmas: FloatArray, times_s: FloatArray
) -> NoisyFit:
    """The similarity with all components of variance.

    Args:
        start: within the range where the similarity is linear.
        centers: (n, 3) camera centres of the reconstruction. positions: (n, 3) local, metres.
        sigmas: (n, 3) as stated, of the whole error; infinite where a coordinate is not known.
        times_s: (n,) of capture; their order is what counts most.
    """
    stated = np.array([_median(sigmas[:, axes]) for axes in _AXES])
    middle = Sim3(scale=1.0, rotation=np.eye(3), translation=np.median(np.nan_to_num(positions), axis=0))
    data = _Data(
        centers=centers,
        positions=middle.inverse().act(positions),
        sigmas=sigmas,
        walk=_walk(times_s),
        stated=stated,
    )
    sim, theta = middle.inverse() @ start, _prior_mean(stated)
    taken = np.zeros((len(centers), 1))
    taken[np.argsort(times_s, kind="stable")[:: -(-len(centers) // _MOST_POSITIONS)]] = 1.0
    weights = taken * _start_weights(data, sim)
    for _ in range(_ROUNDS):  # heavy tails: a start that nothing far out decides
        sim, theta, settled = _round(data, sim, weights, theta)
        weights = taken * _weights(_squared(data, sim, weights, theta))
        if settled:
            break
    used = np.zeros((len(centers), 2), dtype=np.bool_)
    for _ in range(_ROUNDS):  # then normal ones, without what is far out
        again = _squared(data, sim, weights, theta) <= chi2.ppf(_INSIDE, _SIZES)
        again |= (again & (taken > 0)).sum(axis=0) < _LEAST_PHOTOS
        if (again == used).all():
            break
        used, weights = again, taken * again
        sim, theta, _ = _round(data, sim, weights, theta)
    axes = _at(data, sim, weights)
    modes = _modes(axes, theta, stated)
    step, covariance = _integrated(axes, modes, stated)
    sim, theta = Sim3.exp(step) @ sim, modes[0]
    white, drift = np.exp(theta[:2]), np.exp(theta[2:])
    return NoisyFit(
        local_from_sfm=middle @ sim,
        covariance=middle.adjoint() @ covariance @ middle.adjoint().T,
        noise=Noise(white=(float(white[0]), float(white[1])), drift=(float(drift[0]), float(drift[1]))),
        used=used,
        log_chance=_log_chance(data, sim, weights, int(taken.sum())),
    )


def _round(data: _Data, sim: Sim3, weights: FloatArray, theta: FloatArray) -> tuple[Sim3, FloatArray, bool]:
    """Components, then similarity; whether it has settled."""
    axes = _at(data, sim, weights)
    theta = _most_likely(axes, theta, data.stated)
    step, covariance = _solution(axes, theta)
    settled = np.abs(step / np.sqrt(np.diag(covariance))).max() < _SETTLED
    far = float(np.abs(step[:4]).max()) / _MOST_STEP
    return Sim3.exp(step / max(far, 1.0)) @ sim, theta, bool(settled)


def _median(sigmas: FloatArray) -> float:
    """Of those that are known; any where none is."""
    known = sigmas[np.isfinite(sigmas)]
    return float(np.median(known)) if len(known) else 1.0


def _walk(times_s: FloatArray) -> FloatArray:
    """Covariance (n, n) of a drift that is nothing at the first time and of unit variance at the last."""
    since = times_s - times_s.min()
    last = float(since.max())
    if last == 0:
        return np.zeros((len(since), len(since)))
    share = np.asarray(since / last)
    return np.asarray((1.0 - _TREND) * np.minimum(share[:, None], share) + _TREND * np.outer(share, share))


def _prior_mean(stated: FloatArray) -> FloatArray:
    return np.asarray(np.log(np.concatenate([NOISE_SHARE * stated, _DRIFT_SHARE * stated])))


def _axes(data: _Data, residual: FloatArray, jacobian: FloatArray, weights: FloatArray) -> list[_Axis]:
    """East, north, up.

    Args:
        residual: (n, 3). jacobian: (n, 3, p).
    """
    result = []
    for group, axes in enumerate(_AXES):
        for axis in axes.tolist():
            known = np.isfinite(data.sigmas[:, axis]) & (weights[:, group] > 0)
            root = np.sqrt(weights[known, group]) * data.stated[group] / data.sigmas[known, axis]
            walk = data.walk[np.ix_(known, known)]
            variance, basis = np.linalg.eigh(root[:, None] * walk * root)
            result.append(
                _Axis(
                    group,
                    basis.T @ (root * residual[known, axis]),
                    basis.T @ (root[:, None] * jacobian[known, axis]),
                    np.maximum(variance, 0.0),
                )
            )
    return result


def _at(data: _Data, sim: Sim3, weights: FloatArray) -> list[_Axis]:
    placed = sim.act(data.centers)
    return _axes(data, data.positions - placed, point_jacobian(placed), weights)


def _normal(axes: list[_Axis], theta: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
    """Normal matrix (p, p), right side (p,), sum of squared residuals and of the variances' logarithms."""
    size = axes[0].jacobian.shape[1]
    known = np.array([_UNKNOWN_SCALE, *[_UNKNOWN_TURN] * 3, *[_UNKNOWN_M] * 3][-size:])
    matrix, right, squared, logs = np.diag(known**-2), np.zeros(size), 0.0, 0.0
    for axis in axes:
        variance = np.exp(2.0 * theta[axis.group]) + np.exp(2.0 * theta[2 + axis.group]) * axis.walk
        scaled = axis.jacobian / variance[:, None]
        matrix += axis.jacobian.T @ scaled
        right += scaled.T @ axis.residual
        squared += float((axis.residual**2 / variance).sum())
        logs += float(np.log(variance).sum())
    return matrix, right, squared, logs


def _cost(theta: FloatArray, axes: list[_Axis], stated: FloatArray | None) -> float:
    """Minus twice the logarithm of the restricted likelihood, with the prior where `stated` is given."""
    matrix, right, squared, logs = _normal(axes, theta)
    factor, lower = cho_factor(matrix)
    determinant = 2.0 * float(np.log(np.diag(factor)).sum())
    cost = logs + determinant + squared - float(right @ cho_solve((factor, lower), right))
    if stated is not None:
        spread = np.array([_NOISE_SPREAD] * 2 + [_DRIFT_SPREAD] * 2)
        cost += float((((theta - _prior_mean(stated)) / spread) ** 2).sum())
    return cost


def _most_likely(axes: list[_Axis], start: FloatArray, stated: FloatArray | None) -> FloatArray:
    """Logarithms (4,) of white noise and drift, horizontal and vertical."""
    bounds = [(value - _RANGE, value + _RANGE) for value in start]
    return np.asarray(minimize(_cost, start, (axes, stated), "L-BFGS-B", bounds=bounds).x)


def _solution(axes: list[_Axis], theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Step (7,) and its covariance; what nothing tells is as wide as it can be."""
    matrix, right, _, _ = _normal(axes, theta)
    covariance = np.linalg.inv(matrix)
    return np.asarray(covariance @ right), np.asarray(covariance)


def _modes(axes: list[_Axis], start: FloatArray, stated: FloatArray) -> list[FloatArray]:
    """The most likely components, best first: from those at hand, and as if all were drift, or all noise."""
    away = np.array([[-1.0, -1.0, 3.0, 3.0], [-1.0, 1.0, 3.0, -1.0], [1.0, -1.0, -1.0, 3.0]])
    starts = [start, *(_prior_mean(stated) + away)]
    found = [_most_likely(axes, at, stated) for at in starts]
    return sorted(found, key=lambda theta: _cost(theta, axes, stated))


def _integrated(
    axes: list[_Axis], modes: list[FloatArray], stated: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the step over what the components may be."""
    base = _cost(modes[0], axes, stated)
    widths = np.array([_widths(axes, mode, stated) for mode in modes])
    draws = np.random.default_rng(0).standard_t(_PROPOSAL, (len(modes), _SAMPLES // len(modes), 4))
    total, mean, spread = 0.0, np.zeros(7), np.zeros((7, 7))
    for at in (np.array(modes)[:, None] + widths[:, None] * draws).reshape(-1, 4):
        off = (at - np.array(modes)) / widths
        density = (
            np.exp(-0.5 * (_PROPOSAL + 1.0) * np.log1p(off**2 / _PROPOSAL).sum(axis=1)) / widths.prod(axis=1)
        ).sum()
        weight = float(np.exp(-0.5 * (_cost(at, axes, stated) - base)) / density)
        step, covariance = _solution(axes, at)
        total += weight
        mean += weight * step
        spread += weight * (covariance + np.outer(step, step))
    mean /= total
    return mean, spread / total - np.outer(mean, mean)


def _widths(axes: list[_Axis], theta: FloatArray, stated: FloatArray) -> FloatArray:
    """(4,) standard deviations of the components, each by itself."""
    base, widths = _cost(theta, axes, stated), np.empty(4)
    for k in range(4):
        step = np.zeros(4)
        step[k] = _DELTA
        bend = _cost(theta + step, axes, stated) + _cost(theta - step, axes, stated) - 2.0 * base
        widths[k] = 1.0 / np.sqrt(max(bend / (2.0 * _DELTA**2), 1.0 / _DRIFT_SPREAD**2))
    return widths


def _walked(data: _Data, residual: FloatArray, weights: FloatArray, theta: FloatArray) -> FloatArray:
    """The walk (n, 3) that is most likely for residuals (n, 3), with a constant taken off each axis."""
    result = np.zeros_like(residual)
    white, drift = np.exp(2.0 * theta[:2]), np.exp(2.0 * theta[2:])
    for group, axes in enumerate(_AXES):
        for axis in axes.tolist():
            known = np.isfinite(data.sigmas[:, axis]) & (weights[:, group] > 0)
            if not known.any():
                continue
            ratio = data.sigmas[known, axis] / data.stated[group]
            walk = drift[group] * data.walk
            own = walk[np.ix_(known, known)] + np.diag(white[group] * ratio**2 / weights[known, group])
            result[:, axis] = walk[:, known] @ np.linalg.solve(own, residual[known, axis])
    return result


def _squared(data: _Data, sim: Sim3, weights: FloatArray, theta: FloatArray) -> FloatArray:
    """(n, 2) squared residuals over the noise, horizontal and vertical, less the walk; 0 where not known."""
    residual = data.positions - sim.act(data.centers)
    rest = residual - _walked(data, residual, weights, theta)
    result = np.zeros_like(weights)
    for group, axes in enumerate(_AXES):
        known = np.isfinite(data.sigmas[:, axes]).all(axis=1)
        ratio = data.sigmas[known][:, axes] / data.stated[group]
        result[known, group] = (rest[known][:, axes] ** 2 / ratio**2).sum(axis=1)
        result[known, group] /= np.exp(2.0 * theta[group])
    return result


def _start_weights(data: _Data, sim: Sim3) -> FloatArray:
    """As if all were noise of the size that residuals have at the median."""
    nothing = _prior_mean(data.stated) - 20.0
    squared = _squared(data, sim, np.ones((len(data.centers), 2)), nothing * [0.0, 0.0, 1.0, 1.0])
    return _weights(squared / np.maximum(np.median(squared, axis=0) / chi2.ppf(0.5, _SIZES), _LEAST_M))


def _weights(squared: FloatArray) -> FloatArray:
    """Of Student's t."""
    return np.asarray((_TAIL + _SIZES) / (_TAIL + squared))


def _log_chance(data: _Data, sim: Sim3, weights: FloatArray, total: int) -> float:
    """See `NoisyFit`: four of the degrees of freedom are the scale's and the turn's, so that the ratio of the
    sums of squares, which is the likelihoods', has a beta distribution.

    Args:
        total: positions before any was left out.
    """
    shift = np.broadcast_to(np.eye(3), (len(data.centers), 3, 3))
    known = np.isfinite(data.sigmas) & (weights > 0)[:, [0, 0, 1]]
    off = np.where(np.isfinite(data.sigmas), data.positions, 0.0)
    costs = []
    for residual in (data.positions - sim.act(data.centers), off - np.median(off, axis=0)):
        axes = _axes(data, residual, shift, weights)
        spread = [np.square(residual[known[:, axes[0]]][:, axes]) for axes in _AXES]
        size = np.array([float(np.sqrt(of.mean())) if of.size else 1.0 for of in spread])
        start = np.log(np.maximum(np.concatenate([size, size]), _LEAST_M))
        costs.append(_cost(_most_likely(axes, start, None), axes, None))
    freedom = int(known.sum()) - 3
    half = (freedom - 4) / 2.0
    if half <= 0:
        return 0.0
    log_ratio = min((costs[0] - costs[1]) / freedom, 0.0)
    tail = half * log_ratio + np.log1p(half * -np.expm1(log_ratio))  # of beta(half, 2)
    kept = int((weights > 0).all(axis=1).sum())
    ways = gammaln(total + 1) - gammaln(kept + 1) - gammaln(total - kept + 1)
    return float(min(tail + ways + np.log(_TURNS), 0.0))
