"""What GoPro's drone Karma adds to a GPMF packet: MAVLink's messages, as complex structures.

| stream | values | MAVLink |
|---|---|---|
| GLPI | boot time, latitude, longitude, height, relative height, 3 speeds, heading | GLOBAL_POSITION_INT |
| GPRI | boot time, latitude, longitude, height, 2 accuracies, speed, course, fix, satellites | GPS_RAW_INT |
| SYST | boot time, seconds since 1970 | SYSTEM_TIME |

Positions are the autopilot's own (GLPI); whether there is a fix comes from the receiver (GPRI). Its attitude
(ATTD) is the aircraft's and not read; the camera hangs in a gimbal whose angles are not written.
"""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats.gpmf_streams import Stream, find

_MIN_FIX = 2


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
    receiver = find(streams, "GPRI", 10)
    fixed = receiver is None or bool((receiver[:, 8] >= _MIN_FIX).all())
    return {
        "latitude_deg": place[:, 1] if fixed else np.full(len(place), np.nan),
        "longitude_deg": place[:, 2] if fixed else np.full(len(place), np.nan),
        "height_m": place[:, 3],
        "relative_height_m": place[:, 4],
        "clock_s": place[:, 0] + boot_to_utc_s,
    }
