"""Where a film's keyframes were taken and how the camera was turned, by its telemetry."""

import hashlib
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.values import Telemetry, TelemetrySamples
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
    motion: Motion, telemetry: Telemetry, film: FilmTime, told_late_s: float | None, *, needed: bool
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
    columns = [getattr(telemetry, column.name) for column in fields(TelemetrySamples)]
    parts = [hashlib.sha256(np.ascontiguousarray(column).tobytes()).hexdigest() for column in columns]
    return digest(*parts, telemetry.height_datum, str(telemetry.in_video_time), telemetry.clock)


def places_at(
    telemetry: Telemetry | None, choice: KeyframeChoice, late_s: float | None
) -> tuple[Sequence[Position | None], Sequence[GimbalAngles | None], str]:
    """Position and gimbal's angles of each keyframe, and what the heights count from, for people.

    No angles where yaw or pitch is not known, or all are zero.
    """
    nowhere = [None] * len(choice.index)
    if telemetry is None:
        return nowhere, nowhere, ""
    if late_s is None:
        return nowhere, nowhere, "not known: where in the log the film begins is not clear"
    at = telemetry.at(np.array(choice.time_s) + late_s)
    height: FloatArray = at.height_m
    heights: str = telemetry.height_datum
    if not np.isfinite(height).any():
        height, heights = at.relative_height_m, RELATIVE_HEIGHTS
    known = at.has_position & np.isfinite(height)
    if not at.has_position.any():
        heights = "not known: the telemetry has no positions at the keyframes' times"
    elif not known.any():
        heights = "not known: positions without heights are not used"
    places = np.stack([at.latitude_deg, at.longitude_deg, height], axis=1)
    ypr = np.column_stack([at.gimbal_ypr_deg[:, :2], np.nan_to_num(at.gimbal_ypr_deg[:, 2])])
    turned = np.logical_and(np.isfinite(ypr).all(axis=1), ypr.any(axis=1))
    return _rows(places, known), _rows(ypr, turned), heights


def _rows(values: FloatArray, known: NDArray[np.bool_]) -> list[tuple[float, float, float] | None]:
    return [(a, b, c) if told else None for (a, b, c), told in zip(values.tolist(), known, strict=True)]
