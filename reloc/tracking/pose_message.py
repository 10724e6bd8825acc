"""Tracked frames as messages of a live session, and back."""

from typing import Any

import numpy as np

from featuredb.geo.geopose import BODY_AXES, GeoPose
from featuredb.geometry.camera import Camera
from reloc.localise.answer import error_radius
from reloc.reply import place_fields
from reloc.tracking.trajectory.values import EarthPose, TrajectoryPoint
from reloc.wire.query import Accuracy
from reloc.wire.track import Intrinsics, TrackPose

_POSE_FIELDS = (
    *("position", "quaternion", "height_datum", "utm"),
    *("covariance", "accuracy", "camera", "map_id"),
)


def pose_message(
    point: TrajectoryPoint,
    camera: Camera | None,
    *,
    session: str,
    sequence: int,
    snapshot: int,
    dropped: int,
    received_at: str,
    answered_at: str,
    timings_ms: dict[str, float],
) -> TrackPose:
    """A frame on Earth as the wire says it.

    Args:
        camera: intrinsics of the frame as the client sent it; not None where there is a pose.
    """
    pose: dict[str, Any] = dict.fromkeys(_POSE_FIELDS)
    if point.pose is not None:
        assert camera is not None
        pose = _pose_fields(point.pose, camera)
    return TrackPose(
        session=session,
        sequence=sequence,
        time_s=point.time_s,
        state=point.state,
        detail=point.detail,
        body_axes=BODY_AXES,
        inliers=point.inliers,
        snapshot=snapshot,
        dropped=dropped,
        received_at=received_at,
        answered_at=answered_at,
        timings_ms=timings_ms,
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


def _pose_fields(pose: EarthPose, camera: Camera) -> dict[str, Any]:
    return {
        **place_fields(pose),
        "accuracy": Accuracy(
            horizontal_68_m=error_radius(pose.covariance[3:5, 3:5]),
            vertical_68_m=error_radius(pose.covariance[5:, 5:]),
            orientation_68_deg=float(np.degrees(error_radius(pose.covariance[:3, :3]))),
        ),
        "camera": Intrinsics(
            model=camera.model, width=camera.width, height=camera.height, params=camera.params
        ),
        "map_id": pose.map_id,
    }


def _earth_pose(message: TrackPose) -> EarthPose | None:
    utm, position, quaternion = message.utm, message.position, message.quaternion
    if utm is None or position is None or quaternion is None or message.covariance is None:
        return None
    return EarthPose(
        epsg=utm.epsg,
        utm=np.array([utm.easting, utm.northing, utm.height]),
        height_datum=message.height_datum or "unknown",
        cam_from_utm_xyzw=np.array(utm.cam_from_utm_xyzw),
        geopose=GeoPose(
            latitude_deg=position.lat,
            longitude_deg=position.lon,
            height_m=position.h,
            quaternion_xyzw=(quaternion.x, quaternion.y, quaternion.z, quaternion.w),
        ),
        covariance=np.array(message.covariance),
        map_id=message.map_id or "",
    )
