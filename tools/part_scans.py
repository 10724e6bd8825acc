"""A map anchored on parts of its scan: are its cameras inside the bounds that it states?

The photos become a map by their GPS. Copies of it are anchored (`featuredb anchor --auto`) on the whole scan,
on each half of it and on its middle; most photos look beyond the smaller ones. Cameras are compared with
poses that the whole scan alone gives (tools/scan_poses.py). Prints how many copies are placed, the median
error of a camera, how many are outside the 99.9 % bound of their map, and shares inside 68 and 95 %.
"""

from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from featuredb.store import Database
from tools.commands import anchor, featuredb, first_map, make, newest_copy
from tools.figures import bounds_figures, pose_errors, poses_in, spread, write_figures
from tools.laser_truth import camera_squares
from tools.scan_poses import scan_parser, scan_truth

# From and to, east and north, as shares of the scan's box.
_PARTS = {
    "whole": (0.0, 1.0, 0.0, 1.0),
    "west": (0.0, 0.5, 0.0, 1.0),
    "east": (0.5, 1.0, 0.0, 1.0),
    "south": (0.0, 1.0, 0.0, 0.5),
    "north": (0.0, 1.0, 0.5, 1.0),
    "middle": (0.3, 0.7, 0.3, 0.7),
}


def main() -> None:
    args = scan_parser(__doc__, "--work").parse_args()
    truth = scan_truth(args)
    make(args.work / "db", "photos", args.photos)
    scan = laspy.read(args.scan)
    errors: list[float] = []
    squares = []
    for name, part in _PARTS.items():
        database = newest_copy(args.work / "db", args.work / name)
        featuredb("lidar", "add", str(database), str(_cut(scan, part, args.work / f"{name}.laz")), "--quiet")
        map_id = first_map(Database.open(database)).map_id
        if anchor(database, map_id, args.photos, args.work / "anchor"):
            feature_map = first_map(Database.open(database))
            errors += pose_errors(poses_in(truth.frame, feature_map), truth.poses)[0].tolist()
            squares.append(camera_squares(feature_map, truth.frame, truth.poses))
    counts = {"parts": len(_PARTS), "placed": len(squares), "cameras": len(errors)}
    write_figures(args.json, counts | spread(errors) | bounds_figures(squares))


def _cut(scan: laspy.LasData, part: tuple[float, float, float, float], path: Path) -> Path:
    """A file of the points of a scan in a part of its box."""
    xy = np.asarray(scan.xyz)[:, :2]
    share = (xy - xy.min(axis=0)) / np.ptp(xy, axis=0)
    inside: NDArray[np.bool_] = ((share >= part[::2]) & (share <= part[1::2])).all(axis=1)
    scan[inside].write(path)
    return path


if __name__ == "__main__":
    main()
