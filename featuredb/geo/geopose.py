"""OGC GeoPose 1.0 (21-056r11): a pose on Earth as a position and a rotation in the true ENU there.

As a value and as JSON: Basic-Quaternion, Basic-YPR, Irregular Series.

The body that turns is the camera with axes x forward, y left, z up; the camera itself has x right,
y down, z forward. A level camera that looks true east has the identity rotation. The rotation belongs to the
pose's own position, not to a map's origin: verticals differ by a degree in 111 km, and meridians converge.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.checks import check_place
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix, yaw_pitch_roll

BODY_AXES: Final = "x forward, y left, z up"

BODY_FROM_CAM: FloatArray = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
BODY_FROM_CAM.setflags(write=False)

# Members of documents are those that the schemas of OGC's compliance suite ask for; earlier drafts had a word
# for the transition model, the standard has a frame-like object.
_AUTHORITY = "/geopose/1.0"
_TRANSITION = {"authority": _AUTHORITY, "id": "none", "parameters": ""}  # nothing is known between two poses

# Three decimals are what the tersest clients send; a quaternion further off unit length is no rotation.
UNIT_NORM_TOLERANCE = 2e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class GeoPose:
    """Position and orientation of a camera on Earth.

    Attributes:
        latitude_deg, longitude_deg: WGS84 degrees.
        height_m: metres; above the ellipsoid as the standard wants it, if the datum was known.
        quaternion_xyzw: Hamilton (x, y, z, w) of unit length; rotates body axes (x forward, y left, z up)
            into true east, north, up at this very position. Kept at unit length and w >= 0.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    quaternion_xyzw: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        for name in ("latitude_deg", "longitude_deg", "height_m"):
            object.__setattr__(self, name, float(getattr(self, name)))
        check_place("GeoPose", self.latitude_deg, self.longitude_deg)
        if not math.isfinite(self.height_m):
            raise InvalidValueError(f"GeoPose.height_m: expected a finite number, found {self.height_m}")
        quaternion = np.array(self.quaternion_xyzw, dtype=np.float64)
        norm = float(np.linalg.norm(quaternion)) if quaternion.shape == (4,) else math.nan
        if not abs(norm - 1.0) <= UNIT_NORM_TOLERANCE:
            raise InvalidValueError(
                f"GeoPose.quaternion_xyzw: expected four numbers of unit length, found {self.quaternion_xyzw}"
            )
        quaternion *= (-1.0 if quaternion[3] < 0 else 1.0) / norm
        object.__setattr__(self, "quaternion_xyzw", tuple(float(q) for q in quaternion))

    @property
    def true_enu_from_body(self) -> FloatArray:
        """Rotation (3, 3) of body axes into true east, north, up at the position."""
        return matrix_from_quaternion(self.quaternion_xyzw)

    @property
    def yaw_pitch_roll_deg(self) -> tuple[float, float, float]:
        """Angles of GeoPose's Basic-YPR: turns about z, then the new y, then the new x, right-handed.

        Yaw 0 looks east and grows towards north; with y to the left a positive pitch looks down.
        """
        yaw, pitch, roll = yaw_pitch_roll(self.true_enu_from_body)
        return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)

    @property
    def heading_pitch_roll_deg(self) -> tuple[float, float, float]:
        """The angles that people use: heading clockwise from true north, pitch upwards, roll to the right.

        Heading is in [0, 360). Within 0.1 degrees of straight down (or up) it is that of the image's top
        (bottom) edge and roll is 0, as drones' gimbals tell it.
        """
        yaw, pitch, roll = self.yaw_pitch_roll_deg
        heading = (90.0 - yaw) % 360.0
        # The remainder of a tiny negative number rounds to 360 itself.
        return (heading if heading < 360.0 else 0.0), -pitch, roll

    def to_json(self) -> dict[str, Any]:
        """As a Basic-Quaternion object, ready for `json.dumps`."""
        x, y, z, w = self.quaternion_xyzw
        return {
            "position": {"lat": self.latitude_deg, "lon": self.longitude_deg, "h": self.height_m},
            "quaternion": {"x": x, "y": y, "z": z, "w": w},
        }


def geopose_from_camera(cam_from_local: Rigid3, frame: LocalFrame) -> GeoPose:
    """The GeoPose of a camera whose pose is known in a local frame.

    Args:
        cam_from_local: local ENU (metres) to camera axes (x right, y down, z forward).
    """
    latitude, longitude, height = frame.geodetic_from_enu(cam_from_local.center)
    true_enu_from_local = frame.true_enu_from_enu(cam_from_local.center)
    true_enu_from_body = true_enu_from_local @ cam_from_local.rotation.T @ BODY_FROM_CAM.T
    x, y, z, w = quaternion_from_matrix(true_enu_from_body)
    return GeoPose(
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        height_m=float(height),
        quaternion_xyzw=(float(x), float(y), float(z), float(w)),
    )


def basic_ypr(pose: GeoPose) -> dict[str, Any]:
    """A Basic-YPR GeoPose."""
    yaw, pitch, roll = pose.yaw_pitch_roll_deg
    return {
        "position": pose.to_json()["position"],
        "angles": {"yaw": yaw, "pitch": pitch, "roll": roll},
    }


def irregular_series(poses: Sequence[tuple[int, GeoPose]]) -> dict[str, Any]:
    """Poses of one body with their times; the outer frame is east-north-up at the first of them.

    Translations are metres, rotations are quaternions x, y, z, w of the body.

    Args:
        poses: at least one, in the order of their times, Unix milliseconds.

    Raises:
        ValueError: no poses.
    """
    if not poses:
        raise ValueError("an Irregular Series has at least one pose, found none")
    outer = _frame_at(poses[0][1])
    series = [{"frame": _inner(outer, pose), "validTime": unix_ms} for unix_ms, pose in poses]
    digest = hashlib.sha256(json.dumps(series, separators=(",", ":")).encode()).hexdigest()
    check = {"poseCount": len(series), "integrityCheck": json.dumps({"SHA256": digest})}
    return {
        "header": {
            **check,
            "startInstant": poses[0][0],
            "stopInstant": poses[-1][0],
            "transitionModel": _TRANSITION,
        },
        "outerFrame": {
            "authority": _AUTHORITY,
            "id": "LTP-ENU",
            "parameters": f"longitude={outer.longitude_deg:.10f}&latitude={outer.latitude_deg:.10f}"
            f"&height={outer.height_m:.4f}",
        },
        "innerFrameAndTimeSeries": series,
        "trailer": check,
    }


def _frame_at(pose: GeoPose) -> LocalFrame:
    return LocalFrame(
        latitude_deg=pose.latitude_deg, longitude_deg=pose.longitude_deg, height_m=pose.height_m
    )


def _inner(outer: LocalFrame, pose: GeoPose) -> dict[str, str]:
    outer_from_here = outer.enu_from(_frame_at(pose))
    turned = quaternion_from_matrix(outer_from_here.rotation @ pose.true_enu_from_body)
    translation = ", ".join(f"{v:.4f}" for v in outer_from_here.translation)
    rotation = ", ".join(f"{v:.9f}" for v in turned)
    return {
        "authority": _AUTHORITY,
        "id": "RotateTranslate",
        "parameters": f"translation=[{translation}]&rotation=[{rotation}]",
    }
