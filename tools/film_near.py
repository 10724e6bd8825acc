"""A film without positions, found within 250 m on a scan that has intensities alone: how often, how right?

The film `smooth` of `tools.track_evaluation`, without its telemetry, becomes a map without a place. Each draw
names a point 100 m from the middle of the town's scan in a random direction, and `featuredb anchor --near`
places a copy of the map; then the same on the scan of another town, where nothing may be placed. A placed
map is wrong where a camera is a metre off.
"""

from functools import partial
from pathlib import Path

from featuredb.store import Database
from tools.commands import anchor, largest_map, make, newest_copy, once, with_scan
from tools.figures import median, pose_errors, poses_in, spread, study_parser, write_figures
from tools.paper import frame_of, stills_of
from tools.track_evaluation import FRAMES, drawn_film
from tools.unplaced_brighton import all_drawn, near_words
from tools.worlds.film_world import FilmTruth
from tools.worlds.scan_world import make_scan_world

_DRAWS, _WRONG_M = 10, 1.0


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    inputs, work = args.inputs, args.work
    world = make_scan_world(inputs)
    film, truth = drawn_film("smooth", FRAMES, inputs)
    made = once(work / "db", lambda path: make(path, "video", film, ("--no-telemetry",)))
    figures: dict[str, float] = {"draws": _DRAWS}
    for kind, scan in (("here", world.scan), ("elsewhere", world.other_scan)):
        scanned = with_scan(made, scan, work / kind)
        placed = all_drawn(kind, _DRAWS, partial(_draw, made=scanned, work=work, truth=truth), work)
        figures |= {
            f"{kind}_placed": len(placed),
            f"{kind}_wrong": sum(one["largest_m"] > _WRONG_M for one in placed),
            f"{kind}_m": median([one["median_m"] for one in placed]),
        }
    write_figures(args.json, figures)


def _draw(number: int, made: Path, work: Path, truth: FilmTruth) -> dict[str, float] | None:
    database = newest_copy(made, work / "placed")
    map_id, near = largest_map(database).map_id, near_words(database, number)
    if not anchor(database, map_id, stills_of(made), work / "anchor", near, refusals=(1, 2)):
        return None
    poses = poses_in(truth.frame, Database.open(database).snapshot().load_map(map_id))
    off = pose_errors(poses, {name: truth.cam_from_local[frame_of(name)] for name in poses})[0]
    return spread(off)


if __name__ == "__main__":
    main()
