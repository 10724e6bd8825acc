"""How much of what they should see photos of grown maps show: the gate of ingest.growth.visibility, by truth.

    python -m tools.witnessed_parts DB WORLD [--rows 30]

DB is a database that grew on a simulated album (`tools.growth_community` makes one), WORLD the album. For
every photo of a grown map: the share of the parts of its picture that should show points (of maps of earlier
generations, and of its own map those that at least three of its photos see) and does. A map keeps no pixels
in which existing points are seen; observations within three pixels of where one should be stand for them.
Prints the photos that show least, and where the limit lies among right and wrong ones.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.view_cones import in_view, view_cones
from featuredb.index.area import Area, build_area
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.growth.visibility import VisibilityOptions
from reloc.acceptance import agreement
from reloc.matching import EXPECTED_DEG, visible_points
from tools.growth_common import open_album, registered, table

_NEAR_PX = 3.0
_WRONG_M = 2.0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("db", type=Path)
    parser.add_argument("world", type=Path)
    parser.add_argument("--rows", type=int, default=30, help="photos that are printed (30)")
    args = parser.parse_args(argv)
    database = Database.open(args.db)
    snapshot = database.snapshot()
    maps = [snapshot.load_map(summary.map_id) for summary in snapshot.maps()]
    facts = iter(registered(database, open_album(args.world)))
    rows: list[tuple[float, float, str, str, str, int]] = []
    for feature_map in maps:
        earlier = [m for m in maps if m.generation < feature_map.generation]
        shares = (
            shown(feature_map, build_area(earlier, feature_map.frame), VisibilityOptions())
            if earlier
            else np.full(len(feature_map.images), np.nan)
        )
        for share, of in zip(shares, facts, strict=False):
            if np.isfinite(share) and of.offset_m is not None:
                error_m = float(np.linalg.norm(of.offset_m))
                rows.append(
                    (float(share), error_m, of.fact.kind, of.fact.name, of.map_id, len(feature_map.images))
                )
    rows.sort()
    print(table(rows[: args.rows], ("shows", "error m", "kind", "photo", "map", "of photos")))
    limit = VisibilityOptions().min_witnessed
    for name, wrong in (("right", False), ("wrong", True)):
        some = np.array([share for share, error_m, *_ in rows if (error_m > _WRONG_M) == wrong])
        least = f", least {some.min():.2f}, median {np.median(some):.2f}" if len(some) else ""
        print(f"{name}: {len(some)} photos, {(some < limit).sum()} of them below {limit:g}{least}")
    return 0


def shown(feature_map: FeatureMap, existing: Area, options: VisibilityOptions) -> FloatArray:
    """(k,) share of each image of the map; NaN for those that should show hardly anything."""
    observations = feature_map.observations
    points = feature_map.points_local(feature_map.frame)
    ids = {image.image_id: k for k, image in enumerate(feature_map.images)}
    image_of = np.array([ids[int(i)] for i in observations.image_id], dtype=np.int64)
    centers = np.array([image.cam_from_local.center for image in feature_map.images])
    cones = view_cones(points, centers, observations.point_index, image_of)
    often = np.bincount(observations.point_index, minlength=len(points)) >= options.min_witnesses
    shares = np.full(len(feature_map.images), np.nan)
    for k, image in enumerate(feature_map.images):
        camera, pose = feature_map.cameras[image.camera_id], image.cam_from_local
        own = camera.project(pose.act(points[often & in_view(points, cones, camera, pose, EXPECTED_DEG)]))
        rows = visible_points(existing, np.arange(len(existing.points), dtype=np.int64), camera, pose)
        other = camera.project(pose.act(existing.points[rows]))
        seen = image_of == k
        pixels = observations.xy[seen].astype(np.float64)
        counts = often[observations.point_index[seen]]
        if len(other):
            counts |= cKDTree(other).query(pixels)[0] < _NEAR_PX
        expected = np.concatenate([own, other])
        if len(expected) >= options.min_points:
            shares[k] = agreement(pixels[counts], expected, camera.width, camera.height)
    return shares


if __name__ == "__main__":
    sys.exit(main())
