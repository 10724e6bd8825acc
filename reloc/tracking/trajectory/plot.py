"""A trajectory as a picture: from above, and each axis of position and orientation over time."""

import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from reloc.tracking.trajectory.values import Trajectory

_AXES = (("east", "#c62828"), ("north", "#2e7d32"), ("up", "#1565c0"))
_LOST, _BOUND = "#f3d6d6", 1.96
_DPI = 110


def plot_png(trajectory: Trajectory) -> bytes:
    """The way from above; beside it what each axis is uncertain by.

    Lost stretches are shaded. Positions are metres in the zone of the first pose, about its place.

    Raises:
        InvalidValueError: no frame has a pose, or poses are of several zones.
    """
    times = np.array([p.time_s for p in trajectory.points])
    places, bounds = _poses(trajectory)
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.3))
    plan = figure.add_subplot(grid[:, 0])
    plan.plot(places[:, 0], places[:, 1], lw=1.2, color="#1b2733")
    first, last = places[np.isfinite(places[:, 0])][[0, -1]]
    plan.plot(*first[:2], "o", color="#2e7d32", label="first pose")
    plan.plot(*last[:2], "s", color="#c62828", label="last pose")
    plan.set(xlabel="easting, m", ylabel="northing, m", title=trajectory.source, aspect="equal")
    plan.margins(0.08)
    plan.legend(loc="best", fontsize=8)
    lost = np.isnan(places[:, 0])
    for row, (part, unit, factor) in enumerate(
        ((slice(3, 6), "m", 1.0), (slice(0, 3), "degrees", 180.0 / np.pi))
    ):
        axes = figure.add_subplot(grid[row, 1])
        _draw_axes(axes, times, factor * bounds[:, part], lost)
        what = "position" if row == 0 else "rotation about"
        axes.set(ylabel=f"{what}, {unit}", xlabel="time, s")
        axes.set_title("95 % bounds", fontsize=9)
        axes.legend(loc="upper right", fontsize=8, ncols=3)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=_DPI, metadata={"Software": "featuredb"})
    return out.getvalue()


def _poses(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) about the first, and 95 % bounds (n, 6); NaN where the track is lost."""
    found = [p.pose for p in trajectory.points if p.pose is not None]
    zones = sorted({pose.epsg for pose in found})
    if len(zones) != 1:
        raise InvalidValueError(
            f"{trajectory.source}: expected poses in one UTM zone to draw, found "
            f"{'none' if not zones else ' and '.join(f'EPSG:{z}' for z in zones)}; write CSV"
        )
    places = np.full((len(trajectory.points), 3), np.nan)
    bounds = np.full((len(trajectory.points), 6), np.nan)
    for row, point in enumerate(trajectory.points):
        if point.pose is not None:
            places[row] = point.pose.utm - found[0].utm
            bounds[row] = _BOUND * np.sqrt(np.diag(point.pose.covariance))
    return places, bounds


def _draw_axes(axes: Any, times: FloatArray, bounds: FloatArray, lost: NDArray[np.bool_]) -> None:
    for k, (name, colour) in enumerate(_AXES):
        axes.plot(times, bounds[:, k], lw=1.0, color=colour, label=name)
    # A lost frame is shaded as long as it lasts.
    edges = np.concatenate([times, [2.0 * times[-1] - times[-2] if len(times) > 1 else times[-1] + 1.0]])
    for row in np.flatnonzero(lost):
        axes.axvspan(edges[row], edges[row + 1], color=_LOST, lw=0)
    axes.margins(x=0.0)
    axes.grid(alpha=0.3)
