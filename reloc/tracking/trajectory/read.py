"""Trajectories back from the CSV that `write_trajectory` writes."""

import csv
from itertools import pairwise
from pathlib import Path
from typing import get_args

import numpy as np

from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.files import CSV_COLUMNS, OWN_CSV_COLUMNS
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from reloc.wire.track import TrackState

_UPPER = np.triu_indices(6)
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
    covariance[_UPPER] = [float(cells[name]) for name in _COVARIANCE]
    return EarthPose(
        epsg=epsg,
        utm=utm,
        height_datum=cells["height_datum"],
        cam_from_utm_xyzw=turn,
        geopose=geopose_from_camera(Rigid3(rotation=rotation, translation=np.zeros(3)), frame),
        covariance=covariance + np.triu(covariance, 1).T,
        map_id=cells["map_id"],
    )
