"""Which of two unnamed coordinates is the latitude? Older DJI subtitles write GPS(a,b,c) in either order.

A swapped pair is a wrong place that looks right, so the order is decided once per dialect of a file, by
evidence, and the evidence is told. In this order:

1. Magnitude. A value beyond 90 degrees is a longitude, in the fixes or in the place of take-off.
2. Distance. Phantom 4 RTK and its like write the distance from take-off (D 698.70m) beside both places;
   only one order reproduces it.
3. Spelling. `GPS(36.6146,-6.1120,0.0M)`, with the unit M, is latitude first: Matrice 300 (two more recordings
   of that dialect, from New Zealand and California, show it by magnitude: (-41.3899,174.0177,0.0M) and
   (37.8757,-122.3061,0.0M)). A whole third number counts satellites and comes after longitude, latitude:
   Mavic Pro, Mini, Phantom 4 (five of the eight recordings in the test data show it by 1 or 2).

What 1 and 2 say stands against 3. If they contradict each other or nothing decides, the file is refused.
"""

from typing import Literal, NamedTuple

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import METRES_PER_DEGREE

AxisOrder = Literal["lat_lon", "lon_lat"]
ThirdValue = Literal["metres", "count", "decimal", "none"]

# Distances from take-off below this say little about a direction; the coarsest coordinates are 11 m steps.
_MIN_DISTANCE_M = 50.0
_MIN_DISTANCES = 3
_MOST = 0.5
# The right order fits to rounding (0.2 m where it was measured), the wrong one by the meridians' convergence.
_FIT_M, _FIT_RATIO, _MISFIT_RATIO = 2.0, 0.02, 4.0


class OrderDecision(NamedTuple):
    order: AxisOrder
    evidence: str
    certain: bool  # by magnitude or distance, not by spelling alone


def decide_order(
    origin: str,
    fixes: FloatArray,
    homes: FloatArray,
    distances_m: FloatArray,
    third: ThirdValue,
    step_deg: float,
) -> OrderDecision:
    """The order of unnamed coordinates of one dialect in one file.

    Args:
        fixes: (n, 2) degrees as written, NaN where there was no fix.
        homes: (n, 2) the place of take-off as written in the same samples, NaN where there is none.
        distances_m: (n,) written horizontal distance from take-off, NaN where there is none.
        third: what follows the two coordinates.
        step_deg: worth of the last written digit.

    Raises:
        TelemetryError: contradictory evidence, or none.
    """
    magnitude = _by_magnitude(origin, np.concatenate([fixes, homes]))
    distance = _by_distance(fixes, homes, distances_m, step_deg)
    certain = [found for found in (magnitude, distance) if found is not None]
    if len({found.order for found in certain}) > 1:
        raise TelemetryError(
            f"{origin}: the order of the coordinates is contradictory: {certain[0].evidence}, but "
            f"{certain[1].evidence}"
        )
    if certain:
        return certain[0]
    if third == "metres":
        return OrderDecision("lat_lon", "latitude first, by the third value in metres (Matrice 300)", False)
    if third == "count":
        return OrderDecision("lon_lat", "longitude first, by the whole third number (satellites)", False)
    raise TelemetryError(
        f"{origin}: whether latitude or longitude comes first cannot be told: no value is beyond 90 degrees, "
        "no distance from take-off is written, and the spelling is of no known drone; give a CSV table "
        "with named columns"
    )


def _by_magnitude(origin: str, pairs: FloatArray) -> OrderDecision | None:
    # Beyond 180 it is no angle at all; that is left to the ranges of positions.
    angles = np.abs(pairs[(np.abs(pairs) <= 180.0).all(axis=1)])
    if not len(angles):
        return None
    # Of a flight nearly all longitudes are beyond 90 degrees or none; a few are garbled digits.
    share = (angles > 90.0).mean(axis=0)
    if (share >= _MOST).all():
        raise TelemetryError(
            f"{origin}: both the first and the second coordinates lie beyond 90 degrees, so that neither can "
            "be the latitude; the file is damaged or not WGS84 degrees"
        )
    if share[0] >= _MOST:
        return OrderDecision("lon_lat", f"{share[0]:.0%} of the first values are beyond 90 degrees", True)
    if share[1] >= _MOST:
        return OrderDecision("lat_lon", f"{share[1]:.0%} of the second values are beyond 90 degrees", True)
    return None


def _by_distance(
    fixes: FloatArray, homes: FloatArray, distances_m: FloatArray, step_deg: float
) -> OrderDecision | None:
    whole = np.isfinite(np.column_stack([fixes, homes, distances_m])).all(axis=1)
    whole &= (np.abs(fixes) <= 90.0).all(axis=1) & (distances_m >= _MIN_DISTANCE_M)
    if whole.sum() < _MIN_DISTANCES:
        return None
    away, told = np.radians(fixes[whole] - homes[whole]), distances_m[whole]
    middle = np.radians(fixes[whole] + homes[whole]) / 2.0
    misfit = {}
    orders: tuple[tuple[AxisOrder, int], ...] = (("lat_lon", 0), ("lon_lat", 1))
    for order, latitude in orders:
        north, east = away[:, latitude], away[:, 1 - latitude] * np.cos(middle[:, latitude])
        length = np.degrees(np.hypot(north, east)) * METRES_PER_DEGREE
        misfit[order] = float(np.median(np.abs(length - told)))
    good, bad = sorted(misfit, key=lambda order: misfit[order])
    tolerance = _FIT_M + step_deg * METRES_PER_DEGREE + _FIT_RATIO * float(np.median(told))
    if misfit[good] > tolerance or misfit[bad] < _MISFIT_RATIO * misfit[good] or misfit[bad] < tolerance:
        return None
    return OrderDecision(
        good,
        f"the written distances from take-off fit {good} within {misfit[good]:.1f} m and {bad} within "
        f"{misfit[bad]:.0f} m only",
        True,
    )
