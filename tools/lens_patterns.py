"""What lens models leave over that passes for another focal length: grown maps of a simulated album.

    python -m tools.lens_patterns DB WORLD

For every photo of a grown map: how much of a change of its focal length no pose takes over (RMS over its
observations, pixels for a focal length that is off by its own size: little over flat places from above), and
what the focal length is truly off. Their product is the pattern in pixels that passed for it. Prints this
by lens model, for cameras whose map knows them by EXIF and for those that nobody knew, and the photos of most
error. The limits are `ingest.growth.drift.DriftOptions.pattern_px`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.store import Database
from ingest.precision import linearise
from tools.growth_common import open_album, registered, table

_WORST = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """A photo: how well it tells its focal length, and how right that is.

    Attributes:
        told_px: see above. off_rel: focal length over the true one, minus 1. error_m: of the position.
    """

    name: str
    model: str
    known: bool
    told_px: float
    off_rel: float
    error_m: float

    @property
    def pattern_px(self) -> float:
        return abs(self.off_rel) * self.told_px


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("db", type=Path)
    parser.add_argument("world", type=Path)
    args = parser.parse_args(argv)
    found = photos(Database.open(args.db), args.world)
    rows = []
    for model in sorted({f.model for f in found}):
        for known in (True, False):
            mine = [f for f in found if (f.model, f.known) == (model, known)]
            if mine:
                values = np.quantile([f.pattern_px for f in mine], [0.5, 0.9, 1.0])
                least = min(f.told_px for f in mine)
                rows.append((model, "EXIF" if known else "none", len(mine), *values, least))
    sys.stdout.write(
        table(rows, ("lens", "known by", "photos", "median px", "90 %", "most", "least told px"))
    )
    worst = sorted(found, key=lambda f: -f.error_m)[:_WORST]
    sys.stdout.write(
        "\n"
        + table(
            [(f.name, f.model, f.told_px, 100.0 * f.off_rel, f.error_m) for f in worst],
            ("photo", "lens", "told px", "focal off %", "off m"),
        )
        + "\n"
    )
    return 0


def photos(database: Database, world: Path) -> list[Told]:
    """The photos of grown maps that have a true place."""
    album = open_album(world)
    snapshot = database.snapshot()
    errors = {(r.map_id, r.fact.name): r for r in registered(database, album) if r.offset_m is not None}
    found: list[Told] = []
    for map_id in sorted({m for m, _ in errors}):
        feature_map = snapshot.load_map(map_id)
        if feature_map.generation == 0:
            continue
        mine = [r for (m, _), r in errors.items() if m == map_id]
        if len(mine) != len(feature_map.images):
            continue  # photos of elsewhere among them
        points = feature_map.points_local(feature_map.frame)
        seen = feature_map.observations
        for image, r in zip(feature_map.images, mine, strict=True):
            camera = feature_map.cameras[image.camera_id]
            own = np.flatnonzero(seen.image_id == image.image_id)
            told = told_px(
                camera, image.cam_from_local, points[seen.point_index[own]], seen.xy[own].astype(np.float64)
            )
            found.append(
                Told(
                    name=r.fact.name,
                    model=camera.model,
                    known=bool(feature_map.camera_keys[image.camera_id]),
                    told_px=told,
                    off_rel=camera.focal_px / album.truth.images[r.fact.name].camera.focal_px - 1.0,
                    error_m=r.error_m,
                )
            )
    return found


def told_px(camera: Camera, pose: Rigid3, points: FloatArray, pixels: FloatArray) -> float:
    """RMS pixels that are left of a focal length off by its own size once the pose has moved along."""
    count = len(points)
    nothing = np.zeros(count, dtype=np.int64)
    linear = linearise([camera], nothing[:1], [pose], points, np.arange(count), nothing, pixels)
    good = np.isfinite(linear.by_pose).all(axis=(1, 2))
    by_pose = linear.by_pose[good].reshape(-1, 6)
    by_focal = (pixels[good] - camera.project(np.array([[0.0, 0.0, 1.0]]))).reshape(-1)
    left = by_focal - by_pose @ np.linalg.lstsq(by_pose, by_focal, rcond=None)[0]
    return float(np.sqrt((left**2).sum() / max(int(good.sum()), 1)))


if __name__ == "__main__":
    sys.exit(main())
