"""Streams of a GPMF packet: their entries by key, and their samples in true units."""

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.klv import Klv, numbers, parse_klv

Stream = dict[str, Klv]

# What the units of these streams must begin with; a stream whose latitude is no angle is something else.
_ANGLES_FIRST = {"GPS5": 0, "GPS9": 0, "GLPI": 1, "GPRI": 1}


def streams_of(data: bytes) -> list[Stream]:
    """The streams (STRM) of one packet, of all its devices; of several entries with one key the last counts.

    Raises:
        TelemetryError: as `parse_klv`.
    """
    nested = [entry for top in parse_klv(data) for entry in top.walk()]
    return [{child.key: child for child in entry.children} for entry in nested if entry.key == "STRM"]


def scaled(stream: Stream, key: str, fields: int) -> FloatArray | None:
    """The samples (n, fields) of an entry divided by SCAL; None where the stream has none.

    Raises:
        TelemetryError: another number of fields, units that are no degrees, no scale, or a scale of zero.
    """
    entry = stream.get(key)
    if entry is None or not entry.count:
        return None
    values = numbers(entry, stream["TYPE"].text() if "TYPE" in stream else "")
    if values.shape[1] != fields:
        raise TelemetryError(f"GPMF: expected {fields} values in a sample of {key}, found {values.shape[1]}")
    _check_degrees(stream, key)
    if "SCAL" not in stream:
        raise TelemetryError(f"GPMF: {key} without its scale (SCAL)")
    scale = numbers(stream["SCAL"]).ravel()
    if scale.size not in (1, fields) or not np.isfinite(scale).all() or not scale.all():
        raise TelemetryError(
            f"GPMF: the scale of {key} is {scale[:9].tolist()}, expected {fields} values, none 0"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values / scale, dtype=np.float64)


def find(streams: list[Stream], key: str, fields: int) -> FloatArray | None:
    """`scaled` of the first stream that has samples of that key."""
    for stream in streams:
        values = scaled(stream, key, fields)
        if values is not None:
            return values
    return None


def first_number(stream: Stream, key: str) -> float:
    """The first number of an entry, NaN where there is none."""
    entry = stream.get(key)
    return float(numbers(entry)[0, 0]) if entry is not None and entry.count else float("nan")


def _check_degrees(stream: Stream, key: str) -> None:
    unit, first = stream.get("UNIT"), _ANGLES_FIRST.get(key)
    if unit is None or first is None or not unit.size:
        return
    starts = (first * unit.size, (first + 1) * unit.size)
    told = [unit.data[at : at + unit.size].rstrip(b"\0 ").decode("latin-1") for at in starts]
    if told != ["deg", "deg"]:
        raise TelemetryError(f"GPMF: expected latitude and longitude of {key} in deg, found units {told}")
