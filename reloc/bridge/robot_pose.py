"""A pose as robots want it: of the vehicle's body, in a local frame and on Earth, with its covariance.

A covariance here is (6, 6): displacement (m) before a small rotation (rad), about fixed axes, as MAVLink and
ROS have it. Answers have the rotation first.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, Self

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import matrix_from_quaternion

Mount = Literal["forward", "down"]

# Camera body axes (x forward along the view, y left, z up in the picture) to those of the vehicle (forward,
# left, up). "down": the camera looks down, and the top of the picture is towards the nose.
_VEHICLE_FROM_CAMERA: dict[Mount, FloatArray] = {
    "forward": np.eye(3),
    "down": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
}
NED_FROM_ENU: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD: FloatArray = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RobotPose:
    """Where the camera is, and how the vehicle that carries it is turned."""

    time_s: float  # Unix time, UTC
    lat: float  # WGS84 degrees
    lon: float
    height_m: float  # in `height_datum`
    height_datum: str
    true_enu_from_body: FloatArray  # (3, 3), body axes forward, left, up to true east, north, up
    covariance: FloatArray  # (6, 6) true east, north, up: displacement (m) before rotation (rad)

    @classmethod
    def of_answer(cls, answer: dict[str, Any], mount: Mount, now_s: float) -> Self | None:
        """The pose of a localise reply or of a live session's pose, as JSON; None where it has none.

        Its time is when the server received the frame, where it says so; else now.

        Raises:
            InvalidValueError: it is neither.
        """
        try:
            if answer["position"] is None:
                return None
            position, turn = answer["position"], answer["quaternion"]
            camera = matrix_from_quaternion([turn[axis] for axis in "xyzw"])
            given = np.array(answer["covariance"], dtype=np.float64)
            swap = [3, 4, 5, 0, 1, 2]
            received = answer.get("received_at")
            return cls(
                time_s=now_s if received is None else datetime.fromisoformat(received).timestamp(),
                lat=float(position["lat"]),
                lon=float(position["lon"]),
                height_m=float(position["h"]),
                height_datum=str(answer["height_datum"]),
                true_enu_from_body=camera @ _VEHICLE_FROM_CAMERA[mount].T,
                covariance=given[np.ix_(swap, swap)],
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InvalidValueError(
                "bridge: expected answers as `live --json` and `query --json` print them, found "
                f"{type(error).__name__}: {error}"
            ) from error

    def in_frame(self, frame: LocalFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position (3,), body axes to the frame's (3, 3), and covariance (6, 6), in a local frame."""
        place = frame.enu_from_geodetic((self.lat, self.lon, self.height_m))
        turn = frame.true_enu_from_enu(place).T
        both = np.kron(np.eye(2), turn)
        return place, turn @ self.true_enu_from_body, both @ self.covariance @ both.T


def read_answers(
    lines: Iterable[str], mount: Mount, clock: Any, origin: LocalFrame | None = None
) -> Iterator[tuple[RobotPose, LocalFrame]]:
    """Poses of answers and their local frame; one JSON object a line, those without a pose are passed over.

    `clock` gives Unix time in seconds; without an origin the local frame is where the first pose is.

    Raises:
        InvalidValueError: a line is no answer.
    """
    for line in lines:
        if not line.strip():
            continue
        try:
            answer = json.loads(line)
        except ValueError as error:
            raise InvalidValueError(f"bridge: expected a JSON object a line, found {line!r:.80}") from error
        pose = RobotPose.of_answer(answer, mount, clock())
        if pose is not None:
            origin = origin or LocalFrame(
                latitude_deg=pose.lat, longitude_deg=pose.lon, height_m=pose.height_m
            )
            yield pose, origin
