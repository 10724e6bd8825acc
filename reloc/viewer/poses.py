"""Poses as the page draws and words them."""

from typing import Any

import numpy as np

from featuredb.geo.geopose import GeoPose
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import matrix_from_quaternion
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import Trajectory

# Half axes of the ellipse that holds 95 % of a plane normal distribution, in standard deviations:
# the root of the chi-square quantile with two degrees of freedom, -2 ln(0.05).
_RADIUS_95 = float(np.sqrt(-2.0 * np.log(0.05)))
# Longer rays than this are of lenses that see more than a hemisphere; a pyramid cannot show them.
_WIDEST = 10.0


def ellipse_95(covariance: FloatArray) -> dict[str, float]:
    """The ellipse in plan that holds 95 % of positions of a covariance (2, 2), east and north, square metres.

    Its half axes, and the azimuth of the major one, clockwise from north, in [0, 180).
    """
    values, vectors = np.linalg.eigh(covariance)
    minor, major = _RADIUS_95 * np.sqrt(np.maximum(values, 0.0))
    east, north = vectors[:, 1]
    azimuth = float(np.degrees(np.arctan2(east, north))) % 180.0
    return {"major_m": float(major), "minor_m": float(minor), "azimuth_deg": azimuth}


def drawn_pose(center: FloatArray, local_from_cam: FloatArray, camera: Camera | None) -> dict[str, Any]:
    """A camera in the place's frame.

    `forward` is a unit vector, `corners` are rays to the image's at unit depth, clockwise from top left.

    Args:
        center: (3,) metres. local_from_cam: (3, 3) from x right, y down, z forward.
        camera: None: a lens of 60 by 45 degrees is drawn.
    """
    rays = _corner_rays(camera)
    return {
        "center": _rounded(center, 4),
        "forward": _rounded(local_from_cam[:, 2], 6),
        "corners": [_rounded(local_from_cam @ ray, 5) for ray in rays],
    }


def worded_place(geopose: GeoPose, utm: FloatArray, epsg: int, height_datum: str) -> dict[str, Any]:
    """UTM (3,) easting, northing, height, GeoPose and angles of one pose; both heights are in one datum."""
    heading, pitch, roll = geopose.heading_pitch_roll_deg
    easting, northing, height = _rounded(utm, 4)
    return {
        "utm": {"epsg": epsg, "easting": easting, "northing": northing, "height": height},
        "height_datum": height_datum,
        "latitude_deg": round(geopose.latitude_deg, 10),
        "longitude_deg": round(geopose.longitude_deg, 10),
        "heading_deg": round(heading, 4),
        "pitch_deg": round(pitch, 4),
        "roll_deg": round(roll, 4),
        "quaternion_xyzw": [round(q, 9) for q in geopose.quaternion_xyzw],
    }


def worded_sigmas(covariance: FloatArray, local_from_true: FloatArray) -> dict[str, Any]:
    """Standard deviations and the ellipse of a pose's covariance.

    Args:
        covariance: (6, 6), true east, north, up at the camera: rotation (rad) before displacement (m).
        local_from_true: (3, 3) from those axes to the place's, in which the ellipse is drawn.
    """
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    position = local_from_true @ covariance[3:, 3:] @ local_from_true.T
    return {
        "sigma_enu_m": [round(float(v), 5) for v in sigmas[3:]],
        "sigma_rotation_deg": [round(float(v), 6) for v in np.degrees(sigmas[:3])],
        "ellipse": ellipse_95(position[:2, :2]),
    }


def _corner_rays(camera: Camera | None) -> FloatArray:
    """Rays (4, 3) in camera axes at unit depth."""
    if camera is not None:
        w, h = float(camera.width), float(camera.height)
        pixels = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
        rays = np.column_stack([camera.unproject(pixels), np.ones(4)])
        # A fisheye's corners may lie beyond what it images; then there is no ray that comes back to them.
        if np.isfinite(rays).all() and np.abs(rays).max() < _WIDEST:
            back = camera.project(rays)
            if np.isfinite(back).all() and np.abs(back - pixels).max() < 1.0:
                return rays
    x, y = np.tan(np.radians(30.0)), np.tan(np.radians(22.5))
    return np.array([[-x, -y, 1.0], [x, -y, 1.0], [x, y, 1.0], [-x, y, 1.0]])


def _rounded(vector: FloatArray, digits: int) -> list[float]:
    return [round(float(v), digits) for v in vector]


def describe_trajectory(trajectory: Trajectory, frame: LocalFrame) -> dict[str, Any]:
    """All frames, poses in the place's frame; `pose` is None where the track is lost."""
    return {
        "name": trajectory.source,
        "frames": [
            {
                **{name: getattr(point, name) for name in ("index", "time_s", "state", "inliers", "detail")},
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
