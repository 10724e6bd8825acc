"""Residuals of a placement by control points, for people: per point and per mark, with the odd ones named."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from ingest.register.control.adjust import Adjusted
from ingest.register.control.control_file import Mark
from ingest.register.control.marks import Control
from ingest.register.control.rays import mark_residuals, shown
from ingest.register.control.snooping import left_out

_SAME_TARGET_PX = 10.0  # a mark that near to where another point shows is that point's target


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

    @property
    def horizontal_m(self) -> float:
        """Length of the horizontal residual."""
        return float(np.hypot(*self.residual_m[:2]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkResidual:
    """One mark.

    Attributes:
        residual_px: (2,) mark minus where the adjusted block shows the point.
        used: took part.
        remark: what is odd about it, "" for nothing.
    """

    mark: Mark
    residual_px: FloatArray
    used: bool
    remark: str

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
