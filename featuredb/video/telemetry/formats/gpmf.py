"""Telemetry of GoPro cameras and of GoPro's drone Karma: the packets of their metadata track.

| stream | rate | what is used |
|---|---|---|
| GPS9 (HERO11, 13, MAX2) | 10 Hz | latitude, longitude, height, day, second and fix of every sample |
| GPS5 (HERO5 to 11) | 18 Hz | latitude, longitude, height; GPSF and GPSU once a packet |
| Karma's GLPI, GPRI, SYST | 4 Hz | MAVLink's messages GLOBAL_POSITION_INT, GPS_RAW_INT, SYSTEM_TIME |

A camera that writes several is read by the first of them. Everything else (ACCL, GYRO, CORI, GRAV, ...) is
skipped. GoPro's heights: without the entry GPSA they are above the ellipsoid (the parser's author, issue 4 of
gopro/gpmf-parser: UBX-M8030, "height above the ellipsoid"), with GPSA "MSLV" above a mean sea level that
nobody names, hence "unknown"; so are GPS9's without GPSA. Karma's positions are the autopilot's own (GLPI);
whether there is a fix comes from the receiver (GPRI). Its attitude (ATTD) is the aircraft's and not read: the
camera hangs in a gimbal whose angles are not written.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geo.datum import HeightDatum
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.klv import Klv, numbers, parse_klv
from featuredb.video.telemetry.values import Telemetry, assemble, check_count

_EPOCH_2000_S = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
_MIN_FIX = 2  # 0 no fix, 2 in two dimensions, 3 in three
_FIX_3D = 3
_GPSU = re.compile(r"([0-9]{12})(?:\.([0-9]{1,3}))?")

Stream = dict[str, Klv]
_S = TypeVar("_S")
_T = TypeVar("_T")

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


def find(streams: list[Stream], key: str, fields: int) -> tuple[Stream, FloatArray] | None:
    """The first stream that has samples of that key, and its `scaled`."""
    for stream in streams:
        values = scaled(stream, key, fields)
        if values is not None:
            return stream, values
    return None


def _check_degrees(stream: Stream, key: str) -> None:
    unit, first = stream.get("UNIT"), _ANGLES_FIRST.get(key)
    if unit is None or first is None or not unit.size:
        return
    starts = (first * unit.size, (first + 1) * unit.size)
    told = [unit.data[at : at + unit.size].rstrip(b"\0 ").decode("latin-1") for at in starts]
    if told != ["deg", "deg"]:
        raise TelemetryError(f"GPMF: expected latitude and longitude of {key} in deg, found units {told}")


@dataclass(frozen=True, slots=True)
class TimedPacket:
    """One packet of the metadata track: begin and duration in seconds of the video, and its bytes."""

    start_s: float
    duration_s: float
    data: bytes


@dataclass(slots=True)
class Decoded:
    """The samples of one packet.

    Attributes:
        columns: (n,) arrays as `assemble` takes them, without times; the same in all packets of a reader.
        clock_at_start_s: UTC of the packet's first sample where the samples have no clock of their own.
    """

    columns: dict[str, FloatArray]
    clock_at_start_s: float = float("nan")
    datum: HeightDatum = "unknown"
    warnings: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.columns["latitude_deg"])


def has_positions(packets: Sequence[TimedPacket]) -> bool:
    """Whether a track has a stream of positions at all; cameras without a receiver write the rest."""
    return any(key in packet.data for packet in packets for key in (b"GPS9", b"GPS5", b"GLPI"))


def read_gpmf(packets: Sequence[TimedPacket], origin: str = "GPMF track") -> Telemetry:
    """The telemetry of a GPMF track's packets, in the order of time.

    The samples of a packet are spread evenly over its duration: GPMF has no times of its own. The last packet
    is often not full; its samples keep the usual distance.

    Raises:
        TelemetryError: no packet can be read, none has a GPS stream, or no sample has a position.
    """
    warnings: list[str] = []
    parsed = _parse_packets(packets, origin, warnings)
    offset = _karma_clock(parsed, warnings)
    readers: tuple[tuple[str, Callable[[list[Stream]], Decoded | None]], ...] = (
        ("GPS9", _gps9),
        ("GPS5", _gps5),
        ("Karma GLPI", lambda streams: _karma(streams, offset)),
    )
    source, decoded = next(
        ((name, found) for name, reader in readers if (found := _decode(parsed, reader, warnings))), ("", [])
    )
    if not decoded:
        keys = sorted({key for _, streams in parsed for stream in streams for key in stream})
        raise TelemetryError(
            f"{origin}: expected a stream GPS9, GPS5 or GLPI, found none (entries: {', '.join(keys)[:300]}); "
            "was GPS switched off?"
        )
    datums = {samples.datum for _, samples in decoded}
    for _, samples in decoded:
        warnings += [line for line in samples.warnings if line not in warnings]
    return assemble(
        _timed(decoded, origin),
        source=f"GPMF {source}",
        origin=origin,
        clock="utc",
        height_datum=datums.pop() if len(datums) == 1 else "unknown",
        warnings=warnings,
    )


def _tried(
    packets: Sequence[tuple[TimedPacket, _S]], read: Callable[[_S], _T]
) -> tuple[list[tuple[TimedPacket, _T]], list[str]]:
    """What is read of each packet, and why others cannot be read."""
    made, reasons = [], []
    for packet, content in packets:
        try:
            made.append((packet, read(content)))
        except TelemetryError as error:
            reasons.append(str(error))
    return made, reasons


def _parse_packets(
    packets: Sequence[TimedPacket], origin: str, warnings: list[str]
) -> list[tuple[TimedPacket, list[Stream]]]:
    parsed, reasons = _tried([(packet, packet.data) for packet in packets], streams_of)
    if not parsed:
        reason = f" ({reasons[0]})" if reasons else ""
        raise TelemetryError(f"{origin}: none of {len(packets)} packets can be read{reason}")
    if reasons:
        warnings.append(f"{len(reasons)} of {len(packets)} packets are damaged and left out ({reasons[0]})")
    return parsed


def _karma_clock(parsed: list[tuple[TimedPacket, list[Stream]]], warnings: list[str]) -> float:
    """Seconds to add to Karma's boot time for UTC, NaN where no packet tells."""
    found, reasons = _tried(parsed, lambda streams: find(streams, "SYST", 2))
    if reasons:
        warnings.append(f"Karma's clock cannot be read ({reasons[0]})")
        return float("nan")
    clocks = [clock[1] for _, clock in found if clock is not None]  # boot time, seconds since 1970
    if not clocks:
        return float("nan")
    return float(np.median(np.concatenate([clock[:, 1] - clock[:, 0] for clock in clocks])))


