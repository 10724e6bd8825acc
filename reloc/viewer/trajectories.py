"""Tracks of films as the page plays them."""

from typing import Any

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rotation import matrix_from_quaternion
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import Trajectory
from reloc.viewer.places import Spot
from reloc.viewer.poses import drawn_pose, worded_place, worded_sigmas


def spot_of_trajectory(trajectory: Trajectory) -> Spot:
    """Where the first known pose lies.

    Raises:
        InvalidValueError: all frames are lost.
    """
    pose = next((point.pose for point in trajectory.points if point.pose is not None), None)
    if pose is None:
        raise InvalidValueError(
            f"{trajectory.source}: all {len(trajectory.points)} frames are lost, there is nothing to show"
        )
    easting, northing, height = pose.utm.tolist()
    return Spot(easting=easting, northing=northing, height=height, epsg=pose.epsg)


def describe_trajectory(trajectory: Trajectory, frame: LocalFrame) -> dict[str, Any]:
    """All frames, poses in the place's frame; `pose` is None where the track is lost."""
    return {
        "name": trajectory.source,
        "frames": [
            {
                "index": point.index,
                "time_s": point.time_s,
                "state": point.state,
                "inliers": point.inliers,
                "detail": point.detail,
                "pose": None if point.pose is None else _pose(point.pose, frame),
            }
            for point in trajectory.points
        ],
    }


def _pose(pose: EarthPose, frame: LocalFrame) -> dict[str, Any]:
    center = frame.enu_from_utm(pose.utm, pose.epsg)
    cam_from_local = matrix_from_quaternion(pose.cam_from_utm_xyzw) @ frame.grid_from_enu(center, pose.epsg)
    return {
        **drawn_pose(center, np.asarray(cam_from_local.T), None),
        **worded_place(pose.geopose, pose.utm, pose.epsg, pose.height_datum),
        **worded_sigmas(pose.covariance, frame.true_enu_from_enu(center).T),
        "map_id": pose.map_id,
    }
