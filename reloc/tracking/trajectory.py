"""The track of a video on Earth: where the camera was at each frame, how surely, or that it is not known."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby

from featuredb.geo.geopose import GeoPose, geopose_from_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import quaternion_from_matrix
from reloc.tracking.tracker import TrackedFrame, TrackState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarthPose:
    """Where the camera was; conventions as in `reloc.result.LocalisedPose`.

    Attributes:
        epsg: UTM zone of `utm`, (3,) easting, northing, height of the camera centre, metres.
        height_datum: datum of all heights.
        cam_from_utm_xyzw: (4,) rotation, grid axes (east, north, up) to camera axes.
        geopose: the same as an OGC GeoPose.
        covariance: (6, 6), true east-north-up at the camera: rotation (rad) before displacement (m), of the
            frame's own measurement and of the map's placement.
        map_id: of the map, or the scan, whose points most landmarks are.
    """

    epsg: int
    utm: FloatArray
    height_datum: str
    cam_from_utm_xyzw: FloatArray
    geopose: GeoPose
    covariance: FloatArray
    map_id: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryPoint:
    """One frame.

    Attributes:
        index: of the frame, from 0. time_s: on the film's own clock.
        pose: None where the track is lost; then `detail` says why.
        inliers: landmarks that agree with the pose.
    """

    index: int
    time_s: float
    state: TrackState
    pose: EarthPose | None = None
    inliers: int = 0
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """The frames of one video, in order.

    Attributes:
        source: name of the video. database, version: that was asked.
        start: when the film's clock showed 0, timezone-aware; None: not known.
    """

    source: str
    points: tuple[TrajectoryPoint, ...]
    database: str = ""
    version: int = -1
    start: datetime | None = None

    def stretches(self) -> Iterator[list[tuple[TrajectoryPoint, EarthPose]]]:
        """Runs of frames with poses, between those that are lost."""
        for known, points in groupby(self.points, key=lambda p: p.pose is not None):
            if known:
                yield [(p, p.pose) for p in points if p.pose is not None]


def point_of(frame: TrackedFrame) -> TrajectoryPoint:
    """A tracked frame on Earth."""
    return TrajectoryPoint(
        index=frame.index,
        time_s=frame.time_s,
        state=frame.state,
        pose=_earth_pose(frame),
        inliers=frame.inliers,
        detail=frame.detail,
    )


def _earth_pose(frame: TrackedFrame) -> EarthPose | None:
    ground, pose = frame.ground, frame.cam_from_local
    if pose is None or ground is None or frame.rows is None or frame.covariance is None:
        return None
    stands = ground.standing(frame.rows, pose.center, frame.covariance)
    return EarthPose(
        epsg=stands.epsg,
        utm=ground.frame.utm_from_enu(pose.center, stands.epsg),
        height_datum=stands.height_datum,
        cam_from_utm_xyzw=quaternion_from_matrix(
            pose.rotation @ ground.frame.grid_from_enu(pose.center, stands.epsg).T
        ),
        geopose=geopose_from_camera(pose, ground.frame),
        covariance=stands.covariance,
        map_id=stands.map_id,
    )
