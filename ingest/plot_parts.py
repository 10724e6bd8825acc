"""What the pictures of reports share: a figure as PNG, and the plan of a map with what placed it."""

import io
import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 110
_MAX_POINTS = 40_000  # more only hide each other and cost seconds
_MAX_NAMES = 40
_INK, _USED, _BAD = "#1b2733", "#1565c0", "#c62828"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanView:
    """A map from above with the residuals of what placed it, metres east, north, up.

    Attributes:
        title: of the picture. what: has residuals, for its legend.
        points: (n, 3) of the map. cameras: (k, 3) centres.
        places: (m, 3) where residuals begin; residuals: (m, 3). NaN where there is none.
        used: (m,) whether it took part. names: m names.
    """

    title: str
    what: str
    points: FloatArray
    cameras: FloatArray
    places: FloatArray
    residuals: FloatArray
    used: NDArray[np.bool_]
    names: tuple[str, ...]


def png_bytes(figure: "Figure") -> bytes:
    """A figure as PNG. Signs that the font has not are drawn as boxes, without a warning for each."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def plan_png(plan: PlanView) -> bytes:
    """Points coloured by height, cameras, and residuals, drawn longer so that they can be seen."""
    from matplotlib.figure import Figure  # takes a second to load

    low, high = _box(plan)
    width, height = high - low
    inches = 9.2, min(max(7.4 * height / width, 3.0), 9.0) + 1.0
    figure = Figure(figsize=inches, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.ticklabel_format(useOffset=False, style="plain")
    east, north, up = _sample(plan.points, low, high).T
    bottom, top = np.percentile(up, (1, 99)) if len(up) else (0.0, 1.0)
    heights = axes.scatter(east, north, c=up, vmin=bottom, vmax=top, s=3, lw=0)
    figure.colorbar(heights, label="height of points, m")
    axes.plot(*plan.cameras[:, :2].T, "^", mfc="white", mec=_INK, ms=7, mew=1.3, label="cameras")
    factor = residual_exaggeration(plan.residuals[plan.used, :2], float(max(width, height)))
    # What was not used is long enough as it is.
    tips = plan.places + np.where(plan.used, factor, 1)[:, None] * plan.residuals
    for used, colour in ((True, _USED), (False, _BAD)):
        rows = np.isfinite(tips[:, 0]) & (plan.used == used)
        if rows.any():
            more = f" (residuals drawn {factor} times longer)" if used else ", not used"
            (x0, y0), (x1, y1) = plan.places[rows, :2].T, tips[rows, :2].T
            axes.plot([x0, x1], [y0, y1], color=colour, lw=1.5)
            axes.plot(x1, y1, "x", color=colour, ms=6, mew=1.6, label=plan.what + more)
    if len(plan.names) <= _MAX_NAMES:
        style: dict[str, Any] = {"xytext": (7, 4), "textcoords": "offset points", "fontsize": 7}
        style["bbox"] = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.65}
        for name, place in zip(plan.names, plan.places, strict=True):
            if np.isfinite(place[:2]).all():
                axes.annotate(name, place[:2], color=_INK, **style)
    figure.legend(loc="outside upper right", ncols=3, fontsize=8, frameon=False)
    axes.set_title(plan.title, fontsize=9, color=_INK, loc="left")
    return png_bytes(figure)


def residual_exaggeration(residuals_m: FloatArray, extent_m: float) -> int:
    """Factor of 1, 2, 5, 10 ... by which residual vectors are drawn longer, so that they can be seen.

    Args:
        residuals_m: (k, 2) horizontal residuals, NaN rows where there are none.
        extent_m: longer side of the picture.
    """
    lengths = np.hypot(residuals_m[:, 0], residuals_m[:, 1])
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths) or lengths.max() <= 0:
        return 1
    # A typical vector takes 3 % of the picture, the longest not over 15 %.
    wanted = min(
        0.03 * extent_m / max(float(np.median(lengths)), 1e-9), 0.15 * extent_m / float(lengths.max())
    )
    steps = [m * 10**e for e in range(4) for m in (1, 2, 5)]
    return max((step for step in steps if step <= wanted), default=1)


def _box(plan: PlanView) -> tuple[FloatArray, FloatArray]:
    """Corners (2,) around cameras, places, used residuals and all but the outermost points, with a margin."""
    ends = np.concatenate([plan.places, (plan.places + plan.residuals)[plan.used]])[:, :2]
    corners = [plan.cameras[:, :2], ends[np.isfinite(ends).all(axis=1)]]
    if len(plan.points):
        corners.append(np.percentile(plan.points[:, :2], (1, 99), axis=0))
    xy = np.concatenate(corners)
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = max(0.06 * float((high - low).max()), 2.0)
    return low - margin, high + margin


def _sample(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The points within the box, at most so many, low ones first so that high ones lie on top."""
    chosen = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
    chosen = chosen[:: max(1, math.ceil(len(chosen) / _MAX_POINTS))]
    return np.asarray(chosen[np.argsort(chosen[:, 2])], dtype=np.float64)
