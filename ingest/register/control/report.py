"""What a placement by control points leaves: lines of text, and a page with a plan of residual vectors."""

from decimal import Decimal
from html import escape
from pathlib import Path

import numpy as np

from featuredb.cli.common import format_table
from ingest.html_parts import note, page, picture, table
from ingest.plot_parts import PlanView, plan_png
from ingest.register.control.placement import GcpPlacement
from ingest.workspace import write_json_and_page

_HEADER = ("control point", "marks", "east m", "north m", "up m", "horizontal m", "without it m", "")


def control_html(placement: GcpPlacement) -> str:
    """Picture, remarks, residuals of points and marks; a part of a page."""
    parts = ["<h3>Control points</h3>"]
    if placement.block is not None and placement.points:
        plan = PlanView(
            title="Control points: surveyed minus found",
            what="control points",
            points=placement.block.xyz,
            cameras=placement.block.centers(),
            places=np.array([p.found_m for p in placement.points]),
            residuals=np.array([p.residual_m for p in placement.points]),
            used=np.array([p.used for p in placement.points]),
            names=tuple(f"{p.name} {p.horizontal_m:.2f} m" for p in placement.points),
        )
        parts.append(picture(plan_png(plan), "Control points and their residuals"))
    parts += [note(remark) for remark in remarks(placement)]
    points = [["" if cell is None else str(cell) for cell in row] for row in _rows(placement)]
    parts.append(table(_HEADER, points, numbers=(2, 3, 4, 5, 6), names=(0,)))
    marks = [
        (
            *(m.mark.point, m.mark.photo, str(m.mark.line)),
            *(f"{v:.3f}" if np.isfinite(v) else "" for v in m.residual_px),
            "" if m.used else "not used",
        )
        for m in placement.marks
    ]
    mark_head = ("point", "photo", "line", "x, px", "y, px", "")
    marks_table = table(mark_head, marks, numbers=(2, 3, 4), names=(0, 1))
    parts.append(f"<details><summary>Marks</summary>{marks_table}</details>")
    return "\n".join(parts)


def residual_table(placement: GcpPlacement) -> str:
    """Residuals of every point, what is odd, and what was assumed, as lines of text."""
    lines = [format_table(_HEADER, _rows(placement)).rstrip("\n")]
    used = [p.horizontal_m for p in placement.points if p.used]
    if used:
        marks = [m.error_px for m in placement.marks if m.used]
        lines.append(
            f"{len(used)} of {len(placement.points)} points used: median horizontal residual "
            f"{np.median(used):.3f} m; {len(marks)} of {len(placement.marks)} marks, median "
            f"{np.median(marks):.2f} px"
        )
    return "\n".join([*lines, *remarks(placement)]) + "\n"


def remarks(placement: GcpPlacement) -> list[str]:
    """What is odd about points and marks, what could not be used, and what was assumed."""
    return [
        *(p.remark for p in placement.points if p.remark),
        *(m.remark for m in placement.marks if m.remark),
        *(
            f"mark of {mark.point} in {mark.photo} (line {mark.line}) is not used: {reason}"
            for mark, reason in placement.control.unused
        ),
        *(f"{name} has no mark in the map's photos" for name in placement.control.unmarked),
        *(f"note: {note}" for note in placement.notes),
    ]


def _rows(placement: GcpPlacement) -> list[tuple[object, ...]]:
    """A row of `_HEADER` for each point."""
    return [
        (
            p.name,
            f"{p.marks}/{p.marks_given}",
            *map(_decimal, (*p.residual_m, p.horizontal_m, np.hypot(*p.leave_one_out_m[:2]))),
            "" if p.used else "not used",
        )
        for p in placement.points
    ]


def write_control_report(folder: Path, title: str, placement: GcpPlacement) -> None:
    """control.json and control.html into a folder."""
    verdict = "accepted" if placement.accepted else f"{placement.reason}: {placement.message}"
    body = [f"<h1>{escape(title)}</h1>", note(verdict), control_html(placement)]
    write_json_and_page(folder / "control", placement.evidence, page(title, body))


def _decimal(value: float) -> Decimal | None:
    """To the millimetre; None for NaN."""
    return Decimal(f"{value:.3f}") if np.isfinite(value) else None
