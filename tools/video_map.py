"""A map made of a film: keyframes, minutes, and how right its cameras are.

    python -m tools.video_map --out DIR

1. The film `smooth` of `tools.track_evaluation` (kept in DIR/film-smooth), a drone's telemetry beside it.
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
from tools.figures import study_parser, write_figures
from tools.track_evaluation import film_options
from tools.worlds.film_world import FILM_FILE, FilmTruth, read_film_truth, write_film
from tools.worlds.scan_world import make_scan_world

_FRAMES = 1200


def main() -> None:
    args = study_parser(__doc__, "--out").parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    world = make_scan_world(args.out)
    folder = write_film(args.out / "film-smooth", film_options("smooth", _FRAMES))
    database = args.out / "film.db"
    shutil.rmtree(database, ignore_errors=True)
    featuredb("lidar", "add", str(database), str(world.scan))
    clock = StageClock()
    featuredb("ingest", "video", str(database), str(folder / FILM_FILE), "--quiet")
    clock.lap("ingest")
    (made,) = Database.open(database).snapshot().maps()
    (stills,) = (default_root(Database.open(database).url) / "films").iterdir()
    placed = anchor(database, made.map_id, stills, args.out / "film-anchor")
    clock.lap("anchor")
    snapshot = Database.open(database).snapshot()
    feature_map = snapshot.load_map(made.map_id)
    off = keyframe_errors(feature_map, read_film_truth(folder))
    figures = {
        "keyframes": len(feature_map.images),
        "keyframes_m": float(np.median(off)),
        "keyframes_largest_m": float(off.max()),
        "placed": int(placed),
        "made_s": clock.seconds["ingest"],
        "anchored_s": clock.seconds["anchor"],
    }
    write_figures(args.out / "video_map.json", figures)


def keyframe_errors(feature_map: FeatureMap, truth: FilmTruth) -> FloatArray:
    """Metres between the map's images and the film's cameras at their times."""
    here = truth.frame.enu_from(feature_map.frame)
    found = []
    for image in feature_map.images:
        true = truth.cam_from_local[int(Path(image.name).stem)]  # keyframes are named by their frame
        assert true is not None
        found.append(float(np.linalg.norm(here.act(image.cam_from_local.center) - true.center)))
    return np.array(found)


if __name__ == "__main__":
    main()
