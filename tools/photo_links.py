"""How firmly do right and wrong photos of grown maps hang on those that are localised by themselves?

    python -m tools.photo_links --world ALBUM --db DB

ALBUM is a folder of `featuredb.simworld` albums, DB a database that has grown by its photos
(tools/growth_community.py; its `--min-link` admits more than the default, so that wrong ones are there to be
seen). Prints each photo of its living grown maps that no existing map localised: its `firmness`
(`ingest/links.py`) and its error. The limit `SettleOptions.min_link` belongs between the two kinds.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lineage import GROWTH
from featuredb.store import Database
from ingest.colmap_bridge import Model
from ingest.links import firmness
from tools.growth_common import open_album, registered, table


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database, album = Database.open(args.db), open_album(args.world)
    snapshot = database.snapshot()
    found = registered(database, album)
    rows: list[tuple[float, float, str]] = []
    for map_id in sorted({r.map_id for r in found if r.generation > 0}):
        mine = [r for r in found if r.map_id == map_id]
        hanging = dict(_hanging(snapshot.load_map(map_id)))
        rows += [
            (hanging[k], r.error_m, f"{r.fact.kind}, {r.fact.place}, {r.fact.owner}")
            for k, r in enumerate(mine)
            if k in hanging
        ]
    sys.stdout.write(table(sorted(rows), ("firmness", "error m", "photo")) + "\n")
    return 0


def _hanging(feature_map: FeatureMap) -> Iterator[tuple[int, float]]:
    """Places among the images, and firmness, of those that hang on others."""
    agreeing = set(feature_map.placement.evidence[GROWTH]["agreeing_photos"])
    held = [k for k, image in enumerate(feature_map.images) if image.name in agreeing]
    firm = firmness(_as_model(feature_map), held)
    yield from ((k, float(firm[k])) for k in np.flatnonzero(np.isfinite(firm)).tolist())


def _as_model(feature_map: FeatureMap) -> Model:
    """Who sees what, as a reconstruction."""
    seen = feature_map.observations
    place = {image.image_id: k for k, image in enumerate(feature_map.images)}
    return Model(
        cameras=feature_map.cameras,
        rows=np.arange(len(feature_map.images)),
        camera_of=np.array([image.camera_id for image in feature_map.images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in feature_map.images),
        xyz=feature_map.points_local(),
        point_of=seen.point_index.astype(np.int64),
        photo_of=np.array([place[i] for i in seen.image_id.tolist()], dtype=np.int64),
        keypoint_of=np.zeros(len(seen.point_index), dtype=np.int64),
    )


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, required=True, metavar="ALBUM")
    parser.add_argument("--db", type=Path, required=True)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