def _decode(
    parsed: list[tuple[TimedPacket, list[Stream]]],
    reader: Callable[[list[Stream]], Decoded | None],
    warnings: list[str],
) -> list[tuple[TimedPacket, Decoded]]:
    decoded, reasons = _tried(parsed, reader)
    if reasons:
        warnings.append(f"the GPS stream of {len(reasons)} packets cannot be read ({reasons[0]})")
    return [(packet, samples) for packet, samples in decoded if samples is not None]


def _timed(decoded: list[tuple[TimedPacket, Decoded]], origin: str) -> dict[str, FloatArray]:
    """The columns of all samples with their times."""
    check_count(sum(len(samples) for _, samples in decoded), origin)
    steps = [packet.duration_s / len(samples) for packet, samples in decoded]
    usual = float(np.median(steps))
    parts: list[dict[str, FloatArray]] = []
    for row, (packet, samples) in enumerate(decoded):
        step = min(steps[row], usual) if row == len(decoded) - 1 else steps[row]
        after: FloatArray = step * np.arange(len(samples), dtype=np.float64)
        parts.append(
            {
                "clock_s": samples.clock_at_start_s + after,
                **samples.columns,
                "times_s": packet.start_s + after,
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _gps9(streams: list[Stream]) -> Decoded | None:
    """Latitude, longitude, height, two speeds, days since 2000, second of the day, DOP, fix."""
    found = find(streams, "GPS9", 9)
    if found is None:
        return None
    stream, values = found
    fix = values[:, 8]
    clock = _EPOCH_2000_S + 86_400.0 * values[:, 5] + values[:, 6]
    columns = _fixed(values, fix) | {"clock_s": np.where(fix >= _MIN_FIX, clock, np.nan)}
    datum, warnings = _datum(stream, "unknown")
    return Decoded(columns, datum=datum, warnings=warnings)


def _gps5(streams: list[Stream]) -> Decoded | None:
    """Latitude, longitude, height, two speeds; fix and time once for the packet."""
    found = find(streams, "GPS5", 5)
    if found is None:
        return None
    stream, values = found
    datum, warnings = _datum(stream, "ellipsoidal")
    entry, fix = stream.get("GPSF"), float(_FIX_3D)
    if entry is not None and entry.count:
        fix = float(numbers(entry)[0, 0])
    if entry is None or not entry.count or np.isnan(fix):
        fix = float(_FIX_3D)
        warnings.append("GPS5 without its fix status (GPSF): whether positions are fresh is not known")
    start = _utc(stream.get("GPSU")) if fix >= _MIN_FIX else float("nan")
    return Decoded(_fixed(values, np.full(len(values), fix)), start, datum, warnings)


def _fixed(values: FloatArray, fix: FloatArray) -> dict[str, FloatArray]:
    """Positions of samples with a fix, heights of those with a fix in three dimensions."""
    known, deep = fix >= _MIN_FIX, fix >= _FIX_3D
    return {
        "latitude_deg": np.where(known, values[:, 0], np.nan),
        "longitude_deg": np.where(known, values[:, 1], np.nan),
        "height_m": np.where(deep, values[:, 2], np.nan),
    }


def _datum(stream: Stream, without: HeightDatum) -> tuple[HeightDatum, list[str]]:
    entry = stream.get("GPSA")
    if entry is None:
        return without, []
    return "unknown", [f"heights are above {entry.text()[:8]!r} (GPSA), whose geoid is not named"]


def _utc(entry: Klv | None) -> float:
    """Seconds since 1970 of yymmddhhmmss.sss, NaN where it is none."""
    match = _GPSU.fullmatch(entry.text()) if entry is not None else None
    if match is None:
        return float("nan")
    try:
        whole = datetime.strptime(f"20{match[1]}", "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return float("nan")
    return whole.timestamp() + float(f"0.{match[2] or 0}")


def _karma(streams: list[Stream], boot_to_utc_s: float) -> Decoded | None:
    """Boot time, latitude, longitude, height, relative height; fix of the receiver throughout the packet."""
    found, receiver = find(streams, "GLPI", 9), find(streams, "GPRI", 10)
    if found is None:
        return None
    place = found[1]
    fixed = receiver is None or bool((receiver[1][:, 8] >= _MIN_FIX).all())
    columns = {
        "latitude_deg": place[:, 1] if fixed else np.full(len(place), np.nan),
        "longitude_deg": place[:, 2] if fixed else np.full(len(place), np.nan),
        "height_m": place[:, 3],
        "relative_height_m": place[:, 4],
        "clock_s": place[:, 0] + boot_to_utc_s,
    }
    return Decoded(columns)
