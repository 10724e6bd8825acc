"""Poses, tracks and maps as the page draws and words them."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from featuredb.export.selection import licence_of
from featuredb.export.shots import pose_covariance
from featuredb.geo.geopose import GeoPose, geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.lineage import MapLineage, describe_lineage
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.store import MapSummary, UnplacedSummary
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import Trajectory
from reloc.viewer.points import DrawnPoints

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


_CELLS = 60  # along the longer side of the drawn points; smaller cells would fall into specks
_LEAST_POINTS = 2  # in a cell that counts as covered; a single one is often wrong


def describe_map(summary: MapSummary, lineage: MapLineage, drawn_under: str | None) -> dict[str, Any]:
    """What the store knows of a map, without loading it, and the map under which it stands in the tree."""
    same = ("method", "generation", "residual_rms_m", "points", "epsg", "height_datum")
    return {
        **as_stored(summary),
        **{name: getattr(summary, name) for name in same},
        "parents": list(summary.parents),
        "under": drawn_under,
        "chain": list(lineage.chain),
        "lineage": describe_lineage(lineage),
        "drift_m": lineage.drift_m,
        "budget_m": lineage.budget_m,
    }


def as_stored(summary: MapSummary | UnplacedSummary) -> dict[str, Any]:
    """What the store knows of every map, with a place or without."""
    same = ("name", "status", "status_reason", "source", "licence")
    return {
        "id": summary.map_id,
        "created_at": summary.created_at.isoformat(timespec="seconds"),
        **{name: getattr(summary, name) for name in same},
    }


def describe_photos(feature_map: FeatureMap, frame: LocalFrame) -> list[dict[str, Any]]:
    """The photos of a map, poses in the place's frame."""
    frame_from_map = frame.enu_from(feature_map.frame)
    photos = []
    for image in feature_map.images:
        pose = image.cam_from_local
        center = frame_from_map.act(pose.center)
        camera = feature_map.cameras[image.camera_id]
        turn = frame_from_map.rotation @ pose.rotation.T
        utm = feature_map.frame.utm_from_enu(pose.center, feature_map.epsg)
        geopose = geopose_from_camera(pose, feature_map.frame)
        local_from_true = frame.true_enu_from_enu(center).T
        where = worded_place(geopose, utm, feature_map.epsg, feature_map.height_datum)
        where |= worded_sigmas(pose_covariance(feature_map, image), local_from_true)
        photos.append(described_photo(image, feature_map, drawn_pose(center, turn, camera) | where))
    return photos


def described_photo(image: MapImage, of: AnyMap, where: dict[str, Any]) -> dict[str, Any]:
    """A photo of a map, with what is drawn and said of its pose."""
    camera, time = of.cameras[image.camera_id], image.capture_time
    return {
        "id": image.image_id,
        "name": image.name,
        **where,
        "camera": f"{camera.model} {camera.width}x{camera.height}, focal length {camera.focal_px:.0f} px",
        "time": None if time is None else time.isoformat(),
        "owner": image.owner,
        "licence": licence_of(image, of),
    }


def coverage(points: DrawnPoints) -> dict[str, Any]:
    """Where the map has points, in plan.

    Returns:
        `ground_m`: the height at which it is drawn, below nearly all points. `cell_m`, and `cells`: rows i, j
        of square cells with at least two points, from i * cell_m to (i + 1) * cell_m east, j likewise north.
        `hull`: corners (k, 2) of the points' convex hull, counterclockwise; none where there is no area.
        Strays are left out of both.
    """
    plan = points.offsets[:, :2].astype(np.float64) + points.origin[:2]
    if len(plan) == 0:
        return {"ground_m": 0.0, "cell_m": 1.0, "cells": [], "hull": []}
    ground = float(np.percentile(points.offsets[:, 2], 2.0)) + float(points.origin[2])
    low, high = points.box()[:, :2]
    inside = plan[((plan >= low) & (plan <= high)).all(axis=1)]
    cell = _round_length(max(float(np.ptp(inside, axis=0).max()) / _CELLS, 0.1))
    cells, count = np.unique(np.floor(inside / cell).astype(np.int64), axis=0, return_counts=True)
    return {
        "ground_m": round(ground, 3),
        "cell_m": cell,
        "cells": cells[count >= _LEAST_POINTS].tolist(),
        "hull": np.round(_hull(inside), 3).tolist(),
    }


def _hull(plan: FloatArray) -> FloatArray:
    try:
        return np.asarray(plan[ConvexHull(plan).vertices])
    except (QhullError, ValueError):
        return np.empty((0, 2))


def _round_length(length: float) -> float:
    """1, 2 or 5 times a power of ten, at least `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= length - 1e-12))


def describe_own_place(
    summary: UnplacedSummary, unplaced: UnplacedMap, drawn: DrawnPoints, buffer: dict[str, Any], command: str
) -> dict[str, Any]:
    """The map as a place of the page with no place on Earth: `frame`, `epsg` and what hangs on them are None.

    `command` opens the page of picks.
    """
    frame, why = unplaced.frame, unplaced.no_place
    told = {
        **as_stored(summary),
        "no_place": {"reason": why.reason, "ways": list(why.ways), "command": command},
        **dict.fromkeys(("method", "drift_m", "budget_m", "residual_rms_m", "epsg", "height_datum", "under")),
        "generation": 0,
        "parents": [],
        "chain": [summary.map_id],
        "lineage": "",
        "points": len(unplaced.points),
        "photos": [_own_photo(image, unplaced) for image in unplaced.images],
        "coverage": coverage(drawn),
        "buffer": buffer,
    }
    return {
        "name": f"{summary.name or summary.map_id}, no place on Earth",
        "own": {"metric": frame.metric, "upright": frame.upright},
        "frame": None,
        "epsg": None,
        "height_datums": [],
        "maps": [told],
        "scans": [],
        "trajectories": [],
    }


def picks_command(url: str, map_id: str, photos: Path | None) -> str:
    """What a person types to place the map by picks in a page."""
    folder = "FOLDER" if photos is None else shlex.quote(str(photos))
    return f"featuredb anchor {shlex.quote(url)} {shlex.quote(map_id)} --photos {folder} --page"


def _own_photo(image: MapImage, unplaced: UnplacedMap) -> dict[str, Any]:
    """A photo with its pose in the own frame."""
    pose, camera = image.cam_from_local, unplaced.cameras[image.camera_id]
    drawn = drawn_pose(pose.center, np.asarray(pose.rotation.T), camera)
    return described_photo(image, unplaced, {**drawn, "utm": None, "ellipse": None})
