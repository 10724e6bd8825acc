"""OGC GeoPose 1.0 (21-056r11): every photo as Basic-YPR and Advanced, every map as an Irregular Series.

The body is the camera with axes x forward, y left, z up. Heights are above the ellipsoid, as the standard
wants, where the map's datum can be converted here; `manifest.json` says of each map what its heights are.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from featuredb.export.attribution import ATTRIBUTION, attribution_csv, attribution_of, folder_name
from featuredb.export.job import Exported, ExportJob
from featuredb.export.shots import Shot, shots_of
from featuredb.export.tally import folder_for_each_map
from featuredb.geo.geopose import GeoPose
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.feature_map import FeatureMap

BASIC, ADVANCED, SERIES, MANIFEST = "basic_ypr", "advanced", "series.json", "manifest.json"
_AUTHORITY = "/geopose/1.0"


def write_geopose(job: ExportJob) -> Exported:
    """Write `job.out`/<map>/basic_ypr/<photo>.json for every photo, and with its time where it is known:
    advanced/<photo>.json, series.json.

    Raises:
        ExportError: nothing is selected, or there is something at `job.out`.
    """
    return folder_for_each_map(job, _write_map)


def _write_map(folder: Path, feature_map: FeatureMap) -> None:
    (folder / BASIC).mkdir(parents=True)
    shots = list(shots_of(feature_map))
    names = _file_names(shots)
    for shot, name in zip(shots, names, strict=True):
        _write(folder / BASIC / name, basic_ypr(shot.geopose))
    timed = [(shot, name) for shot, name in zip(shots, names, strict=True) if shot.unix_ms is not None]
    if timed:
        (folder / ADVANCED).mkdir()
        for shot, name in timed:
            _write(folder / ADVANCED / name, advanced(shot))
        _write(folder / SERIES, irregular_series([shot for shot, _ in timed]))
    manifest = {
        "map_id": feature_map.map_id,
        "height_datum": shots[0].height_datum if shots else feature_map.height_datum,
        "body_axes": "x forward, y left, z up",
        "photos": [
            {"file": name, "image": shot.name, "sha256": shot.sha256, "owner": shot.owner}
            | {"licence": shot.licence, "sigma_enu_m": [round(float(v), 4) for v in shot.sigma_enu_m]}
            | {"sigma_rotation_enu_deg": [round(float(v), 5) for v in shot.sigma_rotation_deg]}
            for shot, name in zip(shots, names, strict=True)
        ],
    }
    _write(folder / MANIFEST, manifest)
    (folder / ATTRIBUTION).write_text(attribution_csv(attribution_of(feature_map)), encoding="utf-8")


def basic_ypr(pose: GeoPose) -> dict[str, Any]:
    """A Basic-YPR GeoPose."""
    yaw, pitch, roll = pose.yaw_pitch_roll_deg
    return {
        "position": {"lat": pose.latitude_deg, "lon": pose.longitude_deg, "h": pose.height_m},
        "angles": {"yaw": yaw, "pitch": pitch, "roll": roll},
    }


def advanced(shot: Shot) -> dict[str, Any]:
    """An Advanced GeoPose: Unix milliseconds, frame at the camera, quaternion."""
    pose = shot.geopose
    x, y, z, w = pose.quaternion_xyzw
    return {
        "validTime": shot.unix_ms,
        "frameSpecification": _tangent(
            LocalFrame(
                latitude_deg=pose.latitude_deg, longitude_deg=pose.longitude_deg, height_m=pose.height_m
            )
        ),
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
    }


def irregular_series(shots: Sequence[Shot]) -> dict[str, Any]:
    """The photos in the order of their times; the outer frame is east-north-up at the first of them.

    Raises:
        ValueError: no shots, or one without its time.
    """
    ordered = sorted((_time(shot), shot.number, shot) for shot in shots)
    first = ordered[0][2].geopose
    outer = LocalFrame(
        latitude_deg=first.latitude_deg, longitude_deg=first.longitude_deg, height_m=first.height_m
    )
    series = [{"frame": _inner(outer, shot.geopose), "validTime": time} for time, _, shot in ordered]
    digest = hashlib.sha256(json.dumps(series, separators=(",", ":")).encode()).hexdigest()
    check = {"poseCount": len(series), "integrityCheck": json.dumps({"SHA256": digest})}
    return {
        "header": {
            **check,
            "startInstant": ordered[0][0],
            "stopInstant": ordered[-1][0],
            "transitionModel": "none",
        },
        "outerFrame": _tangent(outer),
        "innerFrameAndTimeSeries": series,
        "trailer": check,
    }


def _tangent(frame: LocalFrame) -> dict[str, str]:
    return {
        "authority": _AUTHORITY,
        "id": "LTP-ENU",
        "parameters": f"longitude={frame.longitude_deg:.10f}&latitude={frame.latitude_deg:.10f}"
        f"&height={frame.height_m:.4f}",
    }


def _inner(outer: LocalFrame, pose: GeoPose) -> dict[str, str]:
    here = LocalFrame(
        latitude_deg=pose.latitude_deg, longitude_deg=pose.longitude_deg, height_m=pose.height_m
    )
    outer_from_here = outer.enu_from(here)
    turned = quaternion_from_matrix(outer_from_here.rotation @ pose.true_enu_from_body)
    translation = ", ".join(f"{v:.4f}" for v in outer_from_here.translation)
    rotation = ", ".join(f"{v:.9f}" for v in turned)
    return {
        "authority": _AUTHORITY,
        "id": "RotateTranslate",
        "parameters": f"translation=[{translation}]&rotation=[{rotation}]",
    }


def _time(shot: Shot) -> int:
    if shot.unix_ms is None:
        raise ValueError(f"{shot.name}: expected a time with its zone, found {shot.capture_time}")
    return shot.unix_ms


def _file_names(shots: Sequence[Shot]) -> list[str]:
    counts = Counter(shot.name for shot in shots)
    return [
        folder_name(shot.name if counts[shot.name] == 1 else f"{shot.number}_{shot.name}") + ".json"
        for shot in shots
    ]


def _write(path: Path, document: dict[str, Any]) -> None:
    path.write_text(
        json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )
