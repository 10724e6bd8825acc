"""MAVLink 2 for autopilots: ODOMETRY or VISION_POSITION_ESTIMATE in a local NED frame, and GPS_INPUT.

Axes: north, east, down at the local frame's origin; body forward, right, down. Covariances are the upper
triangle, row by row, of x, y, z, roll, pitch, yaw.
"""

import logging
import socket
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.extras import require
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import quaternion_from_matrix, yaw_pitch_roll
from reloc.bridge.robot_pose import FLU_FROM_FRD, NED_FROM_ENU, RobotPose

MavMessage = Literal["odometry", "vision", "gps"]

_SEA_LEVEL = ("egm96", "egm2008", "navd88")  # MAVLink's altitudes are above mean sea level
_GPS_EPOCH_S = 315_964_800  # of Unix time
_LEAP_S = 18  # GPS time ahead of UTC since 2017
_WEEK_S = 604_800
_STEEP = 1e-3  # cosine of a pitch: steeper ones give their angles no larger derivatives

logger = logging.getLogger(__name__)


class MavlinkSender:
    """Packs poses as MAVLink 2 messages.

    Without `geoid_m`, the geoid's height over the ellipsoid, GPS_INPUT says to ignore ellipsoidal altitudes.

    Raises:
        MissingExtraError: pymavlink is not installed.
    """

    def __init__(
        self, messages: Sequence[MavMessage] = ("odometry",), *, geoid_m: float | None = None
    ) -> None:
        require("robots", "The MAVLink bridge", "pymavlink.dialects.v20.common")
        from pymavlink.dialects.v20 import common

        self._dialect: Any = common
        self._link: Any = common.MAVLink(
            None,
            srcSystem=1,  # the vehicle's own, as companion computers have it
            srcComponent=common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY,
        )
        self._messages = tuple(messages)
        self._geoid_m = geoid_m

    def pack(self, pose: RobotPose, origin: LocalFrame) -> list[bytes]:
        """The messages of one pose in a local frame, each a packet."""
        made = {"odometry": self._odometry, "vision": self._vision, "gps": self._gps}
        packets = []
        for name in self._messages:
            packets.append(bytes(made[name](pose, origin).pack(self._link)))
            self._link.seq = (self._link.seq + 1) % 256
        return packets

    def _odometry(self, pose: RobotPose, origin: LocalFrame) -> Any:
        place, turn, covariance = _local(pose, origin)
        x, y, z, w = (float(q) for q in quaternion_from_matrix(turn))
        return self._dialect.MAVLink_odometry_message(
            time_usec=round(pose.time_s * 1e6),
            frame_id=self._dialect.MAV_FRAME_LOCAL_NED,
            child_frame_id=self._dialect.MAV_FRAME_BODY_FRD,
            **dict(zip("xyz", place.tolist(), strict=True)),
            q=[w, x, y, z],
            **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), float("nan")),
            pose_covariance=_upper(covariance),
            velocity_covariance=[float("nan")] * 21,
            reset_counter=0,
            estimator_type=self._dialect.MAV_ESTIMATOR_TYPE_VISION,
            quality=0,
        )

    def _vision(self, pose: RobotPose, origin: LocalFrame) -> Any:
        place, turn, covariance = _local(pose, origin)
        yaw, pitch, roll = yaw_pitch_roll(turn)
        return self._dialect.MAVLink_vision_position_estimate_message(
            usec=round(pose.time_s * 1e6),
            **dict(zip("xyz", place.tolist(), strict=True)),
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            covariance=_upper(covariance),
            reset_counter=0,
        )

    def _gps(self, pose: RobotPose, origin: LocalFrame) -> Any:
        altitude = altitude_m(pose, self._geoid_m)
        ignored = "HDOP VDOP VEL_HORIZ VEL_VERT SPEED_ACCURACY"
        ignored += " ALT VERTICAL_ACCURACY" if altitude is None else ""
        gps_s = pose.time_s - _GPS_EPOCH_S + _LEAP_S
        yaw, _, _ = yaw_pitch_roll(NED_FROM_ENU @ pose.true_enu_from_body @ FLU_FROM_FRD)
        return self._dialect.MAVLink_gps_input_message(
            time_usec=round(pose.time_s * 1e6),
            gps_id=0,
            ignore_flags=sum(
                getattr(self._dialect, f"GPS_INPUT_IGNORE_FLAG_{name}") for name in ignored.split()
            ),
            time_week_ms=round(gps_s % _WEEK_S * 1000.0),
            time_week=int(gps_s // _WEEK_S),
            fix_type=3,
            lat=round(pose.lat * 1e7),
            lon=round(pose.lon * 1e7),
            alt=0.0 if altitude is None else altitude,
            **dict.fromkeys(("hdop", "vdop", "vn", "ve", "vd", "speed_accuracy"), 0.0),
            horiz_accuracy=float(np.sqrt(np.trace(pose.covariance[:2, :2]))),
            vert_accuracy=float(np.sqrt(pose.covariance[2, 2])),
            satellites_visible=0,  # none are behind it; GPS_INPUT has no value for unknown
            yaw=round(np.degrees(yaw) * 100.0) % 36_000 or 36_000,  # 0 would be "not known"
        )


class UdpLink:
    """Sends packets to `udpout:HOST:PORT`; a context manager. `lost`: what the network did not take.

    Raises:
        InvalidValueError: not such an address, or no such host.
    """

    def __init__(self, address: str) -> None:
        kind, _, rest = address.partition(":")
        host, _, port = rest.rpartition(":")
        if kind != "udpout" or not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise InvalidValueError(f"--to: expected udpout:HOST:PORT, found {address!r}")
        try:
            self._to = socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)[0][4]
        except (OSError, UnicodeError) as error:
            raise InvalidValueError(
                f"--to: expected a host that is known, found {host!r} ({error})"
            ) from error
        self.lost = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, packet: bytes) -> None:
        """Send a packet, or count it as lost: a network that is away for a while ends nothing."""
        try:
            self._socket.sendto(packet, self._to)
        except OSError as error:
            if not self.lost:
                logger.warning("a packet was not sent, and others may not be: %s", error)
            self.lost += 1

    def __enter__(self) -> "UdpLink":
        return self

    def __exit__(self, *failed: object) -> None:
        self._socket.close()


