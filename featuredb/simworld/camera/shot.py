"""Who looks from where: one planned photo."""

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """A camera that people buy.

    Attributes:
        camera: true intrinsics, for the picture as stored.
        focal_mm, focal_35mm: as in EXIF; 35 mm equivalents are whole numbers there and so a little wrong.
    """

    make: str
    model: str
    camera: Camera
    focal_mm: float
    focal_35mm: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """One photo to be taken.

    Attributes:
        name: path within the world's folder, with forward slashes.
        time: timezone-aware.
        seed: of everything that differs from photo to photo: moving cars, waves, noise, exposure.
        gps_enu: (3,) metres, what the receiver believes in the local frame, or None without GPS.
    """

    name: str
    device: Device
    cam_from_local: Rigid3
    time: datetime
    seed: int
    gps_enu: FloatArray | None = None


def look_pose(center: ArrayLike, heading_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Rigid3:
    """Pose of a camera at `center` (3,) in the local frame.

    Args:
        heading_deg: of the view, clockwise from north; for a view straight down, of the picture's top.
        pitch_deg: elevation of the view, -90 is straight down.
        roll_deg: clockwise turn of the camera about its view, 90 for a portrait photo.
    """
    h, p, r = np.radians([heading_deg, pitch_deg, roll_deg])
    view = np.array([np.sin(h) * np.cos(p), np.cos(h) * np.cos(p), np.sin(p)])
    right = np.array([np.cos(h), -np.sin(h), 0.0])
    down = np.cross(view, right)
    rotation = np.stack([np.cos(r) * right + np.sin(r) * down, np.cos(r) * down - np.sin(r) * right, view])
    return Rigid3(rotation=rotation, translation=-rotation @ np.asarray(center, dtype=np.float64))
