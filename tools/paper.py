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

from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.workspace import default_root
from reloc.localiser import Localiser
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, track_video
from tools.commands import featuredb, largest_map, make
from tools.figures import kept, study_parser, write_figures
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import FRAMES, axis_errors, drawn_film, judge_film
from tools.worlds.film_world import FilmTruth
from tools.worlds.scan_world import make_scan_world

_SEED = 1


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs").parse_args()
    work, world = args.work / "film", make_scan_world(args.inputs)
    film, truth = drawn_film("smooth", FRAMES, args.inputs)
    # Who starts again goes on from there.
    made = kept(work / "placed.json", lambda: placed_film(film, world.scan, truth, work))
    if not made["placed"]:
        write_figures(args.json, {"placed": 0})
        return
    database = Database.open(work / "db")
    feature_map, areas = database.snapshot().load_map(made["map_id"]), Localiser.open(database).areas
    camera = feature_map.cameras[0].scaled_to(truth.camera.width, truth.camera.height)
    tracked = track_video(film, MapFinder(areas), camera=camera)
    figures = judge_film(tracked, truth, len(truth.times_s) // 4)
    times = json.loads((work / "anchor" / "anchor.json").read_text(encoding="utf-8"))["times_s"]
    figures |= {
        "placed": 1,
        "last_over_first": figures["last_m"] / figures["first_m"],
        "adjusted_m": from_keyframes(tracked, feature_map),
        "made_s": made["made_s"],
        "frame_s": times.get("(B) one frame, median", float("nan")),
        "projection_s": times.get("(C) structure projection, all frames", float("nan")),
    }
    write_figures(args.json, figures)


def placed_film(film: Path, scan: Path, truth: FilmTruth, work: Path) -> dict[str, Any]:
    """The film's map in `work`/db: whether it is placed by picks in one frame; its id and seconds."""
    shutil.rmtree(work, ignore_errors=True)
    database = work / "db"
    made = make(database, "video", film, ("--no-telemetry",))
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    unplaced = largest_map(database)
    image = unplaced.images[len(unplaced.images) // 2].name  # in the middle of the film
    seen = Seen(image=image, camera=truth.camera, cam_from_local=truth.cam_from_local[frame_of(image)])
    cloud = read_scan(scan, truth.frame, truth.epsg)
    placed = place_by_picks(database, unplaced.map_id, stills_of(database), seen, cloud, work, _SEED)
    return {"placed": placed, "map_id": unplaced.map_id, "made_s": made["seconds"]}


def stills_of(database: Path) -> Path:
    """The folder of keyframes that the ingest of a film has left."""
    (stills,) = (default_root(Database.open(database).url) / "films").iterdir()
    return stills


def frame_of(image: str) -> int:
    """The number of the film's frame that a keyframe is, by its name."""
    return int(Path(image).stem)


def from_keyframes(tracked: TrackedVideo, feature_map: FeatureMap) -> float:
    """Mean distance of tracked centres from those of the map's keyframes, which were adjusted together."""
    adjusted: list[Rigid3 | None] = [None] * len(tracked.trajectory.points)
    for image in feature_map.images:
        adjusted[frame_of(image.name)] = image.cam_from_local
    off = axis_errors(tracked.trajectory, feature_map.frame, adjusted)
    return float(np.nanmean(np.linalg.norm(off[:, 3:], axis=1)))


if __name__ == "__main__":
    main()
