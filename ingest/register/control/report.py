"""The page of a placement by control points: a plan picture of residual vectors, and tables."""

from html import escape
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from featuredb.geometry.arrays import FloatArray
from ingest.html_parts import note, page, picture, table
from ingest.plot_parts import png_bytes, residual_exaggeration
from ingest.register.control.maps import remarks
from ingest.register.control.marks import Control
from ingest.register.control.placement import GcpPlacement
from ingest.workspace import atomic_file, write_json

_INK, _USED, _BAD, _FAINT = "#1b2733", "#1565c0", "#c62828", "#b8c2cc"
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
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shown = points[:: max(1, len(points) // _MAX_POINTS)]
    axes.plot(*shown[:, :2].T, ".", color=_FAINT, ms=1.0, label="map points")
    axes.plot(*cameras[:, :2].T, "^", mfc="white", mec=_INK, ms=6, label="cameras")
    for p in placement.points:
        if not np.isfinite(p.found_m).all():
            continue
        colour = _USED if p.used else _BAD
        x, y = (float(v) for v in p.found_m[:2])
        east, north = (factor * float(v) for v in p.residual_m[:2])
        axes.annotate(
            "",
            xy=(x + east, y + north),
            xytext=(x, y),
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6},
        )
        axes.plot(x, y, "o", color=colour, ms=5)
        axes.annotate(
            f"{p.name} {p.horizontal_m:.2f} m",
            (x, y),
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


def control_html(placement: GcpPlacement, control: Control) -> str:
    """Picture, remarks, residuals of points and marks; a part of a page."""
    parts = ["<h3>Control points</h3>"]
    if placement.block is not None and placement.points:
        parts.append(picture(control_png(placement), "Control points and their residuals"))
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
    """control.json, control.html and control.png into a folder."""
    write_json(folder / "control.json", evidence)
    verdict = "accepted" if placement.accepted else f"{placement.reason}: {placement.message}"
    body = [f"<h1>{escape(title)}</h1>", note(verdict), control_html(placement, control)]
    with atomic_file(folder / "control.html") as temporary:
        temporary.write_text(page(title, body), encoding="utf-8")
    if placement.block is not None and placement.points:
        with atomic_file(folder / "control.png") as temporary:
            temporary.write_bytes(control_png(placement))


def _cells(values: FloatArray) -> list[str]:
    return [f"{v:.3f}" if np.isfinite(v) else "-" for v in values]
