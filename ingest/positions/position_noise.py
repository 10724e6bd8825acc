"""How noisy positions are, estimated together with the similarity that carries a reconstruction to them.

    position_i = S (center_i + shape_i) + bias + drift(t_i) + noise_i

For the horizontal axes and the vertical each: noise is independent, drift is a line and a random walk along
the time of the flight, the bias that a flight shares cannot be told from the similarity's translation. What
is left of the lens' error bends the reconstruction: without that shape, survey-grade positions would seem to
drift (the map's own covariances have it). What positions say of themselves is a prior of these components of
variance (`MixedModel`). Positions far out are found with weights of Student's t (Lange, Little, Taylor 1989)
and then left out.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, gammaln

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.positions.held import ANGLES_WRONG, Held
from ingest.positions.one_height import told_once
from ingest.positions.receivers import places_apart
from ingest.positions.variance_components import MixedModel, prior_mean, stated_sigma

_TAIL = 4.0  # degrees of freedom of Student's t, until what is far out is known
_ROUNDS = 12  # of weights and components; most settle in five
_MOST_STEP = 0.5  # of the logarithm of the scale and of a turn; further it is not linear
_SETTLED = 1e-3  # of a step over its standard deviation
_TREND = 0.75  # of the variance of a drift at its end: what has one slope all along
_UNKNOWN_SCALE, _UNKNOWN_TURN, _UNKNOWN_M = 1.0, 1.8, 1e5  # logarithm, radians: nothing is known
_LEAST_M = 1e-6
_LEAST_PHOTOS = 3
_ONE_PLACE = 2.0  # standard deviations of a position: many people who stand so close tell one
_LEAST_SHARE = 0.02  # of a stated sigma: the least noise that counts where chance is judged
_LAG_SHARE = 0.5  # of a stated sigma that may be a lag
_MOST_LAG_S = 1.0  # standard deviation of a lag
_STEADY_S = 20.0
_MOST_SMOOTH = 0.95  # correlation of neighbours
_SHAPE = 1e-3  # of the centres' distance from their middle: 0.9e-3 on entry-P10, 0.7e-3 on fountain-P11
_MOST_POSITIONS = 400  # more are thinned out evenly in time
_TURNS = 8.0  # local maxima of the likelihood over turns: each is a chance of its own
_INSIDE = 0.999  # of honest positions
_AXES = (np.array([0, 1]), np.array([2]))  # horizontal, vertical
_GROUP_OF = (0, 0, 1)  # of east, north, up
_SIZES = np.array([2.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoisyFit:
    """The similarity and what it is worth.

    Attributes:
        local_from_sfm: the similarity.
        covariance: (7, 7) of its left perturbation about the local origin, without the bias.
        white_m, drift_m: (2,) most likely standard deviations, horizontal and vertical: of the noise of one
            position, and of the walk from the first position to the last.
        lag_s: by which positions are late.
        checked_turn_rad: the same of its turn, without what is only assumed of how photos are held; largest.
        used: (n, 2) horizontal and vertical; others are so far out that one of a thousand honest ones is.
        log_chance: natural logarithm of how often positions that know nothing of the reconstruction fit as
            well, by the ratio of the likelihoods, both with their own components.
        log_chance_of_path: the same of positions along another smooth way, where fewer count.
    """

    local_from_sfm: Sim3
    covariance: FloatArray
    white_m: FloatArray
    drift_m: FloatArray
    lag_s: float
    checked_turn_rad: float
    used: NDArray[np.bool_]
    log_chance: float
    log_chance_of_path: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Data:
    """Positions of one reconstruction.

    Attributes:
        positions, sigmas: (n, 3), a coordinate that nobody knows has an infinite sigma.
        walk: (n, n) covariance of a walk of unit variance at its end.
        many: people told the positions.
        order: (n,) rows in the order of time.
        stated: (2,) median sigma, horizontal and vertical.
        speed: (n, 3) metres of the reconstruction a second; 0 where it is not known.
        shape_m: standard deviation of a centre's coordinate by the reconstruction's own shape.
        lag_sigma_s: of the time between a photo and its position.
        held: how the photos are held, or None.
    """

    centers: FloatArray
    positions: FloatArray
    sigmas: FloatArray
    walk: FloatArray
    many: bool
    order: NDArray[np.intp]
    stated: FloatArray
    speed: FloatArray
    shape_m: float
    lag_sigma_s: float
    held: Held | None


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The similarity and the lag, in seconds, by which positions are late."""

    sim: Sim3
    lag_s: float

    def residual(self, data: "_Data") -> FloatArray:
        """(n, 3) of the positions."""
        return data.positions - self.sim.act(data.centers) - self.lag_s * self._speed(data)

    def jacobian(self, data: "_Data") -> FloatArray:
        """(n, 3, 8) by lag and similarity."""
        placed = self.sim.act(data.centers)
        return np.concatenate([self._speed(data)[:, :, None], point_jacobian(placed)], axis=2)

    def moved(self, step: FloatArray) -> "_State":
        """After a step (8,), no further than where it is linear."""
        most = max(float(np.abs(step[1:5]).max()) / _MOST_STEP, 1.0)
        return _State(Sim3.exp(step[1:] / most) @ self.sim, self.lag_s + float(step[0]) / most)

    def known(self, data: "_Data") -> tuple[FloatArray, FloatArray]:
        """Jacobian (m, 8) and residual (m,), whitened, of what is known beside positions."""
        # A lag has heavy tails: as Student's t of three degrees of freedom weighs it.
        lag_s = np.sqrt(0.25 * (3.0 * data.lag_sigma_s**2 + self.lag_s**2))
        wide = np.array([lag_s, _UNKNOWN_SCALE, *[_UNKNOWN_TURN] * 3, *[_UNKNOWN_M] * 3])
        rows, off = [np.diag(1.0 / wide)], [np.array([-self.lag_s / lag_s, *[0.0] * 7])]
        if data.held is not None:
            square, slope, angle = data.held.terms(self.sim.rotation)
            # Beyond some deviations angles are wrong altogether, and pull the less the further off they are.
            joint = data.held.joint_rad * np.maximum(angle / (ANGLES_WRONG * data.held.sigma_rad), 1.0)
            rows.append(np.pad(slope / joint[:, None], ((0, 0), (2, 3))))
            off.append(-square / joint)
        return np.vstack(rows), np.concatenate(off)

    def _speed(self, data: "_Data") -> FloatArray:
        return -self.sim.scale * data.speed @ self.sim.rotation.T


