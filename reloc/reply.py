"""Poses as the wire says them, and the reply out of a localisation result."""

from dataclasses import asdict
from typing import Any

import numpy as np

from featuredb.geo.geopose import BODY_AXES
from featuredb.geometry.arrays import FloatArray
from reloc.localise.result import Inliers, LocalisedPose, LocaliseResult, OnEarth
from reloc.wire.query import (
    Accuracy,
    CameraUsed,
    InlierPoints,
    LocaliseReply,
    Position,
    Quaternion,
    UtmPose,
)


def reply_from_result(
    result: LocaliseResult, *, request_id: str, timings_ms: dict[str, float]
) -> LocaliseReply:
    """Word a result as the wire does; `timings_ms` replaces the result's own."""
    fields: dict[str, Any] = _NO_POSE if result.pose is None else _pose_fields(result.pose)
    if result.in_map is not None:
        fields = _NO_POSE | {"in_map": result.in_map, "maps": (result.in_map.map_id,)}
    return LocaliseReply(
        **{name: getattr(result, name) for name in _SAME},
        exif_prior=result.own_position,
        timings_ms=timings_ms,
        request_id=request_id,
        body_axes=BODY_AXES,
        **fields,
    )


# What a result and its reply call alike.
_SAME = (
    "status",
    "reason",
    "detail",
    "confidence",
    "features",
    "matches",
    "inliers",
    "snapshot",
    "runner_up",
)
_NO_POSE: dict[str, Any] = {
    **dict.fromkeys(("position", "quaternion", "height_datum", "utm", "covariance", "accuracy", "camera")),
    **dict.fromkeys(("residual_rms_px", "inlier_points")),
    "maps": (),
    "lineage": (),
}


def place_fields(pose: OnEarth) -> dict[str, Any]:
    """Position, orientation and how surely, as members of a message."""
    x, y, z, w = pose.geopose.quaternion_xyzw
    place = dict(zip(("easting", "northing", "height"), _floats(pose.utm), strict=True))
    return {
        "position": Position(
            lat=pose.geopose.latitude_deg, lon=pose.geopose.longitude_deg, h=pose.geopose.height_m
        ),
        "quaternion": Quaternion(x=x, y=y, z=z, w=w),
        "height_datum": pose.height_datum,
        "utm": UtmPose(epsg=pose.epsg, cam_from_utm_xyzw=_floats(pose.cam_from_utm_xyzw), **place),
        "covariance": tuple(_floats(row) for row in pose.covariance),
        "accuracy": Accuracy.model_validate(pose, from_attributes=True),
    }


def _pose_fields(pose: LocalisedPose) -> dict[str, Any]:
    return {
        **place_fields(pose),
        "camera": CameraUsed(**asdict(pose.camera), source=pose.camera_source),
        "view_covariance": None
        if pose.view_covariance is None
        else tuple(_floats(row) for row in pose.view_covariance),
        "residual_rms_px": pose.residual_rms_px,
        "maps": pose.map_ids,
        "lineage": pose.lineage,
        "inlier_points": None if pose.inliers is None else _inlier_points(pose.inliers),
    }


def _floats(values: FloatArray) -> Any:
    return tuple(values.tolist())


def _inlier_points(inliers: Inliers) -> InlierPoints:
    return InlierPoints(
        pixels=tuple(_floats(row) for row in np.round(inliers.pixels, 2)),
        utm=tuple(_floats(row) for row in np.round(inliers.points_utm, 4)),
        map_rows=tuple(inliers.map_rows.tolist()),
    )
