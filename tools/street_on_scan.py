"""Maps of street photos placed on the scan of their town by its outlines: how many, how right?

Of each town, 60 photos by ten people, a third of them with geotags of 10 m (`tools.worlds.community`),
are ingested, and each map of ten photos and more is placed by `featuredb anchor --near --auto` on the town's
scan, what that leaves as a map without a place likewise; then the same on the scan of another town, where
nothing may be placed. What is found of a town is kept in DIR.
"""

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from featuredb.geometry.sim3 import place_covariance
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.world import Truth, read_truth
from featuredb.store import Database
from tools.commands import anchor, featuredb, make, newest_copy, once
from tools.figures import kept, spread, squared, study_parser, write_figures
from tools.worlds.album import TABLE_FILE, write_album
from tools.worlds.community import StreetOptions, street_album
from tools.worlds.scan_world import make_scan_world

_TOWNS = tuple(range(306, 316))
_LEAST_PHOTOS = 10
_RIGHT_M, _RIGHT_DEG, _OUTSIDE_M = 0.5, 0.5, 1.0
_BOUND = float(chi2.isf(1e-3, 3))
_RADIUS_M = 200.0


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    cv2.setNumThreads(1)
    inputs, work = args.inputs, args.work
    towns = [kept(work / f"town-{seed}.json", partial(_town, seed, inputs, work)) for seed in _TOWNS]
    here = [one for town in towns for one in town["here"]]
    off = np.array([of for one in here for of in one["off"]]).reshape(-1, 3)
    photos = sum(one["photos"] for one in here)
    right = int(((off[:, 0] <= _RIGHT_M) & (off[:, 1] <= _RIGHT_DEG)).sum())
    write_figures(
        args.json,
        {
            "maps": len(here),
            "photos": photos,
            "placed": len(off),
            "right_share": right / max(photos, 1),
            "outside": int((off[:, 2] > _OUTSIDE_M).sum()),
            **spread(off[:, 0]),
            "elsewhere": sum(len(town["elsewhere"]) for town in towns),
            "elsewhere_placed": sum(bool(one["off"]) for town in towns for one in town["elsewhere"]),
        },
    )


def _town(seed: int, inputs: Path, work: Path) -> dict[str, Any]:
    """What is found of one town."""
    world = make_scan_world(inputs, seed)
    options = StreetOptions(seed=seed)
    album = write_album(inputs / f"street-{seed}", options, partial(street_album, options))
    made = once(work / f"made-{seed}", lambda making: make(making, "photos", album / TABLE_FILE))
    return {
        kind: _placed(made, scan, album, work)
        for kind, scan in (("here", world.scan), ("elsewhere", world.other_scan))
    }


def _placed(made: Path, scan: Path, album: Path, work: Path) -> list[dict[str, Any]]:
    """Of each map of enough photos: how many these are, and how far off they are where they are placed."""
    database = newest_copy(made, work / "placed")
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    truth = read_truth(album)
    near = f"--near={truth.frame.latitude_deg!r},{truth.frame.longitude_deg!r},{_RADIUS_M!r}"
    found = []
    for one in Database.open(database).snapshot().unplaced_maps():
        if one.images < _LEAST_PHOTOS:
            continue
        off: list[tuple[float, float, float]] = []
        map_id, left = one.map_id, one.images
        while left >= _LEAST_PHOTOS:
            if not anchor(database, map_id, album, work / "anchor", near, refusals=(1, 2)):
                break
            snapshot = Database.open(database).snapshot()
            off += _off(snapshot.load_map(map_id), truth)
            rest = [m for m in snapshot.unplaced_maps() if m.map_id.startswith(f"{map_id}-")]
            map_id, left = (rest[0].map_id, rest[0].images) if rest else (map_id, 0)
        found.append({"photos": one.images, "off": off})
    return found


def _off(placed: FeatureMap, truth: Truth) -> list[tuple[float, float, float]]:
    """Of each photo: metres and degrees off, and by how many metres that is outside of its 99.9 %."""
    here = truth.frame.enu_from(placed.frame)
    found = []
    for image in placed.images:
        pose, true = image.cam_from_local, truth.images[image.name].cam_from_local @ here
        off = pose.center - true.center
        square = squared(off, place_covariance(placed.placement.covariance, pose.center))
        metres = float(np.linalg.norm(off))
        found.append(
            (metres, pose.angle_to_deg(true), metres * max(1.0 - float(np.sqrt(_BOUND / square)), 0.0))
        )
    return found


if __name__ == "__main__":
    main()
