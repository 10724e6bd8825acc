"""The paper's film beside ours (Bodensteiner et al., sections 3.1.2 and 3.2).

    python -m tools.paper --out DIR [--inputs FOLDER]

A simulated film without any telemetry becomes a map; six picks in one frame place it on an intensity-only
scan; all frames are tracked. The paper measures distances from a bundle adjustment; here from the truth,
which no adjustment's own error softens, and beside it from the map's adjusted keyframes.

Writes paper.json.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.workspace import default_root
from reloc.localiser import Localiser
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, track_video
from tools.commands import featuredb
from tools.figures import study_parser, write_figures
from tools.made_maps import make
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import axis_errors, film_options
from tools.worlds.film_world import FILM_FILE, FilmTruth, read_film_truth, write_film
from tools.worlds.scan_world import make_scan_world

_FRAMES = 1200
_PLACED = "placed.json"  # what came of the film; who starts again goes on from there


def main() -> None:
    args = study_parser(__doc__, "--out", "--inputs", "--seed").parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    write_figures(args.out / "paper.json", film(args))


def film(args: argparse.Namespace) -> dict[str, Any]:
    """A film that says nothing of its place, placed by one frame, tracked from end to end."""
    inputs = args.inputs or args.out
    world = make_scan_world(inputs)
    folder = write_film(inputs / f"film-smooth-{_FRAMES}-1", film_options("smooth", _FRAMES))
    truth = read_film_truth(folder)
    work = args.out / "film"
    if not (work / _PLACED).exists():
        write_figures(work / _PLACED, placed_film(folder / FILM_FILE, world.scan, truth, work, args.seed))
    made = json.loads((work / _PLACED).read_text(encoding="utf-8"))
    if made["refused"]:
        sys.stdout.write(f"FAILED: {made['refused']}\n")
        return {"placed": 0}
    feature_map = Database.open(work / "db").snapshot().load_map(made["map_id"])
    areas = Localiser.open(Database.open(work / "db")).areas
    camera = feature_map.cameras[0].scaled_to(truth.camera.width, truth.camera.height)
    tracked = track_video(work / FILM_FILE, MapFinder(areas), camera=camera)
    off = axis_errors(tracked.trajectory, truth.frame, truth.cam_from_local)
    metres = np.linalg.norm(off[:, 3:], axis=1)
    figures = track_figures(metres) | {"placed": 1, "keyframes": made["keyframes"], "made_s": made["made_s"]}
    figures["adjusted_m"] = from_keyframes(tracked, feature_map)
    figures["rate_hz"] = len(metres) / tracked.seconds["total"]
    times = json.loads((work / "anchor" / "anchor.json").read_text(encoding="utf-8"))["times_s"]
    figures["frame_s"] = times.get("(B) one frame, median", float("nan"))
    figures["projection_s"] = times.get("(C) structure projection, all frames", float("nan"))
    return figures


def placed_film(film_file: Path, scan: Path, truth: FilmTruth, work: Path, seed: int) -> dict[str, Any]:
    """The film's map in `work`/db, placed by picks in one frame: its id, keyframes, seconds; or why not."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    bare, database = Path(shutil.copy(film_file, work)), work / "db"  # with nothing beside it
    made = make(database, "video", bare)
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    unplaced = Database.open(database).snapshot().unplaced_maps()
    if not unplaced:
        return {"refused": "no map came of the film"}
    biggest = max(unplaced, key=lambda one: one.images)
    stills = next((default_root(Database.open(database).url) / "films").iterdir())
    seen = seen_in_the_middle(database, biggest.map_id, truth)
    cloud = read_scan(scan, truth.frame, truth.epsg)
    placed = place_by_picks(database, biggest.map_id, stills, seen, cloud, work, seed)
    return {
        "refused": "" if placed else "the map was not placed by the picks of one frame",
        "map_id": biggest.map_id,
        "keyframes": biggest.images,
        "made_s": made.seconds,
    }


def track_figures(metres: np.ndarray) -> dict[str, float]:
    """Mean error of all frames with a pose, of the first and of the last quarter; frames without one."""
    quarter = len(metres) // 4
    first, last = float(np.nanmean(metres[:quarter])), float(np.nanmean(metres[-quarter:]))
    return {
        "lost": int(np.isnan(metres).sum()),
        "mean_m": float(np.nanmean(metres)),
        "first_m": first,
        "last_m": last,
        "last_over_first": last / first,
        "largest_m": float(np.nanmax(metres)),
    }


def from_keyframes(tracked: TrackedVideo, feature_map: FeatureMap) -> float:
    """Mean distance of tracked centres from those of the map's keyframes, which were adjusted together."""
    poses = {p.index: p.pose for p in tracked.trajectory.points}
    apart = []
    for image in feature_map.images:
        pose = poses.get(frame_of(image.name))
        if pose is not None:
            center = feature_map.frame.enu_from_utm(pose.utm, pose.epsg)
            apart.append(float(np.linalg.norm(center - image.cam_from_local.center)))
    return float(np.mean(apart)) if apart else float("nan")


def seen_in_the_middle(database: Path, map_id: str, truth: FilmTruth) -> Seen:
    """The map's middle keyframe."""
    unplaced = Database.open(database).snapshot().load_unplaced(map_id)
    image = unplaced.images[len(unplaced.images) // 2].name
    pose = truth.cam_from_local[frame_of(image)]
    if pose is None:
        raise SystemExit(f"{image}: a frame that does not show the town cannot be picked in")
    return Seen(image=image, camera=truth.camera, cam_from_local=pose)


def frame_of(image: str) -> int:
    """The number of the film's frame that a keyframe is, by its name."""
    return int("".join(c for c in Path(image).stem if c.isdigit()))


if __name__ == "__main__":
    main()
