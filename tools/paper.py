"""The paper's film beside ours (Bodensteiner et al., sections 3.1.2 and 3.2).

A simulated film without any telemetry becomes a map; six picks in one frame place it on an intensity-only
scan; all frames are tracked. The paper measures distances from a bundle adjustment; here from the truth,
which no adjustment's own error softens, and beside it from the map's adjusted keyframes.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.workspace import default_root
from reloc.localiser import Localiser
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, track_video
from tools.commands import featuredb, largest_map, make
from tools.figures import kept, study_parser, write_figures
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import FRAMES, drawn_film, judge_film
from tools.worlds.film_world import FilmTruth
from tools.worlds.scan_world import make_scan_world

_SEED = 1


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    write_figures(args.json, film_figures(args.work / "film", args.inputs))


def film_figures(work: Path, inputs: Path) -> dict[str, Any]:
    """A film that says nothing of its place, placed by one frame, tracked from end to end."""
    world = make_scan_world(inputs)
    film, truth = drawn_film("smooth", FRAMES, inputs)
    # Who starts again goes on from there.
    made = kept(work / "placed.json", lambda: placed_film(film, world.scan, truth, work))
    if not made["placed"]:
        return {"placed": 0}
    database = Database.open(work / "db")
    feature_map, areas = database.snapshot().load_map(made["map_id"]), Localiser.open(database).areas
    camera = feature_map.cameras[0].scaled_to(truth.camera.width, truth.camera.height)
    tracked = track_video(work / film.name, MapFinder(areas), camera=camera)
    figures = judge_film(tracked, truth, len(truth.times_s) // 4)
    times = json.loads((work / "anchor" / "anchor.json").read_text(encoding="utf-8"))["times_s"]
    return figures | {
        "placed": 1,
        "last_over_first": figures["last_m"] / figures["first_m"],
        "adjusted_m": from_keyframes(tracked, feature_map),
        "made_s": made["made_s"],
        "frame_s": times.get("(B) one frame, median", float("nan")),
        "projection_s": times.get("(C) structure projection, all frames", float("nan")),
    }


def placed_film(film: Path, scan: Path, truth: FilmTruth, work: Path) -> dict[str, Any]:
    """The film's map in `work`/db: whether it is placed by picks in one frame; its id and seconds."""
    shutil.rmtree(work, ignore_errors=True)
    database = work / "db"
    made = unplaced_film(film, database)
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    map_id = largest_map(database).map_id
    seen = seen_in_the_middle(database, map_id, truth)
    cloud = read_scan(scan, truth.frame, truth.epsg)
    placed = place_by_picks(database, map_id, stills_of(database), seen, cloud, work, _SEED)
    return {"placed": placed, "map_id": map_id, "made_s": made["seconds"]}


def unplaced_film(film: Path, database: Path) -> dict[str, float]:
    """Make a map of a film without its telemetry: what `make` says of it."""
    database.parent.mkdir(parents=True, exist_ok=True)
    return make(database, "video", Path(shutil.copy(film, database.parent)))  # with nothing beside it


def stills_of(database: Path) -> Path:
    """The folder of keyframes that the ingest of a film has left."""
    (stills,) = (default_root(Database.open(database).url) / "films").iterdir()
    return stills


def frame_of(image: str) -> int:
    """The number of the film's frame that a keyframe is, by its name."""
    return int("".join(c for c in Path(image).stem if c.isdigit()))


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
    return Seen(image=image, camera=truth.camera, cam_from_local=truth.cam_from_local[frame_of(image)])


if __name__ == "__main__":
    main()
