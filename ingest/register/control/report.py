"""What a placement by control points leaves: lines of text, a page, a plan picture of residual vectors."""

from decimal import Decimal
from html import escape
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from featuredb.cli.common import format_table
from ingest.html_parts import note, page, picture, table
from ingest.plot_parts import png_bytes, residual_exaggeration
from ingest.register.control.placement import GcpPlacement
from ingest.workspace import atomic_file, write_json

_INK, _USED, _BAD, _FAINT = "#1b2733", "#1565c0", "#c62828", "#b8c2cc"
_HEADER = ("control point", "marks", "east m", "north m", "up m", "horizontal m", "without it m", "")
_MAX_POINTS = 20_000  # more only hide each other


def control_png(placement: GcpPlacement) -> bytes:
    """Plan of the map's points, the cameras and the control points with their residual vectors."""
    assert placement.block is not None
    points, cameras = placement.block.xyz, placement.block.centers()
    places = np.array([p.found_m for p in placement.points])
    residuals = np.array([p.residual_m for p in placement.points])
    low, high = np.percentile(points[:, :2], (1, 99), axis=0)
    corners = np.vstack([low, high, cameras[:, :2], places[np.isfinite(places).all(axis=1), :2]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    extent = float((high - low).max())
    used = np.array([p.used for p in placement.points])
    factor = residual_exaggeration(residuals[used, :2], extent)
    figure = Figure(figsize=(8.2, 8.2 * float((high - low)[1]) / float((high - low)[0]) + 0.9), dpi=110)
    axes = figure.add_subplot()
    shown = points[:: max(1, len(points) // _MAX_POINTS)]
    axes.plot(*shown[:, :2].T, ".", color=_FAINT, ms=1.0, label="map points")
    axes.plot(*cameras[:, :2].T, "^", mfc="white", mec=_INK, ms=6, label="cameras")
    colours = np.where(used, _USED, _BAD).tolist()
    arrows = factor * residuals[:, :2]
    axes.quiver(
        *places[:, :2].T, *arrows.T, color=colours, angles="xy", scale_units="xy", scale=1, width=3e-3
    )
    axes.scatter(places[:, 0], places[:, 1], c=colours, s=25)
    for p, colour in zip(placement.points, colours, strict=True):
        if np.isfinite(p.found_m).all():
            axes.annotate(
                f"{p.name} {p.horizontal_m:.2f} m",
                (float(p.found_m[0]), float(p.found_m[1])),
                xytext=(6, -10),
                textcoords="offset points",
                fontsize=8,
                color=colour,
                bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.75},
            )
    margin = 0.06 * extent
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m", fontsize=8)
    axes.set_ylabel("north, m", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(loc="upper right", fontsize=8)
    axes.set_title(
        f"Control points: surveyed minus found, drawn {factor} times as long (red: not used)",
        fontsize=9,
        loc="left",
    )
    return png_bytes(figure)


def control_html(placement: GcpPlacement) -> str:
    """Picture, remarks, residuals of points and marks; a part of a page."""
    parts = ["<h3>Control points</h3>"]
    if placement.block is not None and placement.points:
        parts.append(picture(control_png(placement), "Control points and their residuals"))
    parts += [note(remark) for remark in remarks(placement)]
    points = [["" if cell is None else str(cell) for cell in row] for row in _rows(placement)]
    parts.append(table(_HEADER, points, numbers=(2, 3, 4, 5, 6), names=(0,)))
    marks = [
        (m.mark.point, m.mark.photo, str(m.mark.line), *(f"{v:.3f}" for v in m.residual_px), _word(m.used))
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
            _word(p.used),
        )
        for p in placement.points
    ]


def _word(used: bool) -> str:
    return "" if used else "not used"


def write_control_report(folder: Path, title: str, placement: GcpPlacement) -> None:
    """control.json, control.html and control.png into a folder."""
    write_json(folder / "control.json", placement.evidence)
    verdict = "accepted" if placement.accepted else f"{placement.reason}: {placement.message}"
    body = [f"<h1>{escape(title)}</h1>", note(verdict), control_html(placement)]
    with atomic_file(folder / "control.html") as temporary:
        temporary.write_text(page(title, body), encoding="utf-8")
    if placement.block is not None and placement.points:
        with atomic_file(folder / "control.png") as temporary:
            temporary.write_bytes(control_png(placement))


def _decimal(value: float) -> Decimal | None:
    """To the millimetre; None for NaN."""
    return Decimal(f"{value:.3f}") if np.isfinite(value) else None
