"""How a camera is turned, by the angles that gimbals and people give."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraAngles:
    """What a photo says of its camera's orientation.

    Attributes:
        yaw_deg: clockwise from true north: where the optical axis points in plan; of a camera that looks
            straight down, where the top of the photo points. None: not known.
        pitch_deg: of the optical axis above the horizon; -90 looks straight down. None: only yaw is known.
        roll_deg: of the camera about its optical axis, clockwise as the camera sees it.
        sigma_yaw_deg, sigma_tilt_deg: one standard deviation, with what the flight's photos share.
    """

    yaw_deg: float | None
    pitch_deg: float | None
    roll_deg: float = 0.0
    sigma_yaw_deg: float
    sigma_tilt_deg: float

    def __post_init__(self) -> None:
        told = [angle for angle in (self.yaw_deg, self.pitch_deg) if angle is not None]
        if not told or not all(math.isfinite(angle) for angle in (*told, self.roll_deg)):
            raise InvalidValueError(f"CameraAngles: expected a yaw or a pitch, all finite, found {self}")
        if not (0 < self.sigma_yaw_deg < math.inf and 0 < self.sigma_tilt_deg < math.inf):
            raise InvalidValueError(f"CameraAngles: expected finite standard deviations > 0, found {self}")

    @classmethod
    def of_body(
        cls, yaw_deg: float, pitch_deg: float, roll_deg: float, *, sigma_yaw_deg: float, sigma_tilt_deg: float
    ) -> Self:
        """Of an aircraft whose camera looks straight down at pitch 0, the top of the photo ahead (Pix4D).

        Args:
            yaw_deg: clockwise from true north. pitch_deg: nose up. roll_deg: right wing down.
        """
        level = cam_from_enu(0.0, -90.0, 0.0)  # x right, y back, z down
        pitch, roll = so3_exp([np.radians(pitch_deg), 0.0, 0.0]), so3_exp([0.0, np.radians(roll_deg), 0.0])
        yaw = so3_exp([0.0, 0.0, np.radians(yaw_deg)])
        # About the east axis the nose goes up, about the north axis the right wing goes down.
        rotation = level @ (pitch @ roll).T @ yaw
        ahead, right = rotation[2], rotation[0]
        heading = math.degrees(math.atan2(ahead[0], ahead[1]))
        if math.hypot(ahead[0], ahead[1]) < 1e-6:
            heading = math.degrees(math.atan2(-rotation[1][0], -rotation[1][1]))
        tilt = math.degrees(math.asin(float(np.clip(ahead[2], -1.0, 1.0))))
        flat = cam_from_enu(heading, tilt, 0.0)
        return cls(
            yaw_deg=heading,
            pitch_deg=tilt,
            roll_deg=math.degrees(math.atan2(float(flat[1] @ right), float(flat[0] @ right))),
            sigma_yaw_deg=sigma_yaw_deg,
            sigma_tilt_deg=sigma_tilt_deg,
        )


def cam_from_enu(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """Rotation (3, 3) from east, north, up to camera axes; angles as in `CameraAngles`."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # looks north
    yaw = so3_exp([0.0, 0.0, np.radians(yaw_deg)])  # turns the world left, so the camera right
    pitch = so3_exp([-np.radians(pitch_deg), 0.0, 0.0])
    roll = so3_exp([0.0, 0.0, -np.radians(roll_deg)])
    return np.asarray(roll @ pitch @ level @ yaw, dtype=np.float64)
