"""A trajectory in the own frame of a map without a place, as CSV.

Its columns are called otherwise than those of tracks on Earth, so that nobody takes it for one.
"""

import csv
import io
from collections.abc import Callable, Sequence

from featuredb.geometry.rotation import quaternion_from_matrix
from reloc.localise.result import OwnPose
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint

_AXES = ("rx", "ry", "rz", "x", "y", "z")
UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
_POSE = (
    *("own_x", "own_y", "own_z", "own_qx", "own_qy", "own_qz", "own_qw"),
    *("own_unit", "own_z_is_up", "unplaced_map"),
    *(f"own_cov_{_AXES[i]}_{_AXES[j]}" for i, j in UPPER),
)


def columns_of(pose: Sequence[str]) -> tuple[str, ...]:
    """Those of a table of frames whose poses have these."""
    return ("frame", "time_s", "state", "inliers", *pose, "detail")


OWN_CSV_COLUMNS = columns_of(_POSE)


def csv_table(
    pose: Sequence[str], trajectory: Trajectory, cells: Callable[[TrajectoryPoint], Sequence[object] | None]
) -> str:
    """One row a frame; `cells`: those of its pose, in the columns `pose`, None where it has none."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(columns_of(pose))
    for point in trajectory.points:
        own = cells(point) or [""] * len(pose)
        rows.writerow((point.index, f"{point.time_s:.6f}", point.state, point.inliers, *own, point.detail))
    return out.getvalue()


def own_csv_text(trajectory: Trajectory) -> str:
    """One row a frame.

    own_x .. own_z is the camera centre in the map's own frame, in own_unit (metre, or map_unit where nothing
    tells the scale); own_qx .. own_qw turn the frame's axes into camera axes (x right, y down, z forward);
    own_cov_* is the covariance, axes of the frame: rotation (rx, ry, rz) in rad before displacement.
    """
    return csv_table(_POSE, trajectory, lambda point: None if point.in_map is None else _cells(point.in_map))


def _cells(pose: OwnPose) -> list[str]:
    return [
        *(f"{v:.9g}" for v in pose.cam_from_map.center),
        *(f"{q:.9f}" for q in quaternion_from_matrix(pose.cam_from_map.rotation)),
        *(_unit(pose), str(pose.frame.upright).lower(), pose.map_id),
        *(f"{pose.covariance[i, j]:.6e}" for i, j in UPPER),
    ]


def _unit(pose: OwnPose) -> str:
    return "metre" if pose.frame.metric else "map_unit"
