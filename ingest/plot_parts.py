"""What the pictures of reports share: a figure as PNG, exaggerated residuals."""

import io

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from featuredb.geometry.arrays import FloatArray


def png_bytes(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


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
