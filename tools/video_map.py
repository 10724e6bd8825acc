"""A map made of a film: keyframes, minutes, and how right its cameras are.

    python -m tools.video_map --out DIR

1. The film `smooth` of `tools.track_evaluation` (kept in DIR), a drone's telemetry beside it.
2. `featuredb lidar add` of the town's scan; `featuredb ingest video`; `featuredb anchor --auto` of its map.
3. The map's cameras against the truth.
"""

import shutil
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from ingest.workspace import default_root
from tools.commands import anchor, featuredb
from tools.figures import pose_errors, poses_in, study_parser, write_figures
from tools.made_maps import make
from tools.track_evaluation import smooth_film
from tools.worlds.film_world import FilmTruth
from tools.worlds.scan_world import make_scan_world


def main() -> None:
    args = study_parser(__doc__, "--out").parse_args()
    world = make_scan_world(args.out)
    film, truth = smooth_film(args.out)
    database = args.out / "film.db"
    shutil.rmtree(database, ignore_errors=True)
    featuredb("lidar", "add", str(database), str(world.scan))
    clock = StageClock()
    featuredb("ingest", "video", str(database), str(film), "--quiet")
    clock.lap("ingest")
    (made,) = Database.open(database).snapshot().maps()
    placed = anchor(database, made.map_id, stills_of(database), args.out / "film-anchor")
    clock.lap("anchor")
    feature_map = Database.open(database).snapshot().load_map(made.map_id)
    off = keyframe_errors(feature_map, truth)
    figures = {
        "keyframes": len(feature_map.images),
        "keyframes_m": float(np.median(off)),
        "keyframes_largest_m": float(off.max()),
        "placed": int(placed),
        "made_s": clock.seconds["ingest"],
        "anchored_s": clock.seconds["anchor"],
    }
    write_figures(args.out / "video_map.json", figures)


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


def keyframe_errors(feature_map: FeatureMap, truth: FilmTruth) -> FloatArray:
    """Metres between the map's images and the film's cameras at their times."""
    poses = {image: truth.cam_from_local[frame_of(image)] for image in (i.name for i in feature_map.images)}
    true = {image: pose for image, pose in poses.items() if pose is not None}
    return pose_errors(poses_in(truth.frame, feature_map), true)[0]


if __name__ == "__main__":
    main()
