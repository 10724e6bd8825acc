"""How far the photos' own GPS is from where control points put them, and whether that is more than noise.

What all photos share does not average out: a datum of the heights, a base station at wrong coordinates. The
offset is compared with what the positions claim, all of which may be shared, with the scatter of the single
differences, and with the covariance of the placement. It is told where chance gives as much in one case of a
thousand, of the heights and of the horizontal place each.
"""

from typing import Any

import numpy as np
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian

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
    if flat @ np.linalg.solve(spread[:2, :2], flat) > chi2.isf(_TOLD, 2):
        notes.append(
            f"the photos' GPS is {np.linalg.norm(flat):.2f} m from where the control points put them "
            f"({flat[0]:+.2f} east, {flat[1]:+.2f} north; {np.sqrt(np.trace(spread[:2, :2])):.2f} m are "
            "noise): another reference system, or a base station at wrong coordinates; the points count"
        )
    if up**2 / spread[2, 2] > chi2.isf(_TOLD, 1):
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
