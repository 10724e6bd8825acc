"""Where a film's keyframes were taken and how the camera was turned, by its telemetry."""

import hashlib

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry
from ingest.fingerprint import digest
from ingest.video.clocks import lay_on_film
from ingest.video.film_time import FilmTime
from ingest.video.keyframes import KeyframeChoice
from ingest.video.lag import estimate_lag
from ingest.video.motion import Motion

Position = tuple[float, float, float]
"""Latitude and longitude in degrees, height in metres."""

GimbalAngles = tuple[float, float, float]
"""Yaw clockwise from true north, pitch (-90 looks down) and roll of the camera, degrees."""

RELATIVE_HEIGHTS = "above the place of take-off"


def lateness(
    motion: Motion,
    telemetry: Telemetry,
    film: FilmTime,
    told_late_s: float | None,
    *,
    needed: bool,
) -> tuple[float | None, tuple[str, ...]]:
    """The telemetry's time that belongs to the film's time 0, and what there is to say of it.

    Args:
        told_late_s: how late the telemetry is, as was told.
        needed: telemetry that cannot be laid on the film is refused; otherwise it is only told.

    Raises:
        TelemetryError: it is needed, and the film cannot be laid on the telemetry's clock.
    """
    if telemetry.in_video_time:
        if told_late_s is not None:
            return told_late_s, ()
        lag = estimate_lag(motion, telemetry)
        return lag.late_s or 0.0, (lag.message,)
    if told_late_s is not None and film.told_s is not None:
        return film.told_s + told_late_s, ()
    laid = lay_on_film(motion, telemetry, film)
    if laid.late_s is None and needed:
        raise TelemetryError(laid.message)
    return laid.late_s, (laid.message,)


def digest_of_telemetry(telemetry: Telemetry | None) -> str:
    """Of all that positions and angles are made of."""
    if telemetry is None:
        return "none"
    columns = (
        telemetry.times_s,
        telemetry.latitude_deg,
        telemetry.longitude_deg,
        telemetry.height_m,
        telemetry.relative_height_m,
        telemetry.clock_s,
        telemetry.gimbal_ypr_deg,
    )
    parts = [hashlib.sha256(np.ascontiguousarray(column).tobytes()).hexdigest() for column in columns]
    return digest(*parts, telemetry.height_datum, str(telemetry.in_video_time), telemetry.clock)


def positions_at(
    telemetry: Telemetry | None, choice: KeyframeChoice, late_s: float | None
) -> tuple[list[Position | None], str]:
    """Position of each keyframe, and what the heights count from, for people."""
    nowhere: list[Position | None] = [None] * len(choice.index)
    if telemetry is None:
        return nowhere, ""
    if late_s is None:
        return nowhere, "not known: where in the log the film begins is not clear"
    at = telemetry.at(np.array(choice.time_s) + late_s)
    height: FloatArray = at.height_m
    heights: str = telemetry.height_datum
    if not np.isfinite(height).any():
        height, heights = at.relative_height_m, RELATIVE_HEIGHTS
    known = at.has_position & np.isfinite(height)
    if not at.has_position.any():
        return nowhere, "not known: the telemetry has no positions at the keyframes' times"
    if not known.any():
        return nowhere, "not known: positions without heights are not used"
    return [
        (float(at.latitude_deg[k]), float(at.longitude_deg[k]), float(height[k])) if known[k] else None
        for k in range(len(choice.index))
    ], heights


def angles_at(
    telemetry: Telemetry | None, choice: KeyframeChoice, late_s: float | None
) -> list[GimbalAngles | None]:
    """The gimbal's angles at each keyframe; None where yaw or pitch is not known, or all are zero."""
    if telemetry is None or late_s is None:
        return [None] * len(choice.index)
    angles = telemetry.at(np.array(choice.time_s) + late_s).gimbal_ypr_deg
    return [
        (float(yaw), float(pitch), float(np.nan_to_num(roll)))
        if np.isfinite([yaw, pitch]).all() and np.nan_to_num([yaw, pitch, roll]).any()
        else None
        for yaw, pitch, roll in angles
    ]