def _local(pose: RobotPose, origin: LocalFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, FRD body to NED, and covariance of x, y, z, roll, pitch, yaw."""
    place, turn, covariance = pose.in_frame(origin)
    ned_from_frd = NED_FROM_ENU @ turn @ FLU_FROM_FRD
    to_angles = np.eye(6)
    to_angles[3:, 3:] = _angles_by_rotation(ned_from_frd)
    by_enu = to_angles @ np.kron(np.eye(2), NED_FROM_ENU)
    return NED_FROM_ENU @ place, ned_from_frd, by_enu @ covariance @ by_enu.T


def altitude_m(pose: RobotPose, geoid_m: float | None) -> float | None:
    """Height above mean sea level, or None where the datum does not tell it."""
    if pose.height_datum in _SEA_LEVEL:
        return pose.height_m
    if pose.height_datum == "ellipsoidal" and geoid_m is not None:
        return pose.height_m - geoid_m
    return None


def _angles_by_rotation(rotation: FloatArray) -> FloatArray:
    """(3, 3) derivatives of roll, pitch, yaw by a small rotation about the fixed axes."""
    yaw, pitch, _ = yaw_pitch_roll(rotation)
    cos, sin = max(float(np.cos(pitch)), _STEEP), float(np.sin(pitch))
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c / cos, s / cos, 0.0], [-s, c, 0.0], [c * sin / cos, s * sin / cos, 1.0]])


def _upper(covariance: FloatArray) -> list[float]:
    return [float(v) for v in covariance[np.triu_indices(6)]]
