"""What a track stands on, points of maps or of a scan in one local frame, and what it says of a frame."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.localise.result import LocaliseRequest, OnEarth, OwnPose
from reloc.tracking.options import TrackOptions
from reloc.wire.query import CameraSource
from reloc.wire.track import TrackState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarthPose(OnEarth):
    """Where the camera was; `map_id`: of the map, or the scan, whose points most landmarks are."""

    map_id: str


class Ground(Protocol):
    """Known points, and how a frame whose pose is known to some pixels is compared with them.

    `match` is called from the tracker's thread, one call at a time.
    """

    @property
    def frame(self) -> LocalFrame:
        """Local frame of points and poses."""
        ...

    def match(
        self, gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, options: TrackOptions
    ) -> "Keyframe | Unmatched":
        """What is seen of the ground in a frame (h, w) that `pose` is about right for."""
        ...

    def posed(self, rows: NDArray[np.int64], pose: Rigid3, measured: FloatArray) -> EarthPose | OwnPose:
        """A pose in `frame` on Earth, or in its map where that has no place, with the ground's own errors.

        Args:
            rows: (k,) of its landmarks.
            measured: (6, 6) covariance by the landmarks' pixels alone, local axes: rotation before centre.
        """
        ...

    def visible(self, camera: Camera, pose: Rigid3) -> FloatArray:
        """Pixels (n, 2) of some points that the camera should see, to be drawn."""
        ...


class Finder(Protocol):
    """Finds frames whose pose is not known."""

    def find(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, options: TrackOptions
    ) -> "Keyframe | Unmatched":
        """The pose of a frame (h, w) with what it is seen by; called from the tracker's thread."""
        ...

    def has(self, ground: Ground) -> bool:
        """Whether a track on this ground may go on."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """What the ground says of a frame."""

    cam_from_local: Rigid3  # in the ground's frame
    ground: Ground
    camera: Camera  # the given one, or estimated along
    pixels: FloatArray  # (k, 2) of its inliers
    points: FloatArray  # (k, 3) that they see, metres in the ground's frame
    rows: NDArray[np.int64]  # (k,) numbers of the points, by which they are told apart
    camera_source: CameraSource = "request"


@dataclass(frozen=True, slots=True, kw_only=True)
class Unmatched:
    """Why the ground says nothing of a frame: a code and a sentence."""

    reason: str
    detail: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFrame:
    """What is known of one frame."""

    index: int
    time_s: float
    state: TrackState  # relocalised: the first frame after the track was lost or begun; lost: no pose
    cam_from_local: Rigid3 | None = None  # in the ground's frame
    covariance: FloatArray | None = None  # (6, 6), see `FittedPose`
    camera: Camera | None = None  # intrinsics in use
    ground: Ground | None = None
    inliers: int = 0  # landmarks that agree with the pose
    pixels: FloatArray | None = None  # (k, 2) of them
    rows: NDArray[np.int64] | None = None  # (k,) of the ground's points
    detail: str = ""  # why there is no pose
