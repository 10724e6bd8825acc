"""Residuals of a placement by control points: tests that name what contradicts, and figures for people.

Baarda's data snooping with the variance estimated from the other residuals (Pope, The statistics of residuals
and the detection of outliers, 1976); one observation is left out at a time.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtrc

from featuredb.adjust.marginals import Whitened
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import place_covariance
from ingest.register.control.adjust import Adjusted, Task, Weights, adjust
from ingest.register.control.control_file import Mark
from ingest.register.control.fit import ControlFit
from ingest.register.control.marks import Control, mark_residuals, shown

_SETTLED = 0.01  # relative change of the sigma, whose own uncertainty is tens of per cent
_SIGNIFICANCE = 0.01  # chance of naming a good observation as wrong, over the whole file
# Chance above which a point that was left out comes back; well above the former, so that none goes back and
# forth.
_READMISSION = 0.05
_MIN_MARK_PX = 5.0  # marks nearer than that are not called wrong: people mark to one to three pixels
_MIN_POINT_M = 0.05  # the same for points; better surveys are rare
_START_MARK_PX = 1.0  # standard deviation of marks before they have been compared
# Below, agreement is luck.
_MIN_MARK_SIGMA_PX = 0.3
_MIN_CONTROL_SIGMA_M = 0.005
_MAX_ROUNDS = 12  # of adjusting and testing
_SAME_TARGET_PX = 10.0  # a mark that near to where another point shows is that point's target


def initial_weights(
    control: Control, fit: ControlFit, sigma_m: tuple[float, float] | None
) -> tuple[Weights, FloatArray]:
    """What takes part at first, and where the control points lie in the placed block."""
    count = len(control.names)
    points = np.zeros(count, dtype=bool)
    marks = np.zeros(len(control.marks), dtype=bool)
    xyz = np.zeros((count, 3))
    for hypothesis, inlier in zip(fit.chosen, fit.inliers, strict=True):
        xyz[hypothesis.point] = fit.local_from_block.act(hypothesis.xyz)
        points[hypothesis.point] = inlier
        marks[list(hypothesis.marks)] = True
    horizontal, vertical = sigma_m or (fit.sigma_m, fit.sigma_m)
    weights = Weights(
        mark_px=_START_MARK_PX,
        control_m=np.array([horizontal, horizontal, vertical]),
        marks=marks,
        points=points,
    )
    return weights, xyz


def improve(task: Task, weights: Weights, sigma_is_given: bool) -> tuple[Adjusted, float]:
    """Adjust, estimate the sigmas, leave out the worst contradiction, until there is none.

    The last adjustment, and degrees of freedom of the surveyed coordinates.
    """
    control = task.control
    for _ in range(_MAX_ROUNDS):
        adjusted = adjust(task, weights)
        control_m, freedom = _control_sigma(adjusted, control)
        tested = replace(
            _tested(adjusted, control, freedom),
            mark_px=_mark_sigma(adjusted),
            control_m=weights.control_m if sigma_is_given else control_m,
        )
        settled = np.allclose(tested.control_m, weights.control_m, rtol=_SETTLED)
        unchanged = (tested.marks == weights.marks).all() and (tested.points == weights.points).all()
        if settled and unchanged:
            break
        weights = tested
    return adjusted, freedom


def left_out(adjusted: Adjusted, control: Control, point: int) -> tuple[FloatArray, float]:
    """A point's known coordinates, had they taken no part: (d,) found minus surveyed in metres; and the
    chance of a contradiction as large."""
    used = np.isfinite(control.surveyed) & adjusted.weights.points[:, None]
    rows = np.flatnonzero(np.flatnonzero(used) // 3 == point)
    alone, chance = chance_of(adjusted.survey.of(used), rows)
    return adjusted.weights.control_m[used[point]] * alone, chance


def chance_of(residuals: Whitened, rows: NDArray[np.int64]) -> tuple[FloatArray, float]:
    """Some residuals, had their observations taken no part, and the chance of one as large.

    The variance is that of the others: an F test, exact for one variance of all (Pope).
    """
    alone, others = residuals.left_out(rows)
    freedom = float(np.trace(others.together))
    if freedom < 1.0:
        return alone, 1.0  # nothing is left to judge by
    variance = max(float((others.residual**2).sum()) / freedom, 1e-9)
    statistic = max(float(alone @ residuals.residual[rows, 0]), 0.0) / len(rows)
    return alone, float(fdtrc(len(rows), freedom, statistic / variance))


def _mark_sigma(adjusted: Adjusted) -> float:
    redundancy = float(np.trace(adjusted.marks.covariance, axis1=1, axis2=2).sum())
    factor = float((adjusted.marks.residual**2).sum()) / max(redundancy, 1.0)
    return float(max(adjusted.weights.mark_px * factor**0.5, _MIN_MARK_SIGMA_PX))


def _control_sigma(adjusted: Adjusted, control: Control) -> tuple[FloatArray, float]:
    """(3,) standard deviation of surveyed coordinates, and their degrees of freedom."""
    used = np.isfinite(control.surveyed) & adjusted.weights.points[:, None]
    shares = np.einsum("nii->ni", adjusted.survey.covariance)
    redundancy = np.where(used, np.clip(shares, 0.0, 1.0), 0.0)
    squared = np.where(used, (adjusted.weights.control_m * adjusted.survey.residual) ** 2, 0.0)

    def sigma(columns: slice) -> float:
        own = float(redundancy[:, columns].sum())
        # Few residuals of one kind say little about it: all kinds together then.
        chosen = columns if own >= 3.0 else slice(0, 3)
        total = max(float(redundancy[:, chosen].sum()), 1.0)
        return float(max((float(squared[:, chosen].sum()) / total) ** 0.5, _MIN_CONTROL_SIGMA_M))

    horizontal, vertical = sigma(slice(0, 2)), sigma(slice(2, 3))
    return np.array([horizontal, horizontal, vertical]), float(redundancy.sum())


def _tested(adjusted: Adjusted, control: Control, freedom: float) -> Weights:
    """The weights without the worst contradiction; marks and points that turn out to fit come back."""
    weights = adjusted.weights
    marks, points = weights.marks.copy(), weights.points.copy()
    errors = np.linalg.norm(mark_residuals(adjusted.block, control, adjusted.control_xyz), axis=1)
    marks |= errors <= _MIN_MARK_PX
    points |= _fitting(adjusted, control, freedom)
    if (marks != weights.marks).any() or (points != weights.points).any():
        return replace(weights, marks=marks, points=points)
    rows = np.flatnonzero(weights.marks)
    residuals = adjusted.marks.of(np.ones((len(rows), 2), dtype=bool))
    tests = [chance_of(residuals, 2 * k + np.arange(2)) for k in range(len(rows))]
    mark = _worst(rows, tests, _MIN_MARK_PX / weights.mark_px)
    if mark is not None:
        marks[mark] = False
        point = int(control.point_of[mark])
        points[point] &= marks[control.marks_of(point)].any()
        return replace(weights, marks=marks, points=points)
    rows = np.flatnonzero(weights.points)
    worst = _worst(rows, [left_out(adjusted, control, p) for p in rows.tolist()], _MIN_POINT_M)
    if worst is not None:
        points[worst] = False
    return replace(weights, points=points)


def _fitting(adjusted: Adjusted, control: Control, freedom: float) -> NDArray[np.bool_]:
    """(n,) points that took no part, and fit the others well."""
    weights = adjusted.weights
    fitting = np.zeros(len(control.names), dtype=bool)
    for point in np.flatnonzero(~weights.points & np.isfinite(adjusted.control_xyz[:, 0])):
        known = np.isfinite(control.surveyed[point])
        rest = (control.surveyed[point] - adjusted.control_xyz[point])[known]
        variance = np.diag(weights.control_m[known] ** 2) + adjusted.spread[point][np.ix_(known, known)]
        statistic, axes = float(rest @ np.linalg.solve(variance, rest)), int(known.sum())
        chance = float(fdtrc(axes, max(freedom, 1.0), statistic / axes))
        fitting[point] = chance > _READMISSION or np.linalg.norm(rest) <= _MIN_POINT_M
    return fitting


def _worst(rows: NDArray[np.int64], tests: list[tuple[FloatArray, float]], least: float) -> int | None:
    """The row of the least chance, where it is too small for so many tests, and the error no small one."""
    wrong = [
        (chance, row)
        for row, (alone, chance) in zip(rows.tolist(), tests, strict=True)
        if chance < _SIGNIFICANCE / len(rows) and float(np.linalg.norm(alone)) > least
    ]
    return min(wrong)[1] if wrong else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointResidual:
    """One control point.

    Attributes:
        found_m: (3,) local east, north, up where the adjusted block has it; NaN where nothing shows it.
        residual_m: (3,) surveyed minus found, NaN where unknown.
        leave_one_out_m: (3,) the same, had the point taken no part.
        marks: how many of its marks were used, of `marks_given`.
        used: took part as control.
        remark: what is odd about it, "" for nothing.
    """

    name: str
    found_m: FloatArray
    residual_m: FloatArray
    leave_one_out_m: FloatArray
    marks: int
    marks_given: int
    used: bool
    remark: str

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "residual_enu_m": self.residual_m.round(4),
            "leave_one_out_enu_m": self.leave_one_out_m.round(4),
            "marks": self.marks,
            "used": self.used,
            "remark": self.remark,
        }

    @property
    def horizontal_m(self) -> float:
        """Length of the horizontal residual."""
        return float(np.hypot(*self.residual_m[:2]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkResidual:
    """One mark: (2,) mark minus where the adjusted block shows the point, and the rest as of points."""

    mark: Mark
    residual_px: FloatArray
    used: bool
    remark: str

    def figures(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "point": self.mark.point,
            "photo": self.mark.photo,
            "line": self.mark.line,
            "residual_px": self.residual_px.round(4),
            "used": self.used,
            "remark": self.remark,
        }

    @property
    def error_px(self) -> float:
        return float(np.hypot(*self.residual_px))


def residuals_of(
    adjusted: Adjusted, control: Control
) -> tuple[tuple[PointResidual, ...], tuple[MarkResidual, ...]]:
    """All residuals, those of what was left out included."""
    points = tuple(_point(adjusted, control, p) for p in range(len(control.names)))
    residuals = mark_residuals(adjusted.block, control, adjusted.control_xyz)
    return points, tuple(_mark(adjusted, control, row, residuals[row]) for row in range(len(control.marks)))


def _point(adjusted: Adjusted, control: Control, point: int) -> PointResidual:
    weights = adjusted.weights
    rows = control.marks_of(point)
    used = bool(weights.points[point])
    found = adjusted.control_xyz[point]
    residual = control.surveyed[point] - found
    single = np.array(residual)
    remark = ""
    if used:
        known = np.isfinite(control.surveyed[point])
        single = np.full(3, np.nan)
        single[known] = -left_out(adjusted, control, point)[0]
    elif np.isfinite(found).all():
        remark = (
            f"{control.names[point]} is {np.hypot(*residual[:2]):.2f} m off: probably wrong coordinates, or "
            f"another target marked in {'all its photos' if len(rows) > 1 else 'its photo'}; not used"
        )
    else:
        remark = f"{control.names[point]} cannot be located by its marks; not used"
    return PointResidual(
        name=control.names[point],
        found_m=found,
        residual_m=residual,
        leave_one_out_m=single,
        marks=int(weights.marks[rows].sum()),
        marks_given=len(rows),
        used=used,
        remark=remark,
    )


def _mark(adjusted: Adjusted, control: Control, row: int, residual: FloatArray) -> MarkResidual:
    mark, used = control.marks[row], bool(adjusted.weights.marks[row])
    remark = ""
    if not used and np.isfinite(adjusted.control_xyz[control.point_of[row]]).all():
        remark = (
            f"mark of {mark.point} in {mark.photo} (line {mark.line}) is {np.hypot(*residual):.0f} px off: "
            + _likely(adjusted, control, row)
        )
    return MarkResidual(mark=mark, residual_px=residual, used=used, remark=remark)


def _likely(adjusted: Adjusted, control: Control, row: int) -> str:
    """What a wrong mark may be."""
    photo = np.full(len(control.names), control.photo_of[row])
    away = shown(adjusted.block, photo, adjusted.control_xyz) - control.xy[row]
    distance = np.nan_to_num(np.linalg.norm(away, axis=1), nan=np.inf)
    distance[control.point_of[row]] = np.inf
    other = int(np.argmin(distance))
    if distance[other] <= _SAME_TARGET_PX:
        return f"it lies on {control.names[other]}"
    return "probably the wrong target"


# How far the photos' own GPS is from where control points put them, and whether that is more than noise.

_TOLD = 0.001  # share of right positions of which an offset is told
_GEOID_M = 110.0  # no height datum is further from another
_MEDIAN = np.pi / 2.0  # variance of a median over that of a mean, normal distribution
_SIGMA_PER_MAD = 1.4826


def gps_offset(
    gps_local: FloatArray, sigma_m: tuple[float, float], centers: FloatArray, covariance: FloatArray
) -> tuple[dict[str, Any], list[str]]:
    """Figures of the offset, and what is to be told of it.

    Args:
        gps_local: (k, 3) positions by GPS in the local frame, NaN where not known.
        sigma_m: stated by them, horizontal and vertical.
        centers: (k, 3) of the placed photos.
        covariance: (7, 7) of the placement.
    """
    off = gps_local - centers
    known = np.isfinite(off[:, 0])
    if not known.any():
        return {}, []
    median, variance = np.transpose([_middle(off[:, axis]) for axis in range(3)])
    stated = np.array([sigma_m[0], sigma_m[0], sigma_m[1]])
    spread = place_covariance(covariance, centers[known].mean(axis=0)) + np.diag(stated**2 + variance)
    figures = {
        "gps_offset_m": [None if np.isnan(v) else float(v) for v in median],
        "gps_offset_sigma_m": np.sqrt(np.diag(spread)).tolist(),
    }
    notes = []
    flat, up = median[:2], median[2]
    if flat @ np.linalg.solve(spread[:2, :2], flat) > chdtri(2, _TOLD):
        notes.append(
            f"the photos' GPS is {np.linalg.norm(flat):.2f} m from where the control points put them "
            f"({flat[0]:+.2f} east, {flat[1]:+.2f} north; {np.sqrt(np.trace(spread[:2, :2])):.2f} m are "
            "noise): another reference system, or a base station at wrong coordinates; the points count"
        )
    if up**2 / spread[2, 2] > chdtri(1, _TOLD):
        notes.append(
            f"the photos' GPS heights are {abs(up):.2f} m {'above' if up > 0 else 'below'} those of the "
            f"control points ({np.sqrt(spread[2, 2]):.2f} m are noise): {_why(abs(up))}; "
            "the control points count"
        )
    return figures, notes


def _why(apart_m: float) -> str:
    """What heights so far apart may mean."""
    if apart_m < _GEOID_M:
        return "they count from different datums, or one is wrong"
    return (
        "no datum explains that: the survey's heights may be in another unit (feet), or the photos' count "
        "from the take-off"
    )


def _middle(off: FloatArray) -> tuple[float, float]:
    """Median of differences (k,) and its variance; NaN and 0 without any."""
    known = off[np.isfinite(off)]
    if not len(known):
        return float("nan"), 0.0
    median = np.median(known)
    scatter = _SIGMA_PER_MAD * np.median(np.abs(known - median))
    return float(median), float(_MEDIAN * scatter**2 / len(known))
