"""The track of a video: where the camera was at each frame, how surely, or that it is not known.

On Earth, or in the own frame of a map without a place. The two are different types in different fields, so
that whoever writes places on Earth finds none in the second.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby

from featuredb.errors import InvalidValueError
from reloc.localise.result import OwnPose
from reloc.tracking.ground import EarthPose, TrackedFrame
from reloc.wire.track import TrackState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryPoint:
    """One frame."""

    index: int  # from 0
    time_s: float  # on the film's own clock
    state: TrackState
    pose: EarthPose | None = None  # on Earth; None where the track is lost, or where it is `in_map`
    in_map: OwnPose | None = None  # in the frame of a map without a place
    inliers: int = 0  # landmarks that agree with the pose
    detail: str = ""  # why there is none

    def __post_init__(self) -> None:
        if self.pose is not None and self.in_map is not None:
            raise InvalidValueError(f"TrajectoryPoint {self.index}: on Earth and in a map without a place")

    @property
    def found(self) -> bool:
        """Whether the frame has a pose, of either kind."""
        return self.pose is not None or self.in_map is not None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """The frames of one video, in order."""

    source: str  # the video's name
    points: tuple[TrajectoryPoint, ...]
    start: datetime | None = None  # when the film's clock showed 0, timezone-aware; None: not known

    @property
    def is_in_map(self) -> bool:
        """Whether the poses are in the frame of a map without a place, and none is on Earth."""
        return any(point.in_map is not None for point in self.points)

    def times_found(self) -> list[tuple[float, float]]:
        """First and last time of each run of frames with poses of either kind, seconds."""
        runs = (list(run) for found, run in groupby(self.points, key=lambda p: p.found) if found)
        return [(run[0].time_s, run[-1].time_s) for run in runs]

    def stretches(self) -> Iterator[list[tuple[TrajectoryPoint, EarthPose]]]:
        """Runs of frames with poses on Earth, between those that are lost."""
        for known, points in groupby(self.points, key=lambda p: p.pose is not None):
            if known:
                yield [(p, p.pose) for p in points if p.pose is not None]


def point_of(frame: TrackedFrame) -> TrajectoryPoint:
    """A tracked frame on Earth, or in its map where that has no place."""
    pose: EarthPose | OwnPose | None = None
    if (
        frame.ground is not None
        and frame.cam_from_local is not None
        and frame.rows is not None
        and frame.covariance is not None
    ):
        pose = frame.ground.posed(frame.rows, frame.cam_from_local, frame.covariance)
    return TrajectoryPoint(
        **{name: getattr(frame, name) for name in ("index", "time_s", "state", "inliers", "detail")},
        pose=pose if isinstance(pose, EarthPose) else None,
        in_map=pose if isinstance(pose, OwnPose) else None,
    )
