"""Residuals of a placement by control points, for people: per point and per mark, with the odd ones named."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from ingest.register.control.adjust import Adjusted
from ingest.register.control.control_file import Mark
from ingest.register.control.marks import Control, mark_residuals, shown
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
#
# What all photos share does not average out: a datum of the heights, a base station at wrong coordinates.
# The offset is compared with what the positions claim, all of which may be shared, with the scatter of the
# single differences, and with the covariance of the placement. It is told where chance gives as much in one
# case of a thousand, of the heights and of the horizontal place each.

_TOLD = 0.001  # share of right positions of which an offset is told
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
    at = point_jacobian(centers[known].mean(axis=0))
    stated = np.array([sigma_m[0], sigma_m[0], sigma_m[1]])
    spread = at @ covariance @ at.T + np.diag(stated**2 + variance)
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
            f"control points ({np.sqrt(spread[2, 2]):.2f} m are noise): they count from different datums, or "
            "one is wrong; the control points count"
        )
    return figures, notes


def _middle(off: FloatArray) -> tuple[float, float]:
    """Median of differences (k,) and its variance; NaN and 0 without any."""
    known = off[np.isfinite(off)]
    if not len(known):
        return float("nan"), 0.0
    median = np.median(known)
    scatter = _SIGMA_PER_MAD * np.median(np.abs(known - median))
    return float(median), float(_MEDIAN * scatter**2 / len(known))
