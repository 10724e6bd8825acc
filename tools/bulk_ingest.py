"""A long flight over a simulated town: its cost beside that of its first part, and how right its maps are.

    python -m tools.bulk_ingest --work FOLDER [--lines N] [--seed N] [--dask] [--json FILE]

The town has houses that look alike, and positions are a receiver's. Each ingest is a process of its own with
two workers, in the pool or on Dask; processor time and the largest process are those of all that it started.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import TRUTH_FILE, Truth, WorldOptions, read_truth, write_world
from tools.commands import all_maps, processor_s
from tools.figures import laid_on, median, say, study_parser, write_figures

_A_LINE, _FIRST_LINES = 40, 5
_METRES_A_LINE = 22.4
_WIDTH_PX, _FEATURES = 900, 3000
_WRONG_M = 5.0  # of a camera, after the map was laid on the truth
_ON_DASK = """
import sys
import distributed
from featuredb.cli.main import main
with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
    sys.exit(main([*sys.argv[1:], "--dask", cluster.scheduler_address]))
"""


def main() -> None:
    parser = study_parser(__doc__, "--work", "--seed")
    parser.add_argument("--lines", type=int, default=25, help=f"of {_A_LINE} photos; default: 25")
    parser.add_argument("--dask", action="store_true", help="two workers of Dask instead of the pool")
    args = parser.parse_args()
    world = args.work / "world"
    if not (world / TRUTH_FILE).is_file():
        write_world(world, _world(args.seed, args.lines))
    photos = sorted((world / "drone").iterdir())
    first = args.work / "first"
    shutil.rmtree(first, ignore_errors=True)
    first.mkdir()
    for photo in photos[: _FIRST_LINES * _A_LINE]:
        shutil.copy(photo, first)
    part, whole = (_ingested(args.work, folder, args.dask) for folder in (first, world / "drone"))
    figures = whole | _against(read_truth(world), all_maps(args.work / "drone.db"))
    figures |= {"first_s": part["a_photo_s"], "ratio": whole["a_photo_s"] / part["a_photo_s"]}
    figures |= {"photos": len(photos), "share": figures["placed"] / len(photos)}
    write_figures(args.json, figures)


def _world(seed: int, lines: int) -> WorldOptions:
    side = _METRES_A_LINE * lines
    flight = FlightOptions(lines=lines, per_line=_A_LINE, oblique=0, height_m=45.0, width=_WIDTH_PX)
    return WorldOptions(
        seed=seed, town_size_m=(side, side), flight=flight, queries=0, street=0, negatives_per_kind=0
    )


def _ingested(work: Path, folder: Path, dask: bool) -> dict[str, float]:
    """Processor seconds a photo, and megabytes of the largest process so far."""
    database = work / f"{folder.name}.db"
    shutil.rmtree(database, ignore_errors=True)
    command = ["-c", _ON_DASK] if dask else ["-m", "featuredb.cli"]
    words = ["ingest", "photos", str(database), str(folder), "--max-features", str(_FEATURES), "--quiet"]
    seconds, largest_mb, told = processor_s(*command, *words, *([] if dask else ["--workers", "2"]))
    say(told)
    return {"a_photo_s": seconds / len(list(folder.iterdir())), "largest_mb": largest_mb}


def _against(truth: Truth, maps: Sequence[Any]) -> dict[str, float]:
    """Maps, photos in those with a place, and how far their cameras are off after a similarity."""
    true = {Path(image.name).name: image.cam_from_local.center for image in truth.group("drone")}
    placed = [one for one in maps if isinstance(one, FeatureMap)]
    errors: list[float] = []
    for one in placed:
        centers = {Path(image.name).name: image.cam_from_local.center for image in one.images}
        onto = laid_on(centers, true)
        errors += [float(np.linalg.norm(onto.act(c) - true[n])) for n, c in centers.items()] if onto else []
    return {
        "maps": len(maps),
        "placed": len(errors),
        "wrong": sum(error > _WRONG_M for error in errors),
        "median_m": median(errors),
        "largest_m": max(errors, default=float("nan")),
    }


if __name__ == "__main__":
    main()
