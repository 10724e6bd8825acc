"""Residuals of a placement by control points, for people: per point and per mark, with the odd ones named."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from ingest.register.control.adjust import Adjusted
from ingest.register.control.control_file import Mark
from ingest.register.control.marks import Control
from ingest.register.control.snooping import Outcome, leave_one_out, mark_linear

_SAME_TARGET_PX = 10.0  # a mark that near to where another point shows is that point's target


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointResidual:
    """One control point.

    Attributes:
        surveyed_m: (3,) local east, north, up; up NaN where unknown.
        found_m: (3,) where the adjusted block has it; NaN where nothing shows it.
        residual_m: (3,) surveyed minus found, NaN where unknown.
        leave_one_out_m: (3,) the same, had the point taken no part.
        marks: how many of its marks were used, of `marks_given`.
        used: took part as control.
        remark: what is odd about it, "" for nothing.
    """

    name: str
    surveyed_m: FloatArray
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
    adjusted: Adjusted, control: Control, outcome: Outcome
) -> tuple[tuple[PointResidual, ...], tuple[MarkResidual, ...]]:
    """All residuals, those of what was left out included."""
    points = tuple(_point(adjusted, control, outcome, p) for p in range(len(control.names)))
    linear = mark_linear(adjusted, control)
    places = np.array([p.found_m for p in points])
    marks = tuple(
        _mark(
            adjusted,
            control,
            row,
            linear.residual[row],
            bool(outcome.weights.marks[row]),
            places,
        )
        for row in range(len(control.marks))
    )
    return points, marks


def _point(adjusted: Adjusted, control: Control, outcome: Outcome, point: int) -> PointResidual:
    weights = outcome.weights
    rows = control.marks_of(point)
    used = bool(weights.points[point])
    located = bool(weights.marks[rows].any())
    found = adjusted.control_xyz[point] if located else np.full(3, np.nan)
    residual = control.surveyed[point] - found
    single = np.array(residual)
    remark = ""
    if used:
        known = np.isfinite(control.surveyed[point])
        single = np.full(3, np.nan)
        single[known] = leave_one_out(adjusted, control, weights, point).residual
    elif np.isfinite(found).all():
        remark = (
            f"{control.names[point]} is {np.hypot(*residual[:2]):.2f} m off: probably wrong coordinates, or "
            f"another target marked in {'all its photos' if len(rows) > 1 else 'its photo'}; not used"
        )
    else:
        remark = f"{control.names[point]} cannot be located by its marks; not used"
    return PointResidual(
        name=control.names[point],
        surveyed_m=control.surveyed[point],
        found_m=found,
        residual_m=residual,
        leave_one_out_m=single,
        marks=int(weights.marks[rows].sum()),
        marks_given=len(rows),
        used=used,
        remark=remark,
    )


def _mark(
    adjusted: Adjusted,
    control: Control,
    row: int,
    residual: FloatArray,
    used: bool,
    places: FloatArray,
) -> MarkResidual:
    mark, photo, point = control.marks[row], int(control.photo_of[row]), int(control.point_of[row])
    pose, camera = adjusted.block.cam_from_block[photo], adjusted.block.camera(photo)
    shown = np.full((len(places), 2), np.nan)
    in_front = np.isfinite(places).all(axis=1)
    shown[in_front] = camera.project(pose.act(places[in_front]))
    remark = ""
    if not used and np.isfinite(places[point]).all():
        remark = (
            f"mark of {mark.point} in {mark.photo} (line {mark.line}) is {np.hypot(*residual):.0f} px off: "
            + _likely(control, row, shown)
        )
    return MarkResidual(
        mark=mark,
        residual_px=residual if np.isfinite(places[point]).all() else np.full(2, np.nan),
        used=used,
        remark=remark,
    )


def _likely(control: Control, row: int, shown: FloatArray) -> str:
    """What a wrong mark may be."""
    distance = np.linalg.norm(shown - control.xy[row], axis=1)
    distance[control.point_of[row]] = np.inf
    other = int(np.nanargmin(np.where(np.isfinite(distance), distance, np.inf)))
    if distance[other] <= _SAME_TARGET_PX:
        return f"it lies on {control.names[other]}"
    return "probably the wrong target"
