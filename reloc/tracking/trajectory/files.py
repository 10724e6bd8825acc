"""A trajectory as files: CSV, TUM, GeoJSON, KML, or OGC GeoPose series, as the suffix says.

Frames whose track is lost are rows without a pose in CSV, and gaps in all others. One in the own frame of a
map without a place is CSV only, with columns of other names, so that nobody takes it for one on Earth.
"""

import csv
import io
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args
from xml.sax.saxutils import escape

import numpy as np

from featuredb.atomic import atomic_file, check_output
from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.geo.geopose import geopose_from_camera, irregular_series
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, quaternion_from_matrix
from reloc.localise.result import OwnPose
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from reloc.wire.track import TrackState

# Exit codes: no frame was localised; a file could not be written, or the server was lost; stopped by hand.
_NOTHING_FOUND, _FAILED, _STOPPED = 1, 2, 130
_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]


def _covariance_columns(prefix: str, axes: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{prefix}_{axes[i]}_{axes[j]}" for i, j in _UPPER)


_POSE = (
    *("easting", "northing", "height", "qx", "qy", "qz", "qw", "latitude", "longitude"),
    *("heading_deg", "pitch_deg", "roll_deg", "epsg", "height_datum", "map_id"),
    *_covariance_columns("cov", ("re", "rn", "ru", "e", "n", "u")),
)
_OWN_POSE = (
    *("own_x", "own_y", "own_z", "own_qx", "own_qy", "own_qz", "own_qw"),
    *("own_unit", "own_z_is_up", "unplaced_map"),
    *_covariance_columns("own_cov", ("rx", "ry", "rz", "x", "y", "z")),
)
CSV_COLUMNS, OWN_CSV_COLUMNS = (
    ("frame", "time_s", "state", "inliers", *pose, "detail") for pose in (_POSE, _OWN_POSE)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outputs:
    """What became of the files: names of those that were written, and why others were not."""

    written: tuple[str, ...]
    failed: tuple[str, ...]


def check_outputs(files: Sequence[Path], *sources: str | Path | None) -> None:
    """Before an hour of tracking, not after it.

    Raises:
        InvalidValueError: a suffix that stands for no format; or as `check_output`.
    """
    for file in files:
        format_of(file)
        check_output("--out", file, *sources)


def write_outputs(files: Sequence[Path], trajectory: Trajectory) -> Outputs:
    """Write all that can be written; without any pose only tables."""
    known = any(point.found for point in trajectory.points)
    written, failed = [], []
    for file in files:
        if not known and file.suffix.lower() != ".csv":
            continue
        try:
            write_trajectory(file, trajectory)
            written.append(str(file))
        except (FeatureDbError, OSError) as error:
            failed.append(f"{file}: {getattr(error, 'strerror', None) or error}")
    return Outputs(written=tuple(written), failed=tuple(failed))


def exit_code(outputs: Outputs, trajectory: Trajectory, *, stopped: bool = False, lost: str = "") -> int:
    """0, 1 where no frame was localised, 2 where something failed, 130 where a film was stopped; stderr says.

    Args:
        stopped: a film ended by hand before its end. lost: why a server did not go on to the end.
    """
    part = "what was written is a part of the film, up to there"
    for text in (*outputs.failed, *([f"{lost}; {part}"] if lost else [])):
        sys.stderr.write(f"featuredb: {text}\n")
    if stopped:
        sys.stderr.write(f"featuredb: stopped by hand; {part}\n")
    if outputs.failed or lost:
        return _FAILED
    if stopped:
        return _STOPPED
    return 0 if any(point.found for point in trajectory.points) else _NOTHING_FOUND


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, whole or not at all.

    Raises:
        InvalidValueError: see `format_of`; or no frame has a pose and the format holds nothing else.
    """
    own = next((point.in_map.map_id for point in trajectory.points if point.in_map is not None), None)
    text = format_of(path, own)(trajectory)
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def format_of(path: Path, own_map: str | None = None) -> Callable[[Trajectory], str]:
    """What makes the text of a file with this suffix; `own_map`: id of the map in whose own frame poses are.

    Raises:
        InvalidValueError: there is no such format.
    """
    suffix, formats = path.suffix.lower(), _FORMATS if own_map is None else {".csv": own_csv_text}
    if suffix in formats:
        return formats[suffix]
    if own_map is None:
        raise InvalidValueError(
            f"{path.name}: expected a name that ends in {', '.join(formats)}, found {path.suffix!r}"
        )
    raise InvalidValueError(
        f"{path.name}: needs places on Earth, and map {own_map} has none: expected .csv, with "
        "poses in the map's own frame; or place the map first: `featuredb maps` says how"
    )


def csv_text(trajectory: Trajectory) -> str:
    """One row a frame.

    Angles are heading clockwise from true north, pitch upwards, roll to the right; qx .. qw turn grid axes
    into camera axes (x right, y down, z forward); cov_* is the covariance, rad and m, axes true east, north,
    up: rotation (re, rn, ru) before displacement (e, n, u).
    """
    return _csv_table(
        CSV_COLUMNS, trajectory, lambda point: None if point.pose is None else _cells(point.pose)
    )


def own_csv_text(trajectory: Trajectory) -> str:
    """One row a frame.

    own_x .. own_z is the camera centre in the map's own frame, in own_unit (metre, or map_unit where nothing
    tells the scale); own_qx .. own_qw turn the frame's axes into camera axes (x right, y down, z forward);
    own_cov_* is the covariance, axes of the frame: rotation (rx, ry, rz) in rad before displacement.
    """
    return _csv_table(
        OWN_CSV_COLUMNS, trajectory, lambda point: None if point.in_map is None else _own_cells(point.in_map)
    )


def _csv_table(
    columns: tuple[str, ...],
    trajectory: Trajectory,
    cells: Callable[[TrajectoryPoint], Sequence[object] | None],
) -> str:
    """One row a frame; `cells`: those of its pose, None where it has none."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(columns)
    for point in trajectory.points:
        head = (point.index, f"{point.time_s:.6f}", point.state, point.inliers)
        rows.writerow((*head, *(cells(point) or [""] * (len(columns) - 5)), point.detail))
    return out.getvalue()


def _cells(pose: EarthPose) -> list[object]:
    return [
        *(f"{v:.4f}" for v in pose.utm),
        *(f"{q:.9f}" for q in pose.cam_from_utm_xyzw),
        *(f"{pose.geopose.latitude_deg:.10f}", f"{pose.geopose.longitude_deg:.10f}"),
        *(f"{a:.5f}" for a in pose.geopose.heading_pitch_roll_deg),
        *(pose.epsg, pose.height_datum, pose.map_id),
        *(f"{pose.covariance[i, j]:.6e}" for i, j in _UPPER),
    ]


def _own_cells(pose: OwnPose) -> list[str]:
    return [
        *(f"{v:.9g}" for v in pose.cam_from_map.center),
        *(f"{q:.9f}" for q in quaternion_from_matrix(pose.cam_from_map.rotation)),
        *("metre" if pose.frame.metric else "map_unit", str(pose.frame.upright).lower(), pose.map_id),
        *(f"{pose.covariance[i, j]:.6e}" for i, j in _UPPER),
    ]


def tum_text(trajectory: Trajectory) -> str:
    """TUM's format for evo and its like: time x y z qx qy qz qw, world from camera, world is the UTM grid."""
    found = _known(trajectory, "TUM")
    zones = {pose.epsg for _, pose in found}
    if len(zones) > 1:
        raise InvalidValueError(
            f"{trajectory.source}: TUM files have one grid, and the track crosses from EPSG:{min(zones)} to "
            f"EPSG:{max(zones)}; write CSV"
        )
    lines = [f"# EPSG:{found[0][1].epsg}, heights {found[0][1].height_datum}; time tx ty tz qx qy qz qw"]
    for point, pose in found:
        x, y, z, w = pose.cam_from_utm_xyzw
        place = " ".join(f"{v:.4f}" for v in pose.utm)
        lines.append(f"{point.time_s:.6f} {place} {-x:.9f} {-y:.9f} {-z:.9f} {w:.9f}")
    return "\n".join(lines) + "\n"


def geojson_text(trajectory: Trajectory) -> str:
    """RFC 7946: a line for each stretch without loss, and a point for each frame.

    Heights are those of the maps, in their datum, which is among the properties.
    """
    _known(trajectory, "GeoJSON", datums=True)
    features = []
    for number, stretch in enumerate(trajectory.stretches()):
        if len(stretch) > 1:
            said = {"stretch": number, "from_s": stretch[0][0].time_s, "to_s": stretch[-1][0].time_s}
            line = [_place(pose) for _, pose in stretch]
            features.append(_feature("LineString", line, {**said, "source": trajectory.source}))
        for point, pose in stretch:
            heading, pitch, roll = pose.geopose.heading_pitch_roll_deg
            sigma = np.sqrt(np.diag(pose.covariance)[3:])
            properties = {
                "frame": point.index,
                "time_s": round(point.time_s, 6),
                "state": point.state,
                "heading_deg": round(heading, 4),
                "pitch_deg": round(pitch, 4),
                "roll_deg": round(roll, 4),
                "sigma_enu_m": [round(float(v), 4) for v in sigma],
                "height_datum": pose.height_datum,
                "map_id": pose.map_id,
                "geopose": pose.geopose.to_json(),
            }
            features.append(_feature("Point", _place(pose), properties))
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def kml_text(trajectory: Trajectory) -> str:
    """A line for each stretch without loss, for Google Earth and the like; heights as the maps have them."""
    found = _known(trajectory, "KML")
    marks = []
    for number, stretch in enumerate(trajectory.stretches()):
        places = " ".join(",".join(f"{v:.10g}" for v in _place(pose)) for _, pose in stretch)
        name = f"{stretch[0][0].time_s:.2f} s to {stretch[-1][0].time_s:.2f} s"
        marks.append(
            f'<Placemark id="stretch{number}"><name>{name}</name><LineString>'
            f"<altitudeMode>absolute</altitudeMode><coordinates>{places}</coordinates></LineString></Placemark>"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"<name>{escape(trajectory.source)}</name><description>heights: {found[0][1].height_datum}"
        "</description>\n" + "\n".join(marks) + "\n</Document></kml>\n"
    )


def geopose_text(trajectory: Trajectory) -> str:
    """OGC GeoPose 1.0, Irregular Series; the outer frame is east-north-up at the first pose.

    Translations are metres, rotations are quaternions x, y, z, w of the body (x forward, y left, z up). Times
    are Unix milliseconds, or since the film's start where that is not known.
    """
    found = _known(trajectory, "GeoPose")
    start_ms = 0.0 if trajectory.start is None else 1000.0 * trajectory.start.timestamp()
    poses = [(round(start_ms + 1000.0 * point.time_s), pose.geopose) for point, pose in found]
    return json.dumps(irregular_series(poses), indent=1) + "\n"


_FORMATS: dict[str, Callable[[Trajectory], str]] = {
    ".csv": csv_text,
    ".tum": tum_text,
    ".geojson": geojson_text,
    ".kml": kml_text,
    ".json": geopose_text,
}


def _known(
    trajectory: Trajectory, what: str, *, datums: bool = False
) -> Sequence[tuple[TrajectoryPoint, EarthPose]]:
    """The frames with poses; `datums`: whether the format can have heights of several."""
    found = [(p, p.pose) for p in trajectory.points if p.pose is not None]
    if not found:
        reasons = {p.detail for p in trajectory.points if p.detail}
        raise InvalidValueError(
            f"{trajectory.source}: no frame has a pose, a {what} file would be empty"
            + (f" ({sorted(reasons)[0]})" if reasons else "")
        )
    several = sorted({pose.height_datum for _, pose in found})
    if len(several) > 1 and not datums:
        raise InvalidValueError(
            f"{trajectory.source}: the track crosses from maps with heights {several[0]} to {several[1]}, "
            "which this format cannot say; write CSV or GeoJSON, or name maps of one datum"
        )
    return found


def _place(pose: EarthPose) -> list[float]:
    longitude, latitude = pose.geopose.longitude_deg, pose.geopose.latitude_deg
    return [round(longitude, 10), round(latitude, 10), round(float(pose.utm[2]), 4)]


_COVARIANCE = tuple(name for name in CSV_COLUMNS if name.startswith("cov_"))


def read_trajectory_csv(path: Path) -> Trajectory:
    """The frames of a file of `featuredb track --out NAME.csv`; its name is the trajectory's source.

    Raises:
        InvalidValueError: no such file, no such table, or a row that cannot be; with the line.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file, strict=True)
            missing = [name for name in CSV_COLUMNS if name not in (rows.fieldnames or ())]
            if OWN_CSV_COLUMNS[4] in (rows.fieldnames or ()):
                raise InvalidValueError(
                    f"{path}: expected a track on Earth, found one in the own frame of a map without a "
                    "place; track the film again once the map is placed"
                )
            if missing:
                raise InvalidValueError(
                    f"{path}: expected the columns of `featuredb track --out NAME.csv`, found none called "
                    f"{', '.join(missing[:3])}"
                )
            points = tuple(_point(path, rows.line_num, row) for row in rows)
    except OSError as error:
        raise InvalidValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise InvalidValueError(f"{path}: expected a table in CSV: {error}") from error
    if not points:
        raise InvalidValueError(f"{path}: expected a row for each frame, found none")
    if any(b.time_s < a.time_s for a, b in pairwise(points)):
        raise InvalidValueError(f"{path}: expected frames in the order of their times")
    return Trajectory(source=path.name, points=points)


def _point(path: Path, line: int, row: dict[str, str | None]) -> TrajectoryPoint:
    try:
        cells = {name: row[name] or "" for name in CSV_COLUMNS}
        state = next((s for s in get_args(TrackState) if s == cells["state"]), None)
        if state is None:
            raise ValueError(f"state {cells['state']!r}")
        time_s = float(cells["time_s"])
        if not np.isfinite(time_s):
            raise ValueError(f"time_s {cells['time_s']!r}")
        return TrajectoryPoint(
            index=int(cells["frame"]),
            time_s=time_s,
            state=state,
            pose=_pose(cells) if cells["easting"] else None,
            inliers=int(cells["inliers"]),
            detail=cells["detail"],
        )
    except (ValueError, FeatureDbError) as error:
        raise InvalidValueError(f"{path}, line {line}: not a frame of a track: {error}") from error


def _pose(cells: dict[str, str]) -> EarthPose:
    epsg = int(cells["epsg"])
    utm = np.array([float(cells[name]) for name in ("easting", "northing", "height")])
    turn = np.array([float(cells[name]) for name in ("qx", "qy", "qz", "qw")])
    if not 0.999 < np.linalg.norm(turn) < 1.001:
        raise ValueError("a quaternion of unit length is expected")
    frame = LocalFrame.from_utm(float(utm[0]), float(utm[1]), float(utm[2]), epsg)
    rotation = matrix_from_quaternion(turn / np.linalg.norm(turn)) @ frame.grid_from_enu(np.zeros(3), epsg)
    covariance = np.zeros((6, 6))
    for (i, j), name in zip(_UPPER, _COVARIANCE, strict=True):
        covariance[i, j] = covariance[j, i] = float(cells[name])
    return EarthPose(
        epsg=epsg,
        utm=utm,
        height_datum=cells["height_datum"],
        cam_from_utm_xyzw=turn,
        geopose=geopose_from_camera(Rigid3(rotation=rotation, translation=np.zeros(3)), frame),
        covariance=covariance,
        map_id=cells["map_id"],
    )
