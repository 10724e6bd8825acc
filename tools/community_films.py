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
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.scan_world import write_scan
from reloc.tracking.trajectory.read import read_trajectory_csv
from reloc.tracking.trajectory.values import Trajectory
from tools.commands import featuredb, newest_copy
from tools.figures import study_parser, write_figures
from tools.film_folder import FilmsTruth, FrameTruth, place_scene, write_films, write_truth
from tools.film_maps import FilmMaps, keyframe_to_pick_in, read_film_maps
from tools.film_scripts import six_films
from tools.growth_common import say
from tools.picked import place_by_picks, read_scan
from tools.track_evaluation import axis_errors

_LEVEL = 0.95
_AXES = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgedTrack:
    """The track of a film against the truth.

    Attributes:
        film: name of its file. frames: that show the place. foreign: poses of frames that do not.
        metres, degrees: (k,) errors of the place's frames that have a pose.
        normalised: (k,) squared errors of all six axes by their covariance.
    """

    film: str
    frames: int
    foreign: int
    metres: FloatArray
    degrees: FloatArray
    normalised: FloatArray

    @property
    def inside(self) -> int:
        """Frames whose pose lies inside the region that its covariance gives 95 %."""
        return int((self.normalised <= chi2.ppf(_LEVEL, _AXES)).sum())


def judge_track(
    film: str, trajectory: Trajectory, truth: Sequence[FrameTruth], frame: LocalFrame
) -> JudgedTrack:
    """Compare each frame that has a pose with the truth."""
    poses = [one.pose for one in truth]
    off = axis_errors(trajectory, frame, poses)
    rows = np.flatnonzero(np.isfinite(off).all(axis=1))
    normalised = []
    for row in rows:
        pose = trajectory.points[row].pose
        assert pose is not None  # it has errors
        normalised.append(float(off[row] @ np.linalg.solve(pose.covariance, off[row])))
    tracked = sum(point.pose is not None for point in trajectory.points)
    return JudgedTrack(
        film=film,
        frames=sum(pose is not None for pose in poses),
        foreign=tracked - len(rows),
        metres=np.linalg.norm(off[rows, 3:], axis=1),
        degrees=np.degrees(np.linalg.norm(off[rows, :3], axis=1)),
        normalised=np.array(normalised),
    )


def track_figures(tracks: Iterable[JudgedTrack]) -> dict[str, float]:
    """Figures over all films."""
    films = list(tracks)
    nothing = np.array([np.nan])
    metres, degrees, normalised = (
        np.concatenate([getattr(track, name) for track in films] or [nothing])
        for name in ("metres", "degrees", "normalised")
    )
    frames = sum(track.frames for track in films)
    known = len(metres) > 0
    return {
        "place_frames": frames,
        "tracked": len(metres),
        "tracked_share": len(metres) / max(frames, 1),
        "inside": sum(track.inside for track in films),
        "inside_share": sum(track.inside for track in films) / max(frames, 1),
        "foreign_tracked": sum(track.foreign for track in films),
        "median_m": float(np.median(metres)) if known else np.nan,
        "p95_m": float(np.quantile(metres, 0.95)) if known else np.nan,
        "largest_m": float(metres.max()) if known else np.nan,
        "median_deg": float(np.median(degrees)) if known else np.nan,
        "largest_deg": float(degrees.max()) if known else np.nan,
        "normalised_median": float(np.median(normalised) / _AXES) if known else np.nan,
        "normalised_p95": float(np.quantile(normalised, 0.95) / _AXES) if known else np.nan,
    }


def main() -> None:
    args = _arguments()
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


def _arguments() -> argparse.Namespace:
    parser = study_parser(__doc__, "--work", "--inputs")
    parser.add_argument("--seed", type=int, default=1, help="of town, flights and picks")
    return parser.parse_args()


if __name__ == "__main__":
    main()
