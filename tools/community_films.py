"""A folder of films by strangers: maps of what shows the place, placed by one frame, every frame tracked.

    python -m tools.community_films --work DIR [--seed N]

1. Six simulated films without telemetry: three of one place (cuts, a title, black, a zoom, a logo, bars), one
   of another town, two of the place that are compressed badly, one of which shows the other town in between.
   They are drawn once and kept, with the truth of every frame in truth.json.
2. `featuredb init`, `featuredb ingest video DB FOLDER --no-telemetry`: every shot of the place must be in a
   map, nothing else in that map, and what is in none must have a reason in the report.
3. `featuredb lidar add` of the place's scan (intensities only); `featuredb anchor --picks` by six picks with
   3 px of error in one keyframe.
4. `featuredb track` of every film, without being told a lens. A frame's errors are inside their bounds where
   all six together are in the region that the stated covariance gives 95 %.

Prints the maps and tracks.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.scan_world import write_scan
from reloc.tracking.trajectory.read import read_trajectory_csv
from tools.commands import featuredb, newest_copy
from tools.figures import study_parser, write_figures
from tools.film_folder import FilmsTruth, place_scene, write_films, write_truth
from tools.film_maps import FilmMaps, keyframe_to_pick_in, read_film_maps
from tools.film_scripts import six_films
from tools.film_tracks import JudgedTrack, judge_track, track_figures
from tools.growth_common import say
from tools.picked import place_by_picks, read_scan


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    inputs = (args.inputs or args.work) / f"community-{args.seed}"
    scripts = six_films(args.seed)
    truth = write_films(inputs / "films", scripts)
    write_truth(inputs / "truth.json", truth)
    work = args.work / f"run-{args.seed}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    made = work / "made"
    seconds = _ingest(made, inputs / "films", work)
    found = read_film_maps(made, work / "report", truth)
    say(found.as_text())
    figures: dict[str, Any] = found.figures(scripts) | {"ingest_s": seconds, "placed": 0}
    if found.of_place:
        database = newest_copy(made, work / "placed")
        placed = _placed(database, found, truth, _scan(inputs, args.seed), work, args.seed)
        figures["placed"] = int(placed)
        tracks = _tracked(database, inputs / "films", work, truth) if placed else []
        figures |= track_figures(tracks)
        say("".join(f"\n{track.film}: {track_figures([track])}" for track in tracks))
    write_figures(args.json, figures)
    return 0


def _ingest(database: Path, films: Path, work: Path) -> float:
    """Seconds that the films took."""
    featuredb("init", str(database))
    start = time.monotonic()
    words = ("ingest", "video", str(database), str(films), "--no-telemetry", "--quiet")
    featuredb(*words, "--report", str(work / "report"), "--work", str(work / "stages"), may_refuse=True)
    return time.monotonic() - start


def _scan(inputs: Path, seed: int) -> Path:
    """The place's scan, made once."""
    file = inputs / "scan.laz"
    if not file.exists():
        part = file.with_name("scan.part.laz")
        write_scan(part, scan_town(place_scene(seed), AirborneScanOptions()))
        part.rename(file)
    return file


def _placed(database: Path, found: FilmMaps, truth: FilmsTruth, scan: Path, work: Path, seed: int) -> bool:
    """Place the largest map of the place."""
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    biggest = max(found.of_place, key=lambda one: len(one.keyframes))
    photos, seen = keyframe_to_pick_in(biggest, work / "stages" / "films")
    cloud = read_scan(scan, truth.frame, truth.epsg)
    return place_by_picks(database, biggest.map_id, photos, seen, cloud, work, seed)


def _tracked(database: Path, films: Path, work: Path, truth: FilmsTruth) -> list[JudgedTrack]:
    tracks = []
    for film, frames in truth.films.items():
        out = work / "tracks" / f"{film}.csv"
        words = ("track", str(database), str(films / film), "--out", str(out))
        featuredb(*words, may_refuse=True)
        tracks.append(judge_track(film, read_trajectory_csv(out), frames, truth.frame))
    return tracks


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__, "--work", "--inputs")
    parser.add_argument("--seed", type=int, default=1, help="of town, flights and picks")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
