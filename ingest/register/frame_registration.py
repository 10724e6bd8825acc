"""Values of registering one photo to a LiDAR scan: the prior that goes in and the verdict that comes out."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3

FrameReason = Literal[
    "NO_SCAN",  # the scan does not cover what the prior sees
    "TOO_FEW_MATCHES",
    "NO_CONSISTENT_POSE",
    "AMBIGUOUS",  # another pose does nearly as well
    "CONTRADICTS_PRIOR",
    "NOT_CONFIRMED",  # the pictures do not agree at the pose found
]
RenderSource = Literal["rgb", "intensity", "shaded"]
SIGMAS = ("sigma_horizontal_m", "sigma_vertical_m", "sigma_heading_deg", "sigma_tilt_deg")  # of a prior


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePrior:
    """A coarse pose of a photo in the local frame of a scan, with honest standard deviations.

    Attributes:
        cam_from_local: the best guess.
        sigma_horizontal_m, sigma_vertical_m: of the camera's centre.
        sigma_heading_deg: about the vertical; 180 or more means unknown.
        sigma_tilt_deg: of pitch and roll each.
    """

    cam_from_local: Rigid3
    sigma_horizontal_m: float
    sigma_vertical_m: float
    sigma_heading_deg: float
    sigma_tilt_deg: float

    @classmethod
    def around(cls, pose: Rigid3, sigma_m: float, sigma_deg: float) -> "FramePrior":
        """Of a pose that is known as well along and about all axes."""
        return cls(
            cam_from_local=pose,
            sigma_horizontal_m=sigma_m,
            sigma_vertical_m=sigma_m,
            sigma_heading_deg=sigma_deg,
            sigma_tilt_deg=sigma_deg,
        )

    def __post_init__(self) -> None:
        for name in SIGMAS:
            value = getattr(self, name)
            if not 0 < value < float("inf"):
                raise InvalidValueError(f"FramePrior.{name}: expected a finite number > 0, found {value}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRegistration:
    """One photo registered to a scan, or why not.

    Attributes:
        cam_from_local: None when refused.
        covariance: (6, 6) of the left perturbation of cam_from_local (rotation before translation, camera
            axes), None when refused.
        reason, message: of the refusal; None and "" when accepted.
        source: what was rendered for the accepted pose; None when refused.
        points_local: (n, 3) scan points of the inlier correspondences, local frame, metres.
        pixels: (n, 2) where the photo shows them, full-size pixels.
        camera: intrinsics that belong to the pose: the ones given, or with the focal length estimated; None
            when refused.
        evidence: figures behind the verdict, JSON-able.
        seconds: time by stage, in order.
    """

    reason: FrameReason | None
    message: str
    cam_from_local: Rigid3 | None = None
    covariance: FloatArray | None = None
    source: RenderSource | None = None
    points_local: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    pixels: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    camera: Camera | None = None
    evidence: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        found = (self.cam_from_local, self.covariance, self.source, self.camera)
        if len({self.reason is not None, *(part is None for part in found)}) != 1:
            raise InvalidValueError(
                "FrameRegistration: expected pose, covariance, source and camera without a reason, or a "
                "reason alone"
            )
        if self.covariance is not None:
            freeze(self, covariance=(6, 6))
        freeze(self, points_local=(len(self.points_local), 3), pixels=(len(self.points_local), 2))

    @property
    def accepted(self) -> bool:
        return self.reason is None
