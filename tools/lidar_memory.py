"""Peak memory and speed of `featuredb lidar add` for a scan of any size, which it makes first.

The scan is an airborne one of a rolling land with houses and trees, written strip by strip as LAS 1.4, so
that making it needs little memory, too. The command runs in a process of its own; the memory of that process
and all its children (what they share counts once) is sampled ten times a second.
"""

import shutil
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from tools.commands import cost_of, once
from tools.figures import study_parser, write_figures

CHUNK = 500_000
EPSG = 32632
WEST, SOUTH = 560_000.0, 5_930_000.0
SAMPLE_S = 0.1
_PER_M2 = 20.0  # points per square metre


def make_scan(path: Path, points: int) -> None:
    """Write a scan of a square, in strips from west to east."""
    rng = np.random.default_rng(1)
    side = float(np.sqrt(points / _PER_M2))
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([WEST, SOUTH, 0.0])
    header.vlrs.append(WktCoordinateSystemVlr(CRS.from_epsg(EPSG).to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    with laspy.open(path, mode="w", header=header) as writer:
        for start in range(0, points, CHUNK):
            n = min(CHUNK, points - start)
            east = side * (start + n * rng.random(n)) / points
            north = side * rng.random(n)
            height, label, value = _surface(rng, east, north)
            record = laspy.ScaleAwarePointRecord.zeros(n, header=header)
            record.x, record.y, record.z = WEST + east, SOUTH + north, height
            record.classification = label
            record.intensity = value
            for name, gain in (("red", 250), ("green", 230), ("blue", 200)):
                setattr(record, name, (value.astype(np.uint32) * gain % 65536).astype(np.uint16))
            writer.write_points(record)


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
