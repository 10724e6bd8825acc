"""A film without positions, found within 250 m on a scan that has intensities alone: how often, how right?

    python -m tools.film_near --work DIR [--inputs FOLDER]

The film `smooth` of `tools.track_evaluation`, without its telemetry, becomes a map without a place. Each draw
names a point 100 m from the middle of the town's scan in a random direction, and `featuredb anchor --near`
places a copy of the map; then the same on the scan of another town, where nothing may be placed. A placed
map is wrong where a camera is a metre off.
"""

import shutil
from functools import partial
from pathlib import Path

import numpy as np

from featuredb.store import Database
from ingest.workspace import default_root
from tools.commands import anchor, featuredb, newest_copy
from tools.figures import study_parser, write_figures
from tools.made_maps import make
from tools.track_evaluation import film_options
from tools.unplaced_brighton import all_drawn
from tools.unplaced_near import near_words
from tools.video_map import keyframe_errors
from tools.worlds.film_world import FILM_FILE, FilmTruth, read_film_truth, write_film
from tools.worlds.scan_world import make_scan_world

_FRAMES, _DRAWS, _WRONG_M = 1200, 10, 1.0


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    inputs, work = args.inputs or args.work, args.work
    world = make_scan_world(inputs)
    folder = write_film(inputs / f"film-smooth-{_FRAMES}-1", film_options("smooth", _FRAMES))
    truth = read_film_truth(folder)
    if not (work / "db").exists():
        work.mkdir(parents=True, exist_ok=True)
        make(work / "making", "video", Path(shutil.copy(folder / FILM_FILE, work)))  # with nothing beside it
        (work / "making").rename(work / "db")
    figures: dict[str, float] = {"draws": _DRAWS}
    for kind, scan in (("here", world.scan), ("elsewhere", world.other_scan)):
        database = work / kind
        if not database.exists():
            newest_copy(work / "db", work / "scanned")
            featuredb("lidar", "add", str(work / "scanned"), str(scan), "--quiet")
            (work / "scanned").rename(database)
        placed = all_drawn(kind, _DRAWS, partial(_draw, made=database, work=work, truth=truth), work)
        figures |= {
            f"{kind}_placed": len(placed),
            f"{kind}_wrong": sum(one["largest_m"] > _WRONG_M for one in placed),
            f"{kind}_m": float(np.median([one["median_m"] for one in placed] or [np.nan])),
        }
    write_figures(args.json, figures)


def _draw(number: int, made: Path, work: Path, truth: FilmTruth) -> dict[str, float] | None:
    database = newest_copy(made, work / "placed")
    biggest = max(Database.open(database).snapshot().unplaced_maps(), key=lambda one: one.images)
    (stills,) = (default_root(Database.open(work / "db").url) / "films").iterdir()
    near = near_words(database, number)
    if not anchor(database, biggest.map_id, stills, work / "anchor", near, refusals=(1, 2)):
        return None
    off = keyframe_errors(Database.open(database).snapshot().load_map(biggest.map_id), truth)
    return {"median_m": float(np.median(off)), "largest_m": float(off.max())}


if __name__ == "__main__":
    main()
