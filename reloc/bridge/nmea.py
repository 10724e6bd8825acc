"""NMEA 0183 for what reads a receiver: GGA, the place, and GST, its standard deviations."""

from datetime import UTC, datetime

import numpy as np

from reloc.bridge.mavlink import altitude_m
from reloc.bridge.robot_pose import RobotPose

_ESTIMATED = 6  # quality of GGA: dead reckoning, as no satellites are behind it


def sentences(pose: RobotPose, geoid_m: float | None = None) -> list[str]:
    """GGA and GST with their checksums, each ending in CR LF.

    Without `geoid_m`, the geoid's height over the ellipsoid, ellipsoidal heights are left empty.
    """
    time = datetime.fromtimestamp(pose.time_s, UTC)
    clock = f"{time:%H%M%S}.{time.microsecond // 10_000:02d}"
    altitude = altitude_m(pose, geoid_m)
    height = ",," if altitude is None else f"{altitude:.3f},M,"
    geoid = "," if geoid_m is None else f"{geoid_m:.3f},M"
    north, east = _angle(pose.lat, 2, "NS"), _angle(pose.lon, 3, "EW")
    covariance = pose.covariance
    variances, axes = np.linalg.eigh(covariance[:2, :2])
    major = axes[:, 1]
    turn = float(np.degrees(np.arctan2(major[0], major[1]))) % 180.0  # from true north
    major_m, minor_m = np.sqrt(np.maximum(variances[::-1], 0.0))
    east_m, north_m, up_m = np.sqrt(np.diag(covariance)[:3])
    return [
        _framed(f"GPGGA,{clock},{north},{east},{_ESTIMATED},00,,{height}{geoid},,"),
        _framed(
            f"GPGST,{clock},,{major_m:.3f},{minor_m:.3f},{turn:.1f},{north_m:.3f},{east_m:.3f},{up_m:.3f}"
        ),
    ]


def _angle(degrees: float, digits: int, letters: str) -> str:
    hundred_thousandths = round(abs(degrees) * 6_000_000)  # of a minute: no 60.00000
    whole, minutes = divmod(hundred_thousandths, 6_000_000)
    return f"{whole:0{digits}d}{minutes / 100_000:08.5f},{letters[degrees < 0]}"


def _framed(body: str) -> str:
    checksum = 0
    for byte in body.encode("ascii"):
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n"
