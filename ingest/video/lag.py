"""How late the telemetry of a film is: when the picture moves fast, and when the receiver says that it does.

Recorders write a position that is some tenths of a second old. While a drone starts, turns and stops, the
picture's speed and the receiver's are the same curve, shifted. At a constant speed there is no curve, and
nothing is said.
"""

from typing import NamedTuple

import numpy as np

from featuredb.video.telemetry.values import Telemetry
from ingest.video.match import LEAST_S, STEP_S, match_movement
from ingest.video.motion import Motion

_MOST_S = 3.0  # that is looked for
_MIN_CORRELATION = 0.8  # of the two curves at the best lag
_MIN_DROP = 0.02  # how much less it is, half a second off to either side


class Lag(NamedTuple):
    """What was found.

    Attributes:
        late_s: telemetry shown at t + late_s is that of the picture at t; None: not known.
    """

    late_s: float | None
    message: str


def estimate_lag(motion: Motion, telemetry: Telemetry) -> Lag:
    """The lag of the telemetry behind the picture."""
    match = match_movement(motion, telemetry, (-_MOST_S, _MOST_S))
    if match is None:
        return Lag(None, "too few samples to tell the lag")
    lags, found = match.lags_s, match.speed
    if not np.isfinite(found).any():
        return Lag(None, f"picture and telemetry have no {LEAST_S:g} s in common to tell the lag by")
    best = int(np.nanargmax(found))
    aside = round(0.5 / STEP_S)
    drops = [found[best] - found[k] for k in (best - aside, best + aside) if 0 <= k < len(lags)]
    drop = float(np.nanmin(drops)) if np.isfinite(drops).any() else 0.0
    correlation = float(found[best])
    if len(drops) < 2 or correlation < _MIN_CORRELATION or drop < _MIN_DROP:
        return Lag(
            None,
            f"speeds of picture and telemetry do not tell the lag (correlation {correlation:.2f}, "
            f"{drop:.3f} less half a second off)",
        )
    late = round(float(lags[best]), 3)
    return Lag(
        late,
        f"telemetry is {late:+.2f} s late by the speeds of picture and receiver (correlation "
        f"{correlation:.2f})",
    )
