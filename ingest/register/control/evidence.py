"""What a placement by control points leaves behind: the evidence in the map, and a table for people."""

from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from ingest.register.control.marks import Control
from ingest.register.control.placement import GcpPlacement


def gcp_evidence(placement: GcpPlacement, control: Control) -> dict[str, Any]:
    """Figures, residuals of every point and mark, and notes; JSON-able."""
    return {
        **placement.figures,
        "notes": list(placement.notes),
        "points": [
            {
                "name": p.name,
                "residual_enu_m": _numbers(p.residual_m),
                "leave_one_out_enu_m": _numbers(p.leave_one_out_m),
                "marks": p.marks,
                "used": p.used,
                "remark": p.remark,
            }
            for p in placement.points
        ],
        "marks": [
            {
                "point": m.mark.point,
                "photo": m.mark.photo,
                "line": m.mark.line,
                "residual_px": _numbers(m.residual_px),
                "used": m.used,
                "remark": m.remark,
            }
            for m in placement.marks
        ],
        "unused_marks": [f"line {mark.line}: {reason}" for mark, reason in control.unused],
        "unmarked_points": list(control.unmarked),
    }


def residual_table(placement: GcpPlacement, control: Control) -> str:
    """Residuals of every point, what is odd, and what was assumed, as lines of text."""
    lines = [
        "control point        marks  east m  north m    up m  horizontal m  without it m",
        "-------------------  -----  ------  -------  ------  ------------  ------------",
    ]
    for p in placement.points:
        alone = float(np.hypot(*p.leave_one_out_m[:2]))
        lines.append(
            f"{p.name[:19]:19s}  {f'{p.marks}/{p.marks_given}':>5s}  {_cell(p.residual_m[0], 6)}  "
            f"{_cell(p.residual_m[1], 7)}  {_cell(p.residual_m[2], 6)}  {_cell(p.horizontal_m, 12)}  "
            f"{_cell(alone, 12)}{'' if p.used else '  not used'}"
        )
    used = [p.horizontal_m for p in placement.points if p.used]
    if used:
        marks = [m.error_px for m in placement.marks if m.used]
        lines.append(
            f"{len(used)} of {len(placement.points)} points used: median horizontal residual "
            f"{np.median(used):.3f} m; {len(marks)} of {len(placement.marks)} marks, median "
            f"{np.median(marks):.2f} px"
        )
    return "\n".join([*lines, *remarks(placement, control)]) + "\n"


def remarks(placement: GcpPlacement, control: Control) -> list[str]:
    """What is odd about points and marks, what could not be used, and what was assumed."""
    return [
        *(p.remark for p in placement.points if p.remark),
        *(m.remark for m in placement.marks if m.remark),
        *(
            f"mark of {mark.point} in {mark.photo} (line {mark.line}) is not used: {reason}"
            for mark, reason in control.unused
        ),
        *(f"{name} has no mark in the map's photos" for name in control.unmarked),
        *(f"note: {note}" for note in placement.notes),
    ]


def _numbers(values: FloatArray) -> list[float | None]:
    return [round(float(v), 4) if np.isfinite(v) else None for v in values]


def _cell(value: float, width: int) -> str:
    return f"{value:{width}.3f}" if np.isfinite(value) else "-".rjust(width)
