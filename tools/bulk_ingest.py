"""A long flight over a simulated town: its cost beside that of its first part, and how right its maps are.

    python -m tools.bulk_ingest --work FOLDER [--seed N] [--json FILE]

The town has houses that look alike, and positions are a receiver's. Each ingest is a process of its own with
two workers; processor time and the largest process are those of all that it started.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.world import Truth, WorldOptions, read_truth, write_world
from tools.commands import all_maps, copied, once, processor_s
from tools.figures import laid_apart, median, say, study_parser, write_figures

_LINES, _A_LINE, _FIRST_LINES = 25, 40, 5
_METRES_A_LINE = 22.4
_WIDTH_PX, _FEATURES = 900, 3000
_WRONG_M = 5.0  # of a camera, after the map was laid on the truth


def main() -> None:
    args = study_parser(__doc__, "--work", "--seed").parse_args()
    side = _METRES_A_LINE * _LINES
    flight = FlightOptions(lines=_LINES, per_line=_A_LINE, oblique=0, height_m=45.0, width=_WIDTH_PX)
    none = {"queries": 0, "street": 0, "negatives_per_kind": 0}
    options = WorldOptions(seed=args.seed, town_size_m=(side, side), flight=flight, **none)
    world = once(args.work / "world", lambda folder: write_world(folder, options))
    photos = sorted((world / "drone").iterdir())
    names = [photo.name for photo in photos[: _FIRST_LINES * _A_LINE]]
    first = copied(world / "drone", names, args.work / "first", strip=False)
    part, whole = (_ingested(args.work, folder) for folder in (first, world / "drone"))
    figures = whole | _against(read_truth(world), all_maps(args.work / "drone.db"))
    figures |= {"first_s": part["a_photo_s"], "ratio": whole["a_photo_s"] / part["a_photo_s"]}
    figures |= {"photos": len(photos), "share": figures["placed"] / len(photos)}
    write_figures(args.json, figures)


def _ingested(work: Path, folder: Path) -> dict[str, float]:
    """Processor seconds a photo, and megabytes of the largest process so far."""
    database = work / f"{folder.name}.db"
    shutil.rmtree(database, ignore_errors=True)
    words = ("-m", "featuredb.cli", "ingest", "photos", str(database), str(folder), "--quiet")
    seconds, largest_mb, told = processor_s(*words, "--max-features", str(_FEATURES), "--workers", "2")
    say(told)
    return {"a_photo_s": seconds / len(list(folder.iterdir())), "largest_mb": largest_mb}


def _against(truth: Truth, maps: Sequence[Any]) -> dict[str, float]:
    """Maps, photos in those with a place, and how far their cameras are off after a similarity."""
    true = {Path(image.name).name: image.cam_from_local.center for image in truth.group("drone")}
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
