"""Pictures of a report, as PNG bytes. Matplotlib by its object interface: no global state, no display."""

import math
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from ingest.plot_parts import png_bytes, residual_exaggeration
from ingest.report.values import PlanView

_DPI = 110
_MAX_POINTS = 40_000  # more only hide each other and cost seconds
_MAX_NAMES = 40
_INK, _GPS, _BAD, _FAINT = "#1b2733", "#1565c0", "#c62828", "#9aa7b4"


def plan_png(plan: PlanView) -> bytes:
    """Plan view (points by height, cameras, GPS with residual vectors) above a side view."""
    plan_box = _box(plan)
    width_m, height_m = plan_box[1] - plan_box[0], plan_box[3] - plan_box[2]
    side_low, side_high = _heights(plan)
    plan_inches = min(max(7.4 * height_m / width_m, 3.0), 9.0)
    side_inches = min(max(7.4 * (side_high - side_low) / width_m, 1.1), 3.0)
    total = plan_inches + side_inches + 1.5
    figure = Figure(figsize=(9.2, total), dpi=_DPI, facecolor="white")
    grid = figure.add_gridspec(
        2,
        2,
        height_ratios=(plan_inches, side_inches),
        width_ratios=(40, 1),
        left=0.105,
        right=0.925,
        top=1 - 0.55 / total,
        bottom=0.5 / total,
        hspace=0.45 / (total / 2),
        wspace=0.03,
    )
    top = figure.add_subplot(grid[0, 0])
    side = figure.add_subplot(grid[1, 0])
    bar = figure.add_subplot(grid[:, 1])
    shown = _sample(plan.points, plan_box)
    low, high = np.percentile(shown[:, 2], (1, 99)) if len(shown) else (0.0, 1.0)
    colours = Normalize(low, max(high, low + 0.1))
    _draw_plan(top, plan, shown, colours, plan_box)
    _draw_side(side, plan, shown, colours, plan_box, (side_low, side_high))
    figure.colorbar(ScalarMappable(colours, "viridis"), cax=bar, label="height of points, m")
    bar.tick_params(labelsize=8)
    return png_bytes(figure)


def _draw_plan(axes: Any, plan: PlanView, shown: FloatArray, colours: Normalize, box: NDArray[Any]) -> None:
    axes.set_xlim(box[0], box[1])
    axes.set_ylim(box[2], box[3])
    axes.set_aspect("equal", adjustable="box")
    axes.scatter(shown[:, 0], shown[:, 1], c=shown[:, 2], cmap="viridis", norm=colours, s=3, lw=0, zorder=2)
    residuals = (plan.gps - plan.cameras)[:, :2]
    factor = residual_exaggeration(residuals[plan.gps_used], float(max(box[1] - box[0], box[3] - box[2])))
    # Outliers are long enough as they are.
    tips = plan.cameras[:, :2] + np.where(plan.gps_used, factor, 1)[:, None] * residuals
    for used, colour, word in ((True, _GPS, "GPS"), (False, _BAD, "GPS, not used")):
        rows = np.isfinite(tips[:, 0]) & (plan.gps_used == used)
        if rows.any():
            times = f" (residuals drawn {factor} times longer)" if used and factor > 1 else ""
            x, y = plan.cameras[rows, :2].T, tips[rows].T
            axes.plot([x[0], y[0]], [x[1], y[1]], color=colour, lw=1.5, zorder=4)
            axes.plot(*y, "x", color=colour, ms=6, mew=1.6, zorder=5, label=word + times)
    axes.plot(*plan.cameras[:, :2].T, "^", mfc="white", mec=_INK, ms=7, mew=1.3, zorder=6, label="cameras")
    if len(plan.names) <= _MAX_NAMES:
        for name, camera in zip(plan.names, plan.cameras, strict=True):
            axes.annotate(
                name.rsplit("/", 1)[-1].rsplit(".", 1)[0],
                camera[:2],
                xytext=(7, 4),
                textcoords="offset points",
                fontsize=6.5,
                color=_INK,
                zorder=7,
                bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.65},
            )
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=3, fontsize=8, frameon=False, borderaxespad=0.1
    )
    axes.set_title(f"EPSG:{plan.epsg}", fontsize=9, color=_INK, loc="left", pad=22)
    axes.set_xlabel("easting, m", fontsize=8)
    axes.set_ylabel("northing, m", fontsize=8)
    _tidy(axes)


def _draw_side(
    axes: Any,
    plan: PlanView,
    shown: FloatArray,
    colours: Normalize,
    box: NDArray[Any],
    heights: tuple[float, float],
) -> None:
    """Height over easting, seen from the south."""
    axes.scatter(shown[:, 0], shown[:, 2], c=shown[:, 2], cmap="viridis", norm=colours, s=3, lw=0)
    for camera, gps, used in zip(plan.cameras, plan.gps, plan.gps_used, strict=True):
        if np.isfinite(gps[2]):
            colour = _GPS if used else _BAD
            axes.plot([camera[0], gps[0]], [camera[2], gps[2]], color=colour, lw=1.2)
            axes.plot(gps[0], gps[2], "x", color=colour, ms=5, mew=1.3)
    axes.plot(plan.cameras[:, 0], plan.cameras[:, 2], "^", mfc="white", mec=_INK, ms=6, mew=1.2)
    axes.set_xlim(box[0], box[1])
    axes.set_ylim(*heights)
    axes.set_xlabel("easting, m (seen from the south, residuals as they are)", fontsize=8)
    axes.set_ylabel("height, m", fontsize=8)
    _tidy(axes)


def _box(plan: PlanView) -> NDArray[Any]:
    """(e0, e1, n0, n1) around the cameras and all but the outermost points, with a margin."""
    corners = [plan.cameras[:, :2]]
    if len(plan.points):
        corners.append(np.percentile(plan.points[:, :2], (1, 99), axis=0))
    used = np.isfinite(plan.gps[:, 0]) & plan.gps_used
    corners.append(plan.gps[used, :2])
    xy = np.concatenate(corners)
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = max(0.06 * float((high - low).max()), 2.0)
    return np.array([low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin])


def _heights(plan: PlanView) -> tuple[float, float]:
    parts = [plan.cameras[:, 2], plan.gps[np.isfinite(plan.gps[:, 2]) & plan.gps_used, 2]]
    if len(plan.points):
        parts.append(np.percentile(plan.points[:, 2], (1, 99)))
    heights = np.concatenate(parts)
    margin = max(0.08 * float(np.ptp(heights)), 1.0)
    return float(heights.min() - margin), float(heights.max() + margin)


def _sample(points: FloatArray, box: NDArray[Any]) -> FloatArray:
    """The points within the box, at most so many, low ones first so that high ones lie on top."""
    inside = (
        (points[:, 0] >= box[0])
        & (points[:, 0] <= box[1])
        & (points[:, 1] >= box[2])
        & (points[:, 1] <= box[3])
    )
    chosen = points[inside]
    chosen = chosen[:: max(1, math.ceil(len(chosen) / _MAX_POINTS))]
    return np.asarray(chosen[np.argsort(chosen[:, 2])], dtype=np.float64)


def _tidy(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, colors=_INK)
    axes.xaxis.label.set_size(8)
    axes.yaxis.label.set_size(8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_major_formatter().set_useOffset(False)
        axis.get_major_formatter().set_scientific(False)
