"""The simulated world end to end: photos, scan, anchoring without a person, queries against the truth.

    python -m tools.anchor_simworld --work DIR [--inputs DIR]

1. `featuredb simworld --lidar` writes photos whose GPS has a drone's errors, an airborne scan with
   intensities only, an ortho image of another day, and the same of another town at the same place.
2. `featuredb ingest photos` places the map by GPS; `featuredb lidar add` adds the scan.
3. `featuredb anchor --auto` places the map on the scan of the other town, which it must refuse, and then on
   its own.
4. The map's cameras and the held-out queries are compared with the truth, before and after.
"""

from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.world import Truth, World
from featuredb.store import Database
from tools.commands import anchor, featuredb, first_map, newest_copy, once
from tools.figures import pose_errors, poses_in, study_parser, write_figures
from tools.real_photos import ask_poses, error_figures
from tools.worlds.scan_world import ScanWorld, make_scan_world


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    work, world = args.work, make_scan_world(args.inputs)
    refused = anchored(work, world, other=True)[1]
    database, placed = anchored(work, world, other=False)
    figures: dict[str, float] = {"placed": int(placed), "other_placed": int(refused)}
    for name, path in (("gps", work / "mapped"), ("scan", database)):
        found = judged(Database.open(path), world.world)
        figures |= {f"{name}_{key}": value for key, value in found.items()}
    write_figures(args.json, figures)


def anchored(work: Path, world: ScanWorld, *, other: bool) -> tuple[Path, bool]:
    """A copy of the photos' database with one of the scans, anchored; and whether the map was placed."""
    photos = str(world.world.folder / "drone")
    mapped = once(work / "mapped", lambda path: featuredb("ingest", "photos", str(path), photos, "--quiet"))
    database = newest_copy(mapped, work / f"anchored-{'other' if other else 'own'}-intensity")
    featuredb("lidar", "add", str(database), str(world.other_scan if other else world.scan))
    map_id = first_map(Database.open(database)).map_id
    report = work / f"{database.name}-report"
    return database, anchor(database, map_id, world.world.folder / "drone", report)


def judged(database: Database, world: World) -> dict[str, float]:
    """Errors of the map's cameras and of what is answered to queries."""
    metres, degrees = camera_errors(first_map(database), world.truth)
    poses = {image.name: image.cam_from_local for image in world.truth.group("queries")}
    answers = error_figures(ask_poses(database, world.folder, list(poses), world.truth.frame, poses))
    return {
        "cameras_m": float(np.median(metres)),
        "cameras_deg": float(np.median(degrees)),
        "queries": answers["asked"],
        "answered": answers["answered"],
        "queries_m": answers["median_m"],
        "queries_largest_m": answers["largest_m"],
    }


def camera_errors(feature_map: FeatureMap, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees between the map's images and the truth."""
    true = {Path(image.name).name: image.cam_from_local for image in truth.group("drone")}
    return pose_errors(poses_in(truth.frame, feature_map), true)


if __name__ == "__main__":
    main()
