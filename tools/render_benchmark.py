"""How fast a point cloud is drawn, stage by stage: frames of a flight over millions of points.

    uv run python tools/render_benchmark.py [--points 5000000] [--frames 12] [--size 1280 720] [--threads 1 2]

A scan of a rolling landscape with blocks of houses, a million square metres by default, is flown over at 80 m
with a lens that distorts, straight down, obliquely and towards the horizon. Wall time and processor time are
medians over the frames of a flight, beside the least wall time; the stages are timed in the process itself.
Processor time divided by the threads is what the wall time would be on an idle machine.

Exit code 0 if every flight makes ten frames a second, by processor time per thread, on the most threads asked
for.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from statistics import median

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.levels import build_cloud
from featuredb.render.renderer import RenderClock, RenderOptions, render
from featuredb.simworld.shot import look_pose

MIN_FRAMES_PER_S = 10.0
FLIGHTS = (("nadir", -90.0), ("oblique", -45.0), ("towards the horizon", -15.0))


def landscape(points: int, density_per_m2: float, seed: int) -> FloatArray:
    """(n, 3) points of hills with blocks of houses on them, metres, seen from above and on the walls."""
    rng = np.random.default_rng(seed)
    side = np.sqrt(0.9 * points / density_per_m2)
    xy = rng.uniform(-0.5 * side, 0.5 * side, (points, 2))
    roof = 8.0 * ((np.abs(xy % 60.0 - 30.0) < 10.0).all(axis=1))
    z = 6.0 * np.sin(xy[:, 0] / 90.0) * np.cos(xy[:, 1] / 70.0) + roof
    walls = rng.random(points) < 0.1
    corner = 60.0 * np.floor(xy[walls] / 60.0)
    along, face = rng.uniform(20.0, 40.0, walls.sum()), rng.integers(4, size=walls.sum())
    across = np.where(face % 2 == 0, 20.0, 40.0)
    xy[walls] = corner + np.where(
        (face < 2)[:, None], np.column_stack([along, across]), np.column_stack([across, along])
    )
    ground = 6.0 * np.sin(xy[walls, 0] / 90.0) * np.cos(xy[walls, 1] / 70.0)
    z[walls] = ground + rng.uniform(0.0, 8.0, walls.sum())
    return np.column_stack([xy, z + rng.normal(0.0, 0.02, points)])


def make_cloud(points: int, density_per_m2: float) -> PointCloud:
    rng = np.random.default_rng(1)
    xyz = landscape(points, density_per_m2, seed=1)
    start = time.process_time()
    cloud = build_cloud(
        LocalFrame(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0),
        "unknown",
        xyz,
        rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
        intensity=rng.integers(0, 256, points, dtype=np.uint8),
    )
    print(
        f"{points} points, {density_per_m2:g} per m2, {len(cloud.nodes)} nodes of "
        f"{cloud.nodes.level.max() + 1} levels, ordered in {time.process_time() - start:.1f} s"
    )
    return cloud


def flight(pitch: float, frames: int, reach_m: float) -> list[Rigid3]:
    """Poses along a line at 80 m, turning slowly."""
    return [
        look_pose((s * reach_m, 0.4 * s * reach_m, 80.0), 40.0 + 60.0 * s, pitch)
        for s in np.linspace(-0.5, 0.5, frames)
    ]


def time_flight(
    cloud: PointCloud, camera: Camera, poses: Sequence[Rigid3], options: RenderOptions
) -> tuple[str, float]:
    """A row of the table, and the processor seconds of a frame."""
    rows: list[tuple[float, float, int, dict[str, float]]] = []
    for pose in poses:
        clock = RenderClock()
        wall, cpu = time.perf_counter(), time.process_time()
        rendering = render(cloud, camera, pose, options, clock)
        total = time.perf_counter() - wall, time.process_time() - cpu
        rows.append((*total, rendering.points_drawn, clock.seconds))
    wall, cpu, drawn = median(r[0] for r in rows), median(r[1] for r in rows), median(r[2] for r in rows)
    least = min(r[0] for r in rows)
    # Frames that see nothing, or only points close together, have fewer stages.
    names = max((r[3] for r in rows), key=len)
    stages = {name: median(r[3].get(name, 0.0) for r in rows) for name in names}
    parts = ", ".join(f"{name} {1e3 * s:.0f}" for name, s in stages.items())
    return f"{drawn / 1e3:.0f} | {1e3 * wall:.0f} | {1e3 * least:.0f} | {1e3 * cpu:.0f} | {parts} |", cpu


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--density", type=float, nargs="+", default=[8.0, 50.0], help="points per m2")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    args = parser.parse_args(argv)
    width, height = args.size
    params = (0.73 * width, 0.73 * width, 0.5 * width, 0.5 * height, -0.06, 0.02, 4e-4, -3e-4)
    camera = Camera(model="OPENCV", width=width, height=height, params=params)
    slowest = 0.0
    for density in args.density:
        cloud = make_cloud(args.points, density)
        reach_m = 0.6 * float(np.sqrt(args.points / density))
        render(cloud, camera, flight(-45.0, 1, reach_m)[0])  # compiled once, outside the clock
        print("\n| flight | threads | 1000 points drawn | wall ms | least | processor ms | stages, wall ms |")
        print("|---|---|---|---|---|---|---|")
        for name, pitch in FLIGHTS:
            for threads in args.threads:
                poses = flight(pitch, args.frames, reach_m)
                row, cpu = time_flight(cloud, camera, poses, RenderOptions(threads=threads))
                print(f"| {name} | {threads} | {row}", flush=True)
                if threads == max(args.threads):
                    slowest = max(slowest, cpu / threads)
        print()
    print(f"slowest flight: {1 / slowest:.1f} frames/s by processor time per thread")
    return 0 if slowest < 1.0 / MIN_FRAMES_PER_S else 1


if __name__ == "__main__":
    sys.exit(main())
