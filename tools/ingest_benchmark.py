"""What an ingest costs and maps beside COLMAP's own pipeline on the same photos; processor time of one run.

COLMAP is pycolmap: SIFT of photos at 1600 px, pairs of 15 neighbours where photos have positions and all
pairs where they have none, incremental mapping. Ours is `featuredb ingest photos` into a new database, to the
commit. Each is a process of its own, the one after the other.
"""

import json
import tempfile
from pathlib import Path
from typing import Any

from featuredb.maps.feature_map import FeatureMap
from tools.commands import all_maps, cost_of
from tools.figures import study_parser, write_figures

_NEIGHBOURS = 15
_SIDE_PX = 1600
_THEIRS = f"""
import json, sys
import numpy
import pycolmap
photos, work = sys.argv[1:]
pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
pycolmap.set_random_seed(0)
features = pycolmap.FeatureExtractionOptions()
features.max_image_size = {_SIDE_PX}
database = work + "/colmap.db"
pycolmap.extract_features(database, photos, extraction_options=features)
with pycolmap.Database.open(database) as opened:
    priors = opened.read_all_pose_priors()  # one each, with gravity alone where a photo has no position
placed = all(numpy.isfinite(prior.position).all() for prior in priors)
if placed:
    pairs = pycolmap.SpatialPairingOptions()
    pairs.max_num_neighbors = {_NEIGHBOURS}
    pycolmap.match_spatial(database, pairing_options=pairs)
else:
    pycolmap.match_exhaustive(database)
models = pycolmap.incremental_mapping(database, photos, work).values()
print(json.dumps([[m.image(i).name for i in m.reg_image_ids()] for m in models]))
"""


def main() -> None:
    args = study_parser(__doc__, "folders").parse_args()
    figures: dict[str, Any] = {folder.parent.name: measured(folder) for folder in args.folders}
    costs = list(figures.values())
    figures["worst_ratio"] = max(cost["ratio"] for cost in costs)
    figures["fewer"] = max(cost["colmap_photos"] - cost["ours_photos"] for cost in costs)
    write_figures(args.json, figures)


def measured(folder: Path) -> dict[str, float]:
    """Both programs over the photos of a folder: processor seconds; photos in any model or map, in the
    largest, and in the largest of both; maps with a place."""
    with tempfile.TemporaryDirectory() as scratch:
        colmap = cost_of("-c", _THEIRS, str(folder), scratch)
        database = Path(scratch) / "db"
        words = ("ingest", "photos", str(database), str(folder), "--quiet")
        ours_s = cost_of("-m", "featuredb.cli", *words).seconds
        maps = all_maps(database)
    models = {
        "colmap": [set(names) for names in json.loads(colmap.told.splitlines()[-1])],
        "ours": [{image.name for image in one.images} for one in maps],
    }
    largest = {whose: max(own, key=len, default=set[str]()) for whose, own in models.items()}
    both = largest["colmap"] & largest["ours"]
    return {
        "colmap_s": colmap.seconds,
        "ours_s": ours_s,
        **{f"{whose}_photos": len(set[str]().union(*own)) for whose, own in models.items()},
        **{f"{whose}_largest": len(own) for whose, own in largest.items()},
        "ratio": ours_s / colmap.seconds,
        "both": len(both),
        "share": len(both) / max(1, len(largest["colmap"])),
        "placed": sum(isinstance(one, FeatureMap) for one in maps),
    }


if __name__ == "__main__":
    main()
