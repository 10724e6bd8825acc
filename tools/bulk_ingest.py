"""A long flight over a simulated town: its cost beside that of its first part, and how right its maps are.

The town has houses that look alike, and positions are a receiver's. Each ingest is a process of its own with
two workers, in the pool or on Dask; processor time and the largest process are those of all that it started.
Of the verified pairs it prints how many are wrong, and which are left out (`tools.far_pairs`).
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import WorldOptions, read_truth, write_world
from tools.commands import all_maps, cost_of, once
from tools.far_pairs import FEATURES, against_truth, verified_pairs
from tools.figures import laid_apart, median, say, study_parser, write_figures
from tools.photo_files import copied

_A_LINE, _FIRST_LINES = 40, 5
_METRES_A_LINE = 22.4
_WIDTH_PX = 900
_APART_M = 80.0  # from 45 m above ground a picture shows 75 m from corner to corner
_WRONG_M = 5.0  # of a camera, after the map was laid on the truth
_ON_DASK = """
import sys
import distributed
from featuredb.cli.main import main
with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
    code = main([*sys.argv[1:], "--dask", cluster.scheduler_address])
sys.exit(code)
"""


def main() -> None:
    parser = study_parser(__doc__, "--work", "--seed")
    parser.add_argument("--lines", type=int, default=25, help=f"of {_A_LINE} photos; default: 25")
    parser.add_argument("--dask", action="store_true", help="two workers of Dask instead of the pool")
    args = parser.parse_args()
    side = _METRES_A_LINE * args.lines
    flight = FlightOptions(lines=args.lines, per_line=_A_LINE, oblique=0, height_m=45.0, width=_WIDTH_PX)
    none = {"queries": 0, "street": 0, "negatives_per_kind": 0}
    options = WorldOptions(seed=args.seed, town_size_m=(side, side), flight=flight, **none)
    world = once(args.work / "world", lambda folder: write_world(folder, options))
    photos = sorted((world / "drone").iterdir())
    names = [photo.name for photo in photos[: _FIRST_LINES * _A_LINE]]
    first = copied(world / "drone", names, args.work / "first", strip=False)
    part, whole = (_ingested(args.work, folder, args.dask) for folder in (first, world / "drone"))
    true = {Path(i.name).name: i.cam_from_local.center for i in read_truth(world).group("drone")}
    figures = whole | _against(true, all_maps(args.work / "drone.db"))
    usable, inliers = verified_pairs(world / "drone", args.work / "drone.db" / "_work")
    plan = np.array([true[photo.name][:2] for photo in usable])
    figures |= against_truth(usable, inliers, plan, _APART_M)
    figures |= {"first_s": part["a_photo_s"], "ratio": whole["a_photo_s"] / part["a_photo_s"]}
    figures |= {"photos": len(photos), "share": figures["placed"] / len(photos)}
    write_figures(args.json, figures)


def _ingested(work: Path, folder: Path, dask: bool) -> dict[str, float]:
    """Processor seconds a photo, and megabytes of the largest process."""
    database = work / f"{folder.name}.db"
    shutil.rmtree(database, ignore_errors=True)
    command, where = (("-c", _ON_DASK), ()) if dask else (("-m", "featuredb.cli"), ("--workers", "2"))
    words = ("ingest", "photos", str(database), str(folder), "--max-features", str(FEATURES), "--quiet")
    cost = cost_of(*command, *words, *where)
    say(cost.told)
    return {"a_photo_s": cost.seconds / len(list(folder.iterdir())), "largest_mb": cost.largest_mb}


def _against(true: Mapping[str, FloatArray], maps: Sequence[Any]) -> dict[str, float]:
    """Maps, photos in those with a place, and how far their cameras are from true centres (3,) by name of the
    photo, after a similarity."""
    placed = [one for one in maps if isinstance(one, FeatureMap)]
    errors: list[float] = []
    for one in placed:
        centers = {Path(image.name).name: image.cam_from_local.center for image in one.images}
        errors += [error for error in laid_apart(centers, true) if np.isfinite(error)]
    return {
        "maps": len(maps),
        "placed": len(errors),
        "wrong": sum(error > _WRONG_M for error in errors),
        "median_m": median(errors),
        "largest_m": max(errors, default=float("nan")),
    }


if __name__ == "__main__":
    main()
