"""Peak memory and speed of `featuredb lidar add` for a scan of any size, which it makes first.

The scan is an airborne one of a rolling land with houses and trees, written strip by strip as LAS 1.4, so
that making it needs little memory, too. The command runs in a process of its own; the memory of that process
and all its children (what they share counts once) is sampled ten times a second.
"""

import shutil
from datetime import date
from pathlib import Path

import numpy as np

from featuredb.geo.crs.wkt import utm_wkt
from featuredb.lidar.formats.las_stream import LasStream
from tools.commands import cost_of, once
from tools.figures import study_parser, write_figures

CHUNK = 500_000
EPSG = 32632
WEST, SOUTH = 560_000.0, 5_930_000.0
SAMPLE_S = 0.1
_PER_M2 = 20.0  # points per square metre
_COLOUR = np.array([1.0, 0.92, 0.8])  # red, green, blue of an intensity
_DAY = date(2025, 4, 2)


def make_scan(path: Path, points: int) -> None:
    """Write a scan of a square, in strips from west to east."""
    rng = np.random.default_rng(1)
    side = float(np.sqrt(points / _PER_M2))
    offset = np.array([WEST, SOUTH, 0.0])
    with LasStream(path, utm_wkt(EPSG, "ellipsoidal"), offset=offset, step_m=0.001, day=_DAY) as stream:
        for start in range(0, points, CHUNK):
            n = min(CHUNK, points - start)
            east = side * (start + n * rng.random(n)) / points
            north = side * rng.random(n)
            height, label, value = _surface(rng, east, north)
            utm = offset + np.column_stack([east, north, height])
            rgb = (value[:, None] * _COLOUR).astype(np.uint8)
            stream.write(utm, {"classification": label, "intensity": value}, rgb)


def _surface(
    rng: np.random.Generator, east: np.ndarray, north: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height, class and intensity: hills, a house on every second block of 40 m, trees, strays."""
    height = 40.0 + 8.0 * np.sin(east / 173.0) * np.cos(north / 131.0) + rng.normal(0.0, 0.02, len(east))
    label = np.full(len(east), 2, np.uint8)
    value = (120 + 40 * np.sin(east / 7.0) + rng.normal(0, 8, len(east))).clip(1, 255)
    block = (east // 40).astype(int) * 7 + (north // 40).astype(int) * 13
    house = (block % 2 == 0) & (east % 40 > 12) & (east % 40 < 26) & (north % 40 > 10) & (north % 40 < 22)
    height[house] += 6.0
    label[house] = 6
    tree = (block % 3 == 1) & (np.hypot(east % 40 - 20, north % 40 - 30) < 5)
    height[tree] += 9.0 * rng.random(int(tree.sum()))
    label[tree] = 5
    astray = rng.random(len(east)) < 5e-5
    height[astray] += rng.uniform(30, 60, int(astray.sum()))
    return height, label, value.astype(np.uint16)


def main() -> None:
    """Make the scan unless it is there, add it to a fresh database, print what it took as JSON."""
    parser = study_parser(__doc__)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--folder", type=Path, required=True, help="for the scan and the database")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    scan = once(args.folder / f"scan-{args.points}.las", lambda path: make_scan(path, args.points))
    database = args.folder / "scans.db"
    shutil.rmtree(database, ignore_errors=True)
    words = ("lidar", "add", str(database), str(scan), "--quiet")
    cost = cost_of("-m", "featuredb.cli", *words, sample_s=SAMPLE_S)
    a_second = args.points / cost.seconds
    figures = {"peak_tree_mib": cost.tree_mib, "cpu_seconds": cost.seconds, "points_per_cpu_second": a_second}
    write_figures(args.json, figures)


if __name__ == "__main__":
    main()
