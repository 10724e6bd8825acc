"""Which marks and points contradict the others: tests on the residuals of an adjustment.

Baarda's data snooping with the variance estimated from the other residuals (Pope, The statistics of residuals
and the detection of outliers, 1976): a residual is judged against its own standard deviation, which is small
where nothing else controls it, and one observation is left out at a time.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from ingest.precision import Linearised, linearise
from ingest.register.control.adjust import Adjusted
from ingest.register.control.fit import ControlFit
from ingest.register.control.marks import Control
from ingest.register.control.normal_system import Weights
from ingest.register.control.rays import mark_errors

_LOG = logging.getLogger(__name__)
_SETTLED = 0.01  # relative change of the sigma, whose own uncertainty is tens of per cent


@dataclass(frozen=True, slots=True, kw_only=True)
class TestOptions:
    """Tests of marks and points.

    Attributes:
        significance: chance of naming a good observation as wrong, over the whole file.
        readmission: chance above which a point that was left out comes back; well above the former, so
            that none goes back and forth.
        min_mark_px: marks nearer than that are not called wrong: people mark to one to three pixels.
        min_point_m: the same for points; better surveys are rare.
        max_mark_px: marks within that take part from the start.
        start_mark_px: standard deviation of marks before they have been compared.
        min_mark_sigma_px, min_control_sigma_m: below, agreement is luck.
        ground_share: standard deviation of the ground's height under a single mark, over its distance.
        max_rounds: of adjusting and testing.
    """

    significance: float = 0.01
    readmission: float = 0.05
    min_mark_px: float = 5.0
    min_point_m: float = 0.05
    max_mark_px: float = 12.0
    start_mark_px: float = 1.0
    min_mark_sigma_px: float = 0.3
    min_control_sigma_m: float = 0.005
    ground_share: float = 0.01
    max_rounds: int = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """The last adjustment and what took part in it.

    Attributes:
        freedom: degrees of freedom of the surveyed coordinates.
        rounds: adjustments done.
    """

    adjusted: Adjusted
    weights: Weights
    freedom: float
    rounds: int


def initial_weights(
    placed: Block,
    control: Control,
    fit: ControlFit,
    sigma_m: tuple[float, float] | None,
    options: TestOptions,
) -> tuple[Weights, FloatArray]:
    """What takes part at first, and where the control points lie in the placed block."""
    count = len(control.names)
    points = np.zeros(count, dtype=bool)
    marks = np.zeros(len(control.marks), dtype=bool)
    xyz = np.zeros((count, 3))
    ground = np.full(count, np.inf)
    for hypothesis, inlier in zip(fit.chosen, fit.inliers, strict=True):
        point = control.point_of[hypothesis.marks[0]]
        rows = control.marks_of(int(point))
        xyz[point] = fit.local_from_block.act(hypothesis.xyz)
        near = (
            mark_errors(placed, control.photo_of[rows], control.xy[rows], xyz[point]) <= options.max_mark_px
        )
        near |= np.isin(rows, hypothesis.marks)
        points[point] = inlier
        marks[rows] = near
        if near.sum() == 1:
            center = placed.cam_from_block[int(control.photo_of[rows[near][0]])].center
            ground[point] = options.ground_share * float(np.linalg.norm(xyz[point] - center))
    horizontal, vertical = sigma_m or (fit.sigma_m, fit.sigma_m)
    weights = Weights(
        mark_px=options.start_mark_px,
        control_m=np.array([horizontal, horizontal, vertical]),
        marks=marks,
        points=points,
        ground_m=ground,
    )
    return weights, xyz


def improve(
    placed: Block,
    control: Control,
    xyz: FloatArray,
    weights: Weights,
    solve: Callable[[Block, FloatArray, Weights, Adjusted | None], Adjusted],
    sigma_is_given: bool,
    options: TestOptions,
) -> Outcome:
    """Adjust, estimate the sigmas, leave out the worst contradiction, until there is none."""
    adjusted = solve(placed, xyz, weights, None)
    rounds = 1
    while True:
        estimated, freedom = _estimated(adjusted, control, weights, sigma_is_given, options)
        tested = _tested(adjusted, control, estimated, freedom, options)
        settled = np.allclose(tested.control_m, weights.control_m, rtol=_SETTLED)
        unchanged = (tested.marks == weights.marks).all() and (tested.points == weights.points).all()
        if (settled and unchanged) or rounds >= options.max_rounds:
            return Outcome(adjusted=adjusted, weights=weights, freedom=freedom, rounds=rounds)
        weights = tested
        adjusted = solve(placed, xyz, weights, adjusted)
        rounds += 1
        _LOG.info("round %d: control sigma %s m", rounds, weights.control_m)


def mark_linear(adjusted: Adjusted, control: Control) -> Linearised:
    """Residuals and derivatives of all marks, used or not."""
    block = adjusted.block
    return linearise(
        block.cameras,
        block.camera_of,
        block.cam_from_block,
        adjusted.control_xyz,
        control.point_of,
        control.photo_of,
        control.xy,
    )


def _estimated(
    adjusted: Adjusted, control: Control, weights: Weights, sigma_is_given: bool, options: TestOptions
) -> tuple[Weights, float]:
    """Weights with the sigmas that the residuals show, and the freedom of the surveyed coordinates."""
    linear = mark_linear(adjusted, control)
    redundancy, squared = 0.0, 0.0
    for row in np.flatnonzero(weights.marks):
        spread = adjusted.mark_spread[row]
        redundancy += 2.0 - float(np.trace(spread)) / weights.mark_px**2
        squared += float((linear.residual[row] ** 2).sum())
    mark_px = max((squared / max(redundancy, 1.0)) ** 0.5, options.min_mark_sigma_px)
    control_m, freedom = _control_sigma(adjusted, control, weights, options)
    return (
        replace(weights, mark_px=mark_px, control_m=weights.control_m if sigma_is_given else control_m),
        freedom,
    )


def _control_sigma(
    adjusted: Adjusted, control: Control, weights: Weights, options: TestOptions
) -> tuple[FloatArray, float]:
    """(3,) standard deviation of surveyed coordinates, and their degrees of freedom."""
    rest = control.surveyed - adjusted.control_xyz
    used = np.isfinite(rest) & weights.points[:, None]
    spread = np.array([np.diag(adjusted.control_covariance(p)) for p in range(len(rest))])
    trust = adjusted.trust[:, None]
    redundancy = np.where(used, np.clip(1.0 - spread * trust / weights.control_m**2, 0.0, 1.0), 0.0)
    squared = np.where(used, trust * np.nan_to_num(rest) ** 2, 0.0)
    freedom = float(redundancy.sum())

    def sigma(columns: slice) -> float:
        own = float(redundancy[:, columns].sum())
        # Few residuals of one kind say little about it: all kinds together then.
        chosen = columns if own >= 3.0 else slice(0, 3)
        total = max(float(redundancy[:, chosen].sum()), 1.0)
        return float(max((float(squared[:, chosen].sum()) / total) ** 0.5, options.min_control_sigma_m))

    horizontal, vertical = sigma(slice(0, 2)), sigma(slice(2, 3))
    return np.array([horizontal, horizontal, vertical]), freedom


def _tested(
    adjusted: Adjusted, control: Control, weights: Weights, freedom: float, options: TestOptions
) -> Weights:
    """The weights without the worst contradiction; marks that turn out to fit come back."""
    linear = mark_linear(adjusted, control)
    errors = np.linalg.norm(linear.residual, axis=1)
    located = np.isin(np.arange(len(weights.points)), control.point_of[weights.marks])
    back = ~weights.marks & located[control.point_of] & (errors <= options.min_mark_px)
    points_back = located & ~weights.points & _fitting(adjusted, control, weights, freedom, options)
    if back.any() or points_back.any():
        return replace(weights, marks=weights.marks | back, points=weights.points | points_back)
    worst_mark = _worst_mark(adjusted, control, weights, linear, options)
    if worst_mark is not None:
        marks = weights.marks.copy()
        marks[worst_mark] = False
        points = weights.points.copy()
        point = control.point_of[worst_mark]
        points[point] &= marks[control.marks_of(int(point))].any()
        return replace(weights, marks=marks, points=points)
    worst_point = _worst_point(adjusted, control, weights, freedom, options)
    if worst_point is not None:
        points = weights.points.copy()
        points[worst_point] = False
        return replace(weights, points=points)
    return weights


def _fitting(
    adjusted: Adjusted, control: Control, weights: Weights, freedom: float, options: TestOptions
) -> NDArray[np.bool_]:
    """(n,) points that fit the others well, whether they took part or not."""
    fitting = np.zeros(len(control.names), dtype=bool)
    for point in range(len(control.names)):
        known = np.isfinite(control.surveyed[point])
        rest = (control.surveyed[point] - adjusted.control_xyz[point])[known]
        spread = adjusted.control_covariance(point)[np.ix_(known, known)]
        statistic = float(rest @ np.linalg.solve(np.diag(weights.control_m[known] ** 2) + spread, rest))
        axes = int(known.sum())
        chance = float(f_distribution.sf(statistic / axes, axes, max(freedom, 1.0)))
        fitting[point] = chance > options.readmission or np.linalg.norm(rest) <= options.min_point_m
    return fitting


def _worst_mark(
    adjusted: Adjusted, control: Control, weights: Weights, linear: Linearised, options: TestOptions
) -> int | None:
    rows = np.flatnonzero(weights.marks)
    tests: list[tuple[float, int]] = []
    total = 0.0
    statistics: dict[int, tuple[float, float]] = {}
    for row in rows.tolist():
        own = weights.mark_px**2 * np.eye(2) - adjusted.mark_spread[row]
        statistics[row] = _statistic(linear.residual[row], own)
        total += float((linear.residual[row] ** 2).sum()) / weights.mark_px**2
    for row, (statistic, predicted) in statistics.items():
        chance = _chance(statistic, 2, total, statistic)
        if chance < options.significance / len(rows) and predicted * weights.mark_px**2 > options.min_mark_px:
            tests.append((chance, row))
    return min(tests)[1] if tests else None


def _worst_point(
    adjusted: Adjusted, control: Control, weights: Weights, freedom: float, options: TestOptions
) -> int | None:
    rows = np.flatnonzero(weights.points)
    tests: list[tuple[float, int]] = []
    for point in rows:
        single = leave_one_out(adjusted, control, weights, int(point))
        statistic = float(single.residual @ np.linalg.solve(single.covariance, single.residual))
        axes = len(single.residual)
        chance = _chance(statistic, axes, freedom, single.drop)
        far = float(np.linalg.norm(single.residual)) > options.min_point_m
        if chance < options.significance / len(rows) and far:
            tests.append((chance, int(point)))
    return min(tests)[1] if tests else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOut:
    """A point's known coordinates, had they taken no part: residual, its covariance, and by how much the
    weighted sum of squares would be smaller."""

    residual: FloatArray
    covariance: FloatArray
    drop: float


def leave_one_out(adjusted: Adjusted, control: Control, weights: Weights, point: int) -> LeftOut:
    """Predict a point's coordinates from all other observations, by the adjustment's own linear algebra.

    With residual v, variance V and the adjusted point's covariance Q, the residual without the point's
    coordinates is V (V - Q)^-1 v, and the point's covariance then is Q (V - Q)^-1 V.
    """
    known = np.isfinite(control.surveyed[point])
    rest = (control.surveyed[point] - adjusted.control_xyz[point])[known]
    nominal = np.diag(weights.control_m[known] ** 2)
    variance = nominal / max(float(adjusted.trust[point]), 1e-12)
    spread = adjusted.control_covariance(point)[np.ix_(known, known)]
    inverse = np.linalg.pinv(variance - spread, rcond=1e-6, hermitian=True)
    alone = spread @ inverse @ variance
    return LeftOut(
        residual=variance @ inverse @ rest,
        covariance=nominal + (alone + alone.T) / 2,
        drop=float(rest @ inverse @ rest),
    )


def _statistic(residual: FloatArray, own: FloatArray) -> tuple[float, float]:
    """Squared residual over its covariance, and the length of covariance^-1 residual."""
    inverse = np.linalg.pinv(own, rcond=1e-6, hermitian=True)
    return float(residual @ inverse @ residual), float(np.linalg.norm(inverse @ residual))


def _chance(statistic: float, dimensions: int, freedom: float, drop: float) -> float:
    """Probability of a residual that large, the variance being estimated from the others.

    Args:
        statistic: squared residual over its covariance.
        drop: of the weighted sum of squares, were the observation left out.
    """
    rest = freedom - dimensions
    if rest < 1.0:
        return 1.0  # nothing is left to judge by
    others = max(freedom - drop, 1e-9)
    return float(f_distribution.sf(statistic / dimensions / (others / rest), dimensions, rest))
