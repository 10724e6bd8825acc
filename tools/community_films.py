"""A folder of films by strangers: maps of what shows the place, placed by one frame, every frame tracked.

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

import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from featuredb.store import Database
from ingest.report.page import REPORT_JSON
from reloc.tracking.trajectory.files import read_trajectory_csv
from reloc.tracking.trajectory.values import Trajectory
from tools.commands import featuredb, newest_copy
from tools.figures import inside, say, spread, squared, study_parser, write_figures
from tools.film_folder import HEIGHT, FilmsTruth, FrameTruth, Script, six_films, write_films
from tools.paper import frame_of
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import axis_errors
from tools.worlds.scan_world import make_scan_world

Shot = tuple[str, int]  # name of a film's file, number of the piece


class MapKeyframe(NamedTuple):
    """An image of a map, or of the report: what it shows by the truth. `reason`: why it is in no map."""

    image: str
    shot: Shot
    truth: FrameTruth
    reason: str = ""


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs", "--seed").parse_args()
    inputs = args.inputs / f"community-{args.seed}"
    truth = write_films(inputs / "films", args.seed)
    work = args.work / f"run-{args.seed}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    made = work / "made"
    featuredb("init", str(made))
    words = ("ingest", "video", str(made), str(inputs / "films"), "--no-telemetry", "--quiet")
    featuredb(*words, "--report", str(work / "report"), "--work", str(work / "stages"), refusals=(1,))
    snapshot = Database.open(made).snapshot()
    maps = {
        one.map_id: [_keyframe(image.name, truth) for image in snapshot.load_unplaced(one.map_id).images]
        for one in snapshot.unplaced_maps()
    }
    told = json.loads((work / "report" / REPORT_JSON).read_text(encoding="utf-8"))
    figures = map_figures(maps, told, truth, six_films(args.seed)) | {"placed": 0}
    if of_place := {map_id: those for map_id, those in maps.items() if _of_place(those)}:
        database = newest_copy(made, work / "placed")
        scan = make_scan_world(args.inputs, args.seed).scan
        featuredb("lidar", "add", str(database), str(scan), "--quiet")
        biggest, keyframes = max(of_place.items(), key=lambda one: len(one[1]))
        photos, seen = keyframe_to_pick_in(keyframes, work / "stages" / "films")
        cloud = read_scan(scan, truth.frame, truth.epsg)
        if place_by_picks(database, biggest, photos, seen, cloud, work, args.seed):
            tracks = {}
            for film in truth.films:
                out = work / "tracks" / f"{film}.csv"
                words = ("track", str(database), str(inputs / "films" / film), "--out", str(out))
                featuredb(*words, refusals=(1,))
                tracks[film] = read_trajectory_csv(out)
                say(f"{film}: {track_figures({film: tracks[film]}, truth)}")
            figures |= track_figures(tracks, truth) | {"placed": 1}
    write_figures(args.json, figures)


def track_figures(tracks: Mapping[str, Trajectory], truth: FilmsTruth) -> dict[str, float]:
    """Of tracks by film: frames of the place, tracked and inside their bounds; their errors; other poses."""
    frames = foreign = 0
    metres, squares = [], []
    for film, trajectory in tracks.items():
        poses = [one.pose for one in truth.films[film]]
        frames += sum(pose is not None for pose in poses)
        off = axis_errors(trajectory, truth.frame, poses)
        found = [(p.pose, e) for p, e in zip(trajectory.points, off, strict=True) if p.pose is not None]
        shown = [(pose, error) for pose, error in found if np.isfinite(error).all()]
        foreign += len(found) - len(shown)
        metres += [np.linalg.norm(error[3:]) for _, error in shown]
        squares += [squared(error, pose.covariance) for pose, error in shown]
    share = len(metres) / max(frames, 1)
    return {
        "place_frames": frames,
        "tracked_share": share,
        "inside_share": share * inside(squares, 0.95, 6) if squares else 0.0,
        "foreign_tracked": foreign,
        **spread(metres),
    }


def map_figures(
    maps: Mapping[str, Sequence[MapKeyframe]],
    told: Mapping[str, Any],
    truth: FilmsTruth,
    scripts: Sequence[Script],
) -> dict[str, int]:
    """Shots of the place, of which most keyframes are in maps of it (`maps`: keyframes by map); what is in
    them beside; losses, by the report of the ingest."""
    shots = {(f"{s.name}.mp4", n): span for s in scripts for n, span in s.shots_s().items()}
    mapped = {k.image for keyframes in maps.values() for k in keyframes}
    left = [_keyframe(p["name"], truth, p["reason"]) for p in told["photos"] if p["name"] not in mapped]
    inside_maps = [k for keyframes in maps.values() if _of_place(keyframes) for k in keyframes]
    elsewhere = [k for keyframes in maps.values() if not _of_place(keyframes) for k in keyframes]
    here, others = (Counter(k.shot for k in those) for those in (inside_maps, [*elsewhere, *left]))
    unseen = [shot for shot in shots if not here[shot] + others[shot]]
    return {
        "place_maps": sum(map(_of_place, maps.values())),
        "place_shots": len(shots),
        "shots_in_maps": sum(here[shot] > others[shot] for shot in shots),
        "foreign_in_maps": sum(k.truth.pose is None for k in inside_maps),
        "lost_without_reason": sum(not k.reason for k in left)
        + sum(not _explained(told["films"], shot[0], shots[shot]) for shot in unseen),
    }


def _of_place(keyframes: Sequence[MapKeyframe]) -> bool:
    """Whether most keyframes of a map show the place."""
    return 2 * sum(k.truth.pose is not None for k in keyframes) > len(keyframes)


def _explained(films: Sequence[Mapping[str, Any]], name: str, span_s: tuple[float, float]) -> bool:
    """Whether the report says why there is no keyframe of a span of a film: of the film, or of a shot."""
    mine = [film for film in films if Path(film["path"]).name == name]
    shots = [s for film in mine for s in film["shots"] if s["start_s"] < span_s[1] and span_s[0] < s["end_s"]]
    refused = any(film["status"] == "refused" and film["reason"] for film in mine)
    return refused or any(not shot["keyframes"] and shot["dropped"] for shot in shots)


def keyframe_to_pick_in(keyframes: Sequence[MapKeyframe], stills: Path) -> tuple[Path, Seen]:
    """Folder of a map's images, below `stills`, and the one to pick in: whole and rich in detail."""
    found: list[tuple[int, Path, Seen]] = []
    for keyframe in keyframes:
        (file,) = stills.rglob(keyframe.image)
        with Image.open(file) as picture:
            whole = picture.height == HEIGHT
        pose, camera = keyframe.truth.pose, keyframe.truth.camera
        if whole and pose is not None and camera is not None:
            folder = file.parents[len(Path(keyframe.image).parts) - 1]
            seen = Seen(image=keyframe.image, camera=camera, cam_from_local=pose)
            found.append((file.stat().st_size, folder, seen))
    if not found:
        raise SystemExit("the map has no keyframe to pick in")
    return max(found, key=lambda one: one[0])[1:]


def _keyframe(image: str, truth: FilmsTruth, reason: str = "") -> MapKeyframe:
    """The film is a part of the image's path, and its name the frame."""
    path = Path(image)
    named = [film for film in truth.films if Path(film).stem in path.parts[:-1]]
    if len(named) != 1:
        raise SystemExit(f"{image}: expected FILM/FRAME.jpg of {', '.join(truth.films)}")
    frame = truth.films[named[0]][frame_of(image)]
    return MapKeyframe(image, (named[0], frame.piece), frame, reason)


if __name__ == "__main__":
    main()
