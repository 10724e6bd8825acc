"""OGC GeoPose 1.0 (21-056r11) as JSON documents: Basic-YPR, Irregular Series.

They have the members that the schemas of OGC's compliance suite ask for; earlier drafts had a word for the
transition model, the standard has a frame-like object.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Any

from featuredb.geo.geopose import GeoPose
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rotation import quaternion_from_matrix

_AUTHORITY = "/geopose/1.0"
# Nothing is known between two poses.
_TRANSITION = {"authority": _AUTHORITY, "id": "none", "parameters": ""}


def basic_ypr(pose: GeoPose) -> dict[str, Any]:
    """A Basic-YPR GeoPose."""
    yaw, pitch, roll = pose.yaw_pitch_roll_deg
    return {
        "position": {"lat": pose.latitude_deg, "lon": pose.longitude_deg, "h": pose.height_m},
        "angles": {"yaw": yaw, "pitch": pitch, "roll": roll},
    }


def irregular_series(poses: Sequence[tuple[int, GeoPose]]) -> dict[str, Any]:
    """Poses of one body with their times; the outer frame is east-north-up at the first of them.

    Translations are metres, rotations are quaternions x, y, z, w of the body.

    Args:
        poses: at least one, in the order of their times, Unix milliseconds.

    Raises:
        ValueError: no poses.
    """
    if not poses:
        raise ValueError("an Irregular Series has at least one pose, found none")
    outer = _frame_at(poses[0][1])
    series = [{"frame": _inner(outer, pose), "validTime": unix_ms} for unix_ms, pose in poses]
    digest = hashlib.sha256(json.dumps(series, separators=(",", ":")).encode()).hexdigest()
    check = {"poseCount": len(series), "integrityCheck": json.dumps({"SHA256": digest})}
    return {
        "header": {
            **check,
            "startInstant": poses[0][0],
            "stopInstant": poses[-1][0],
            "transitionModel": _TRANSITION,
        },
        "outerFrame": _tangent(outer),
        "innerFrameAndTimeSeries": series,
        "trailer": check,
    }


def _frame_at(pose: GeoPose) -> LocalFrame:
    return LocalFrame(
        latitude_deg=pose.latitude_deg, longitude_deg=pose.longitude_deg, height_m=pose.height_m
    )


def _tangent(frame: LocalFrame) -> dict[str, str]:
    return {
        "authority": _AUTHORITY,
        "id": "LTP-ENU",
        "parameters": f"longitude={frame.longitude_deg:.10f}&latitude={frame.latitude_deg:.10f}"
        f"&height={frame.height_m:.4f}",
    }


def _inner(outer: LocalFrame, pose: GeoPose) -> dict[str, str]:
    outer_from_here = outer.enu_from(_frame_at(pose))
    turned = quaternion_from_matrix(outer_from_here.rotation @ pose.true_enu_from_body)
    translation = ", ".join(f"{v:.4f}" for v in outer_from_here.translation)
    rotation = ", ".join(f"{v:.9f}" for v in turned)
    return {
        "authority": _AUTHORITY,
        "id": "RotateTranslate",
        "parameters": f"translation=[{translation}]&rotation=[{rotation}]",
    }
