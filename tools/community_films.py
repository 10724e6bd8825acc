"""A folder of films by strangers: maps of what shows the place, placed by one frame, every frame tracked.

    python -m tools.community_films --work DIR [--seed N]

1. Six simulated films without telemetry: three of one place (cuts, a title, black, a zoom, a logo, bars), one
   of another town, two of the place that are compressed badly, one of which shows the other town in between.
   They are drawn once and kept.
2. `featuredb init`, `featuredb ingest video DB FOLDER --no-telemetry`: every shot of the place must be in a
   map, nothing else in that map, and what is in none must have a reason in the report.
3. `featuredb lidar add` of the place's scan (intensities only); `featuredb anchor --picks` by six picks with
   3 px of error in one keyframe.
4. `featuredb track` of every film, without being told a lens. A frame's errors are inside their bounds where
   all six together are in the region that the stated covariance gives 95 %.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.scan_world import write_scan
from reloc.tracking.trajectory.files import read_trajectory_csv
from reloc.tracking.trajectory.values import Trajectory
from tools.commands import featuredb, newest_copy
from tools.figures import median, say, squared, study_parser, write_figures
from tools.film_folder import FilmsTruth, place_scene, six_films, write_films
from tools.film_maps import FilmMaps, keyframe_to_pick_in, read_film_maps
from tools.made_maps import once
from tools.picked import place_by_picks, read_scan
from tools.track_evaluation import axis_errors

_INSIDE = float(chi2.ppf(0.95, 6))


def track_figures(tracks: Mapping[str, Trajectory], truth: FilmsTruth) -> dict[str, float]:
    """Of tracks by film: frames that show the place, those tracked and inside their bounds, their errors; and
    poses of frames that do not show it."""
    frames = foreign = 0
    metres, squares = [], []
    for film, trajectory in tracks.items():
        poses = [one.pose for one in truth.films[film]]
        frames += sum(pose is not None for pose in poses)
        off = axis_errors(trajectory, truth.frame, poses)
        for point, error in zip(trajectory.points, off, strict=True):
            if point.pose is not None and np.isfinite(error).all():
                metres.append(np.linalg.norm(error[3:]))
                squares.append(squared(error, point.pose.covariance))
            elif point.pose is not None:
                foreign += 1
    return {
        "place_frames": frames,
        "tracked_share": len(metres) / max(frames, 1),
        "inside_share": sum(one <= _INSIDE for one in squares) / max(frames, 1),
        "foreign_tracked": foreign,
        "median_m": median(metres),
        "largest_m": float(max(metres, default=np.nan)),
    }


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs", "--seed").parse_args()
    inputs = (args.inputs or args.work) / f"community-{args.seed}"
    scripts = six_films(args.seed)
    truth = write_films(inputs / "films", scripts)
    work = args.work / f"run-{args.seed}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    made = work / "made"
    featuredb("init", str(made))
    words = ("ingest", "video", str(made), str(inputs / "films"), "--no-telemetry", "--quiet")
    featuredb(*words, "--report", str(work / "report"), "--work", str(work / "stages"), refusals=(1,))
    found = read_film_maps(made, work / "report", truth)
    figures: dict[str, Any] = found.figures(scripts) | {"placed": 0}
    if found.of_place:
        database = newest_copy(made, work / "placed")
        town = place_scene(args.seed)
        scan = once(
            inputs / "scan.laz", lambda file: write_scan(file, scan_town(town, AirborneScanOptions()))
        )
        placed = _placed(database, found, truth, scan, work, args.seed)
        figures["placed"] = int(placed)
        tracks = _tracked(database, inputs / "films", work, truth) if placed else {}
        figures |= track_figures(tracks, truth)
        say("".join(f"\n{film}: {track_figures({film: track}, truth)}" for film, track in tracks.items()))
    write_figures(args.json, figures)


def _placed(database: Path, found: FilmMaps, truth: FilmsTruth, scan: Path, work: Path, seed: int) -> bool:
    """Place the largest map of the place."""
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    biggest, keyframes = max(found.of_place.items(), key=lambda one: len(one[1]))
    photos, seen = keyframe_to_pick_in(keyframes, work / "stages" / "films")
    cloud = read_scan(scan, truth.frame, truth.epsg)
    return place_by_picks(database, biggest, photos, seen, cloud, work, seed)


def _tracked(database: Path, films: Path, work: Path, truth: FilmsTruth) -> dict[str, Trajectory]:
    tracks = {}
    for film in truth.films:
        out = work / "tracks" / f"{film}.csv"
        featuredb("track", str(database), str(films / film), "--out", str(out), refusals=(1,))
        tracks[film] = read_trajectory_csv(out)
    return tracks


if __name__ == "__main__":
    main()
