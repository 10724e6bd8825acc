"""How much memory the export of a large database takes: 20 million simulated points as a dataset.

    python -m tools.export_scale --out DIR [--points 20000000] [--map-points 200000] [--seed 0] [--check]

Makes a database of random maps with the statistics of real ones, committed map by map, then exports it in a
process of its own. The maps have no geometry, only the sizes: what is measured does not look at it. With
--check the dataset is read back and its maps are compared with the database by their digests.

Prints the peak of the memory of that process and its children (proportional shares, sampled ten times a
second), megabytes a second, and bytes for each point. Exit code 0 if the peak is under 2 GiB. A database that
is there already is used again.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.export.dataset import read_dataset, write_dataset
from featuredb.export.job import ExportJob, size_of
from featuredb.export.selection import Selection
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapImage, MapObservations, MapPoints, Placement
from featuredb.store import Database
from featuredb.store.encode import content_digest
from tools.growth_scale import family, memory

_PEAK_GIB = 2.0
_SAMPLE_S = 0.1
# Between those of a map of 17 photos of Brighton (2.7 photos see a point, 780 points for each photo, 56 % of
# the observations have a descriptor) and those of one of 131 simulated photos (4.2, 1,030, 82 %).
_VIEWS, _POINTS_PER_PHOTO, _WITH_DESCRIPTOR = 3.7, 950, 0.75
_EXTENT_M = 800.0
_EPSG, _DATUM = 32632, "egm2008"


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database, out = args.out / f"db-{args.points}-{args.map_points}-{args.seed}", args.out / "dataset"
    if args.export:
        return export(database, out)
    args.out.mkdir(parents=True, exist_ok=True)
    made_s = make(database, args.points, args.map_points, args.seed)
    sys.stdout.write(
        f"database: {args.points:,} points, {size_of(database) / 1e6:,.0f} MB, made in {made_s:.0f} s\n"
    )
    if out.exists():
        raise SystemExit(f"{out}: expected a free name, found a dataset; remove it")
    words = [f"--{name}={getattr(args, name)}" for name in ("points", "seed", "out")]
    command = [
        sys.executable,
        "-m",
        "tools.export_scale",
        "--export",
        f"--map-points={args.map_points}",
        *words,
    ]
    started = time.monotonic()
    peak = 0
    with subprocess.Popen(command) as process:
        while process.poll() is None:
            peak = max(peak, sum(memory(pid) for pid in family(process.pid)))
            time.sleep(_SAMPLE_S)
    wall_s = time.monotonic() - started
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    size = size_of(out)
    gib = peak / 2**30
    holds = gib < _PEAK_GIB
    sys.stdout.write(
        f"dataset: {size / 1e6:,.0f} MB in {wall_s:.0f} s, {size / 1e6 / wall_s:.1f} MB/s, "
        f"{size / args.points:.0f} bytes per point\n"
        f"peak memory: {gib:.2f} GiB, under {_PEAK_GIB:g} wanted: {'holds' if holds else 'FAILS'}\n"
    )
    if args.check:
        holds = same(database, out) and holds
    return 0 if holds else 1


def export(database: Path, out: Path) -> int:
    """What runs in a process of its own."""
    opened = Database.open(database)
    done = write_dataset(
        ExportJob(database=opened, snapshot=opened.snapshot(), selection=Selection(), out=out)
    )
    sys.stdout.write(f"{done.maps} maps, {done.images:,} images, {done.observations:,} observations\n")
    return 0


def same(database: Path, out: Path) -> bool:
    """Whether the dataset reads back as the maps of the database."""
    wanted = {m.map_id: m.content_digest for m in Database.open(database).snapshot().maps()}
    found = {m.map_id: content_digest(m) for m in read_dataset(out)}
    sys.stdout.write(
        f"read back: {sum(found.get(m) == d for m, d in wanted.items())} of {len(wanted)} maps the same\n"
    )
    return found == wanted


def make(folder: Path, points: int, map_points: int, seed: int) -> float:
    """Commit maps until there are enough points; returns the seconds that it took."""
    started = time.monotonic()
    database = Database.create(folder)
    there = {m.map_id for m in database.snapshot().maps()}
    for number in range(-(-points // map_points)):
        if f"map-{number:05d}" not in there:
            count = min(map_points, points - number * map_points)
            database.commit_map(simulated_map(number, count, seed))
    return time.monotonic() - started


def simulated_map(number: int, points: int, seed: int) -> FeatureMap:
    """A random map of so many points in a square of its own."""
    rng = np.random.default_rng((seed, number))
    row, column = divmod(number, 20)
    frame = LocalFrame.from_utm(400_000.0 + column * _EXTENT_M, 5_400_000.0 + row * _EXTENT_M, 100.0, _EPSG)
    images = max(2, points // _POINTS_PER_PHOTO)
    camera = Camera(model="SIMPLE_RADIAL", width=4000, height=3000, params=(3200.0, 2000.0, 1500.0, -0.02))
    local = rng.uniform(-0.5, 0.5, (points, 3)) * [_EXTENT_M, _EXTENT_M, 60.0]
    views = 2 + rng.poisson(_VIEWS - 2, points)
    return FeatureMap(
        map_id=f"map-{number:05d}",
        name=f"square {number}",
        epsg=_EPSG,
        height_datum=_DATUM,
        frame=frame,
        cameras=(camera,),
        images=tuple(_image(rng, number, k) for k in range(images)),
        points=MapPoints(
            utm=frame.utm_from_enu(local, _EPSG),
            rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
            track_length=views.astype(np.int32),
            error_px=rng.gamma(2.0, 0.3, points).astype(np.float32),
            covariance=rng.normal(0, 0.01, (points, 6)).astype(np.float32),
        ),
        observations=_observations(rng, views, images),
        placement=Placement(
            method="gps",
            local_from_sfm=Sim3.identity(),
            covariance=np.diag([1e-6] * 4 + [0.04] * 3),
            residual_rms_m=1.2,
            evidence={"photos": images},
        ),
        extractor_fingerprint="rootsift-simulated",
        licence="CC0-1.0",
    )


def _image(rng: np.random.Generator, number: int, image_id: int) -> MapImage:
    place = rng.uniform(-_EXTENT_M / 2, _EXTENT_M / 2, 3)
    return MapImage(
        image_id=image_id,
        name=f"flight-{number:05d}/{image_id:05d}.jpg",
        sha256=rng.bytes(32).hex(),
        camera_id=0,
        cam_from_local=Rigid3.exp(np.concatenate([rng.normal(0, 1, 3), place])),
        covariance=np.diag(rng.gamma(2.0, 1e-4, 6)),
        gps=GeoPrior(
            latitude_deg=48.7,
            longitude_deg=7.6,
            height_m=150.0,
            sigma_horizontal_m=3.0,
            sigma_vertical_m=7.0,
        ),
    )


def _observations(rng: np.random.Generator, views: NDArray[np.int64], images: int) -> MapObservations:
    count = int(views.sum())
    has = rng.random(count) < _WITH_DESCRIPTOR
    # RootSIFT's values are mostly small: compression should find what it would find in real ones.
    values = np.minimum(np.random.default_rng(0).gamma(0.6, 50.0, 4096), 255).astype(np.uint8)
    descriptors = values[rng.integers(0, 4096, (count, 128), dtype=np.uint16)]
    descriptors[~has] = 0
    return MapObservations(
        point_index=np.repeat(np.arange(len(views), dtype=np.int64), views),
        image_id=rng.integers(0, images, count).astype(np.int32),
        xy=(rng.random((count, 2), dtype=np.float32) * [4000, 3000]).astype(np.float32),
        scale=rng.gamma(2.0, 3.0, count).astype(np.float32),
        angle=(rng.random(count, dtype=np.float32) * 360).astype(np.float32),
        has_descriptor=has,
        descriptors=descriptors,
    )


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("export-scale"))
    parser.add_argument("--points", type=int, default=20_000_000)
    parser.add_argument("--map-points", type=int, default=200_000, help="in each map (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--check", action="store_true", help="read the dataset back and compare")
    parser.add_argument("--export", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
