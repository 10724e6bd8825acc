"""The page of a placement by control points: a plan of residual vectors, and tables."""

from html import escape
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from ingest.html_parts import note, page, picture, table
from ingest.plot_parts import PlanView, plan_png
from ingest.register.control.maps import remarks
from ingest.register.control.marks import Control
from ingest.register.control.placement import GcpPlacement
from ingest.workspace import atomic_file, write_json


def control_plan(placement: GcpPlacement) -> PlanView | None:
    """The map, the cameras and the control points with their residuals; None where there are none."""
    if placement.block is None or not placement.points:
        return None
    return PlanView(
        title="Control points: surveyed minus found",
        what="control points",
        points=placement.block.xyz,
        cameras=placement.block.centers(),
        places=np.array([p.found_m for p in placement.points]),
        residuals=np.array([p.residual_m for p in placement.points]),
        used=np.array([p.used for p in placement.points]),
        names=tuple(f"{p.name} {p.horizontal_m:.2f} m" for p in placement.points),
    )


def control_html(placement: GcpPlacement, control: Control) -> str:
    """Picture, remarks, residuals of points and marks; a part of a page."""
    parts = ["<h3>Control points</h3>"]
    plan = control_plan(placement)
    if plan is not None:
        parts.append(picture(plan_png(plan), "Control points and their residuals"))
    parts += [note(remark) for remark in remarks(placement, control)]
    points = [
        (
            p.name,
            f"{p.marks} of {p.marks_given}",
            *_cells(p.residual_m),
            *_cells(p.leave_one_out_m),
            "" if p.used else "not used",
        )
        for p in placement.points
    ]
    head = ("point", "marks", "east, m", "north, m", "up, m", "without it: east", "north", "up", "")
    parts.append(table(head, points, numbers=(2, 3, 4, 5, 6, 7), names=(0,)))
    marks = [
        (
            m.mark.point,
            m.mark.photo,
            str(m.mark.line),
            *_cells(m.residual_px),
            "" if m.used else "not used",
        )
        for m in placement.marks
    ]
    mark_head = ("point", "photo", "line", "x, px", "y, px", "")
    marks_table = table(mark_head, marks, numbers=(2, 3, 4), names=(0, 1))
    parts.append(f"<details><summary>Marks</summary>{marks_table}</details>")
    return "\n".join(parts)


def write_control_report(
    folder: Path, title: str, placement: GcpPlacement, control: Control, evidence: dict[str, object]
) -> None:
    """control.json and control.html into a folder."""
    write_json(folder / "control.json", evidence)
    verdict = "accepted" if placement.accepted else f"{placement.reason}: {placement.message}"
    body = [f"<h1>{escape(title)}</h1>", note(verdict), control_html(placement, control)]
    with atomic_file(folder / "control.html") as temporary:
        temporary.write_text(page(title, body), encoding="utf-8")


def _cells(values: FloatArray) -> list[str]:
    return [f"{v:.3f}" if np.isfinite(v) else "-" for v in values]
