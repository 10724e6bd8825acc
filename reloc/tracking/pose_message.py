"""Tracked frames as messages of a live session, and back."""

from dataclasses import asdict
from typing import Any

import numpy as np

from featuredb.geo.geopose import BODY_AXES
from featuredb.geometry.camera import Camera
from reloc.answered_view import geopose_of
from reloc.reply import place_fields
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import TrajectoryPoint
from reloc.wire.query import Intrinsics
from reloc.wire.track import TrackPose

_PLACE = ("position", "quaternion", "height_datum", "utm", "covariance", "accuracy", "camera", "map_id")


def pose_message(point: TrajectoryPoint, camera: Camera | None, **about: Any) -> TrackPose:
    """A frame on Earth as the wire says it, with its camera as the client sent it where there is a pose.

    `about`: `session`, `sequence`, `snapshot`, `dropped`, `received_at`, `answered_at`, `timings_ms`.
    """
    pose: dict[str, Any] = dict.fromkeys(_PLACE)
    if point.pose is not None:
        assert camera is not None
        lens = Intrinsics(**asdict(camera))
        pose = {**place_fields(point.pose), "camera": lens, "map_id": point.pose.map_id}
    return TrackPose(
        time_s=point.time_s,
        state=point.state,
        detail=point.detail,
        body_axes=BODY_AXES,
        inliers=point.inliers,
        **about,
        **pose,
    )


def point_of_message(message: TrackPose) -> TrajectoryPoint:
    """A message's frame as a point of a trajectory."""
    return TrajectoryPoint(
        index=message.sequence,
        time_s=message.time_s,
        state=message.state,
        pose=_earth_pose(message),
        inliers=message.inliers,
        detail=message.detail,
    )


def _earth_pose(message: TrackPose) -> EarthPose | None:
    utm = message.utm
    if utm is None:
        return None
    return EarthPose(
        epsg=utm.epsg,
        utm=np.array([utm.easting, utm.northing, utm.height]),
        height_datum=message.height_datum or "unknown",
        cam_from_utm_xyzw=np.array(utm.cam_from_utm_xyzw),
        geopose=geopose_of(message),
        covariance=np.array(message.covariance),
        map_id=message.map_id or "",
    )
