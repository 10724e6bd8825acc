"""What tracking says of one frame."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.tracking.ground import Ground

TrackState = Literal["tracking", "relocalised", "lost"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFrame:
    """What is known of one frame.

    Attributes:
        index, time_s: of the frame.
        state: tracking; relocalised, on the first frame after the track was lost or begun; lost: no pose.
        cam_from_local: pose in the ground's frame, None where the track is lost.
        covariance: (6, 6), see `FittedPose`; None with the pose.
        camera: intrinsics in use; None with the pose. ground: in whose frame the pose is.
        inliers: landmarks that agree with it. pixels: (k, 2) of them; rows: (k,) of the ground's
            points.
        detail: why there is no pose.
    """

    index: int
    time_s: float
    state: TrackState
    cam_from_local: Rigid3 | None = None
    covariance: FloatArray | None = None
    camera: Camera | None = None
    ground: Ground | None = None
    inliers: int = 0
    pixels: FloatArray | None = None
    rows: NDArray[np.int64] | None = None
    detail: str = ""
