"""What GoPro's drone Karma adds to a GPMF packet: MAVLink's messages, as complex structures.

| stream | values | MAVLink |
|---|---|---|
| GLPI | boot time, latitude, longitude, height, relative height, 3 speeds, heading | GLOBAL_POSITION_INT |
| GPRI | boot time, latitude, longitude, height, 2 accuracies, speed, course, fix, satellites | GPS_RAW_INT |
| ATTD | boot time, roll, pitch, yaw, 3 rates (radians), flag | ATTITUDE |
| SYST | boot time, seconds since 1970 | SYSTEM_TIME |

Positions are the autopilot's own (GLPI); whether there is a fix, and how good it is, comes from the receiver
(GPRI). Its accuracy is declared in metres (UNIT), and could not be a dilution: it goes down to 0.25.
The attitude is the aircraft's; the camera hangs in a gimbal whose angles are not written.
"""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.assemble import RADIUS_68
from featuredb.video.telemetry.formats.gpmf_streams import Stream, find

_MIN_FIX = 2
# A receiver's own accuracy is how well its solution repeats, not how true it is. The data sheet of the u-blox
# M8 promises 2.5 m as the radius of half of all fixes: 2.5 / sqrt(2 ln 2) is the deviation of one axis.
_MIN_SIGMA_M = 2.1
_MAX_HEADING_DEG = 360.0  # above it MAVLink's "not known"
_NO_ACCURACY_M = 655.0  # likewise: 65535 hundredths


def boot_to_utc(packets: list[list[Stream]]) -> float:
    """Seconds to add to Karma's boot time for UTC, NaN where no packet tells. Packets as of `streams_of`."""
    offsets: list[float] = []
    for streams in packets:
        clock = find(streams, "SYST", 2)
        if clock is not None:
            offsets += (clock[:, 1] - clock[:, 0]).tolist()
    return float(np.median(offsets)) if offsets else float("nan")


def karma_samples(streams: list[Stream], boot_to_utc_s: float) -> dict[str, FloatArray] | None:
    """The columns (n,) of one packet's samples by the names of `SampleTable`, None where it has none.

    Raises:
        TelemetryError: a stream that is not of the structure above.
    """
    place = find(streams, "GLPI", 9)
    if place is None:
        return None
    boot, heading = place[:, 0], place[:, 8]
    fixed, sigma = _receiver(find(streams, "GPRI", 10))
    columns = {
        "latitude_deg": place[:, 1] if fixed else np.full(len(place), np.nan),
        "longitude_deg": place[:, 2] if fixed else np.full(len(place), np.nan),
        "height_m": place[:, 3],
        "relative_height_m": place[:, 4],
        "sigma_m": np.full(len(place), sigma),
        "clock_s": boot + boot_to_utc_s,
        "aircraft_yaw": np.where((heading >= 0.0) & (heading <= _MAX_HEADING_DEG), heading, np.nan),
    }
    attitude = find(streams, "ATTD", 8)
    if attitude is not None:
        # Ten times a second at most, so that the nearest one is 0.1 s away.
        nearest = np.abs(attitude[None, :, 0] - boot[:, None]).argmin(axis=1)
        for axis, column in (("roll", 1), ("pitch", 2), ("yaw", 3)):
            columns[f"aircraft_{axis}"] = np.degrees(attitude[nearest, column])
    return columns


def _receiver(raw: FloatArray | None) -> tuple[bool, float]:
    """Whether the receiver had a fix throughout the packet, and its worst accuracy as a deviation."""
    if raw is None:
        return True, float("nan")
    accuracy = float(raw[:, 4].max())
    sigma = max(accuracy / RADIUS_68, _MIN_SIGMA_M) if accuracy < _NO_ACCURACY_M else float("nan")
    return bool((raw[:, 8] >= _MIN_FIX).all()), sigma