def fit_noisy(
    start: Sim3,
    centers: FloatArray,
    positions: FloatArray,
    sigmas: FloatArray,
    times_s: FloatArray | None = None,
    held: Held | None = None,
    many: bool = False,
) -> NoisyFit:
    """The similarity with all components of variance.

    Args:
        start: within the range where the similarity is linear.
        centers: (n, 3) camera centres of the reconstruction. positions: (n, 3) local, metres.
        sigmas: (n, 3) as stated, of the whole error; infinite where a coordinate is not known.
        times_s: (n,) of capture; None: in the order given, and nothing is known of a lag.
        held: how the photos are held.
        many: people told the positions, about one each: there is no drift that they share.
    """
    stated = np.array([stated_sigma(sigmas[:, axes]) for axes in _AXES])
    middle = Sim3(scale=1.0, rotation=np.eye(3), translation=np.median(np.nan_to_num(positions), axis=0))
    speed, order = np.zeros_like(centers), np.arange(len(centers), dtype=np.float64)
    if times_s is not None:
        speed, order = _speeds(centers, times_s), times_s
    moving = np.linalg.norm(speed, axis=1)
    usual = start.scale * float(np.median(moving[moving > 0])) if moving.any() else 0.0
    taken = np.zeros((len(centers), 1))
    taken[np.argsort(order, kind="stable")[:: -(-len(centers) // _MOST_POSITIONS)]] = 1.0
    sigmas = told_once(positions, sigmas, start.act(centers), taken[:, 0] > 0)
    data = _Data(
        centers=centers,
        positions=middle.inverse().act(positions),
        sigmas=sigmas,
        walk=np.zeros((len(centers), len(centers))) if many else _walk(order),
        many=many,
        order=np.argsort(order, kind="stable"),
        stated=stated,
        speed=speed,
        shape_m=_SHAPE * start.scale * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()),
        lag_sigma_s=min(_LAG_SHARE * stated[0] / usual, _MOST_LAG_S) if usual > 0 else _MOST_LAG_S,
        held=held,
    )
    state, theta = _State(middle.inverse() @ start, 0.0), prior_mean(stated)
    weights = taken * _start_weights(data, state)
    for _ in range(_ROUNDS):  # heavy tails: a start that nothing far out decides
        state, theta, settled = _round(data, state, weights, theta)
        weights = taken * _weights(_squared(data, state, weights, theta))
        if settled:
            break
    used = np.zeros((len(centers), 2), dtype=np.bool_)
    for _ in range(_ROUNDS):  # then normal ones, without what is far out
        again = _squared(data, state, weights, theta) <= chdtri(_SIZES, 1.0 - _INSIDE)
        again |= (again & (taken > 0)).sum(axis=0) < _LEAST_PHOTOS
        if (again == used).all():
            break
        used, weights = again, taken * again
        state, theta, _ = _round(data, state, weights, theta)
    problem = _at(data, state, weights)
    modes = problem.modes(theta, stated)
    step, covariance = problem.integrated(modes, stated)
    checked = covariance[2:5, 2:5]
    if held is not None and not held.checked:
        free = _at(replace(data, held=None), state, weights)
        checked = free.integrated(modes, stated)[1][2:5, 2:5]
    state, theta = state.moved(step), modes[0]
    chance = _log_chance(data, state, weights, int(taken.sum()))
    return NoisyFit(
        local_from_sfm=middle @ state.sim,
        covariance=middle.carried(covariance[1:, 1:]),
        white_m=np.exp(theta[:2]),
        drift_m=np.exp(theta[2:]),
        lag_s=state.lag_s,
        checked_turn_rad=float(np.sqrt(np.linalg.eigvalsh(checked)[-1])),
        used=used,
        log_chance=chance[0],
        log_chance_of_path=chance[1],
    )


def _round(
    data: _Data, state: _State, weights: FloatArray, theta: FloatArray
) -> tuple[_State, FloatArray, bool]:
    """Components, then similarity; whether it has settled."""
    problem = _at(data, state, weights)
    theta = problem.most_likely(theta, data.stated)
    step, covariance = problem.solution(theta)
    settled = np.abs(step / np.sqrt(np.diag(covariance))).max() < _SETTLED
    return state.moved(step), theta, bool(settled)


def _speeds(centers: FloatArray, times_s: FloatArray) -> FloatArray:
    """(n, 3) between the photos before and after; 0 beyond the longest time that a camera moves steadily."""
    order = np.argsort(times_s, kind="stable")
    at, when = centers[order], times_s[order]
    before, after = np.maximum(np.arange(len(at)) - 1, 0), np.minimum(np.arange(len(at)) + 1, len(at) - 1)
    time = when[after] - when[before]
    steady = (time > 0) & (time <= 2.0 * _STEADY_S)
    speed = np.zeros_like(centers)
    speed[order[steady]] = (at[after] - at[before])[steady] / time[steady, None]
    return speed


def _walk(times_s: FloatArray) -> FloatArray:
    """Covariance (n, n) of a drift that is nothing at the first time and of unit variance at the last."""
    since = times_s - times_s.min()
    last = float(since.max())
    if last == 0:
        return np.zeros((len(since), len(since)))
    share = np.asarray(since / last)
    return np.asarray((1.0 - _TREND) * np.minimum(share[:, None], share) + _TREND * np.outer(share, share))


def _model(
    data: _Data,
    residual: FloatArray,
    jacobian: FloatArray,
    weights: FloatArray,
    known: tuple[FloatArray, FloatArray],
    least: float = 0.0,
) -> MixedModel:
    """Of east, north and up.

    Args:
        residual: (n, 3). jacobian: (n, 3, p).
        known: Jacobian (k, p) and residual (k,), whitened, of what is known beside positions.
        least: variance, as `MixedModel` has it.
    """
    groups, residuals, jacobians, walks = [], [], [], []
    for axis, group in enumerate(_GROUP_OF):
        there = np.isfinite(data.sigmas[:, axis]) & (weights[:, group] > 0)
        root = np.sqrt(weights[there, group]) * data.stated[group] / data.sigmas[there, axis]
        variance, basis = np.linalg.eigh(root[:, None] * data.walk[np.ix_(there, there)] * root)
        groups.append(np.full(len(root), group))
        residuals.append(basis.T @ (root * residual[there, axis]))
        jacobians.append(basis.T @ (root[:, None] * jacobian[there, axis]))
        walks.append(np.maximum(variance, 0.0))
    return MixedModel(
        group=np.concatenate(groups),
        residual=np.concatenate(residuals),
        jacobian=np.concatenate(jacobians),
        walk=np.concatenate(walks),
        known=known[0],
        off=known[1],
        least=least,
    )


def _at(data: _Data, state: _State, weights: FloatArray) -> MixedModel:
    residual, jacobian = state.residual(data), state.jacobian(data)
    return _model(data, residual, jacobian, weights, state.known(data), data.shape_m**2)


def _walked(data: _Data, residual: FloatArray, weights: FloatArray, theta: FloatArray) -> FloatArray:
    """The walk (n, 3) that is most likely for residuals (n, 3), with a constant taken off each axis."""
    result = np.zeros_like(residual)
    white, drift = data.shape_m**2 + np.exp(2.0 * theta[:2]), np.exp(2.0 * theta[2:])
    for axis, group in enumerate(_GROUP_OF):
        known = np.isfinite(data.sigmas[:, axis]) & (weights[:, group] > 0)
        if not known.any():
            continue
        ratio = data.sigmas[known, axis] / data.stated[group]
        walk = drift[group] * data.walk
        own = walk[np.ix_(known, known)] + np.diag(white[group] * ratio**2 / weights[known, group])
        result[:, axis] = walk[:, known] @ np.linalg.solve(own, residual[known, axis])
    return result


def _squared(data: _Data, state: _State, weights: FloatArray, theta: FloatArray) -> FloatArray:
    """(n, 2) squared residuals over the noise, horizontal and vertical, less the walk; 0 where not known."""
    residual = state.residual(data)
    own = residual - _walked(data, residual, weights, theta)
    return _relative(data, own) / (data.shape_m**2 + np.exp(2.0 * theta[:2]))


def _relative(data: _Data, residual: FloatArray) -> FloatArray:
    """(n, 2) squares of residuals (n, 3), square metres at the median sigma, horizontal and vertical."""
    result = np.zeros((len(residual), 2))
    for group, axes in enumerate(_AXES):
        known = np.isfinite(data.sigmas[:, axes]).all(axis=1)
        ratio = data.sigmas[known][:, axes] / data.stated[group]
        result[known, group] = (residual[known][:, axes] ** 2 / ratio**2).sum(axis=1)
    return result


def _start_weights(data: _Data, state: _State) -> FloatArray:
    """As if all were noise of the size that residuals have at the median."""
    squared = _relative(data, state.residual(data))
    return _weights(squared / np.maximum(np.median(squared, axis=0) / chdtri(_SIZES, 0.5), _LEAST_M))


def _weights(squared: FloatArray) -> FloatArray:
    """Of Student's t."""
    return np.asarray((_TAIL + _SIZES) / (_TAIL + squared))


def _log_chance(data: _Data, state: _State, weights: FloatArray, total: int) -> tuple[float, float]:
    """See `NoisyFit`: of positions that have nothing in common, and along another way; total: of all."""
    shift = np.broadcast_to(np.eye(3), (len(data.centers), 3, 3))
    known = np.isfinite(data.sigmas) & (weights > 0)[:, [0, 0, 1]]
    off = np.where(np.isfinite(data.sigmas), data.positions, 0.0)
    costs, theta, places = [], np.zeros(4), len(data.centers)
    for residual in (state.residual(data), off - np.median(off, axis=0)):
        problem = _model(data, residual, shift, weights, (np.eye(3) / _UNKNOWN_M, np.zeros(3)))
        spread = [np.square(residual[known[:, axes[0]]][:, axes]) for axes in _AXES]
        size = np.array([float(np.sqrt(of.mean())) if of.size else 1.0 for of in spread])
        size = np.maximum(size, _LEAST_SHARE * data.stated)  # heights that are all the same are told in steps
        start = np.log(np.concatenate([size, size]))
        theta = problem.most_likely(start, None, np.log(_LEAST_SHARE * data.stated))
        costs.append(float(problem.cost(theta, None)))
        if data.many and len(costs) == 1:
            places = places_apart(state.sim.act(data.centers)[known[:, 0]], _ONE_PLACE * np.exp(theta[0]))
    apart = min(places / max(int(known[:, 0].sum()), 1), 1.0)
    freedom, taken_up = apart * (int(known.sum()) - 3), 6 if data.speed.any() else 4
    # The noise of a place's mean is less than that of one who stands there.
    log_ratio = apart * (costs[0] - costs[1]) / freedom + np.log(apart) if freedom > 0 else 0.0
    kept = int((weights > 0).all(axis=1).sum())
    ways = gammaln(total + 1) - gammaln(kept + 1) - gammaln(total - kept + 1) + np.log(_TURNS)
    count = _own_share(data, off, known, theta) * freedom
    own, way = (_log_beta_tail(log_ratio, of, taken_up, ways) for of in (freedom, count))
    return own, way


def _log_beta_tail(log_ratio: float, freedom: float, taken_up: int, log_tries: float) -> float:
    """Logarithm of how often a ratio of sums of squares, or of likelihoods, is as small, in so many tries.

    It has a beta distribution: four degrees of freedom are the scale's and the turn's, two a lag's.
    """
    half = (freedom - taken_up) / 2.0
    if half <= 0:
        return 0.0
    log_ratio = min(log_ratio, 0.0)
    rest = half * -np.expm1(log_ratio)
    beta = 1.0 + rest + (0.0 if taken_up == 4 else 0.5 * (1.0 + 1.0 / half) * rest**2)
    return float(min(half * log_ratio + np.log(beta) + log_tries, 0.0))


def _own_share(data: _Data, residual: FloatArray, known: NDArray[np.bool_], theta: FloatArray) -> float:
    """How many of residuals (n, 3) count, as a share: those of a smooth way follow from the ones before.

    Of an autoregressive process of first order, after noise and walk are whitened in the order of time.
    """
    order = data.order
    together, alone = 0.0, _LEAST_M**2
    for axis, group in enumerate(_GROUP_OF):
        rows = order[known[order, axis]]
        if len(rows) < _LEAST_PHOTOS:
            continue
        ratio = data.sigmas[rows, axis] / data.stated[group]
        own = np.exp(2.0 * theta[2 + group]) * data.walk[np.ix_(rows, rows)]
        factor = np.linalg.cholesky(own + np.diag(np.exp(2.0 * theta[group]) * ratio**2))
        white = np.linalg.solve(factor, np.column_stack([residual[rows, axis], np.ones(len(rows))]))
        left = white[:, 0] - white[:, 1] * (white[:, 1] @ white[:, 0]) / (white[:, 1] @ white[:, 1])
        together, alone = together + float(left[1:] @ left[:-1]), alone + float(left @ left)
    follows = min(max(together / alone, 0.0), _MOST_SMOOTH)
    return (1.0 - follows) / (1.0 + follows)
