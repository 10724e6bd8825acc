"""A map without a place, found on a scan within 250 m: how often, and how right?

    python -m tools.unplaced_near --photos FOLDER --scan SCAN.laz --poses poses.json --work FOLDER

The photos but the held-out ones, without any position, become one map without a place. Each draw names a
point 100 m from the middle of the scan in a random direction, and `featuredb anchor --near` places a copy of
the map; ten draws on the scan with its colours, ten on one whose intensities are its grey values. Then ten on
a mirrored scan, which is no place on Earth: nothing may be placed. The held-out photos are asked of each
placed map and compared with the poses that tools/scan_poses.py finds.
"""

import shutil
from functools import partial
from pathlib import Path

import laspy
import numpy as np

from featuredb.geo.utm import geodetic_from_utm
from featuredb.store import Database
from featuredb.store.scans import list_scans
from tools.commands import featuredb, newest_copy
from tools.figures import write_figures
from tools.scan_truth import ScanTruth, scan_parser, scan_truth
from tools.unplaced_brighton import all_drawn, placed_by, summed, unplaced_map

_KINDS = ("colour", "intensity", "mirrored")
_DRAWS, _SEED = 10, 1
_AWAY_M, _RADIUS_M = 100.0, 250.0
_GREY = np.array([0.299, 0.587, 0.114])


def main() -> None:
    args = scan_parser(__doc__, "--work").parse_args()
    truth = scan_truth(args)
    work: Path = args.work
    figures: dict[str, object] = {"draws": _DRAWS, **unplaced_map(args.photos, work)}
    for kind in _KINDS:
        database = work / kind
        if not database.exists():
            shutil.copytree(work / "db", work / "making", dirs_exist_ok=True)
            featuredb("lidar", "add", str(work / "making"), str(scan_of(kind, args.scan, work)), "--quiet")
            (work / "making").rename(database)
        placed = all_drawn(kind, _DRAWS, partial(_draw, made=database, work=work, truth=truth), work)
        figures |= {f"{kind}_{name}": value for name, value in summed(placed, _DRAWS).items()}
    write_figures(args.json, figures)


def scan_of(kind: str, scan: Path, work: Path) -> Path:
    """The scan as it is, with grey values as intensities in place of colours, or mirrored in east."""
    if kind == "colour":
        return scan
    read = laspy.read(scan)
    made = laspy.LasData(laspy.LasHeader(point_format=6 if kind == "intensity" else 7, version="1.4"))
    made.header.offsets, made.header.scales = read.header.offsets, read.header.scales
    made.header.add_crs(read.header.parse_crs())
    xyz, rgb = np.asarray(read.xyz), np.column_stack([read.red, read.green, read.blue])
    if kind == "intensity":
        made.intensity = np.asarray(
            np.minimum(rgb @ _GREY * (65535 / max(int(rgb.max()), 1)), 65535), np.uint16
        )
    else:
        xyz[:, 0] = xyz[:, 0].min() + xyz[:, 0].max() - xyz[:, 0]
    made.x, made.y, made.z = xyz.T
    if kind == "mirrored":
        made.red, made.green, made.blue = rgb.T
    path = work / f"{kind}.laz"
    made.write(path)
    return path


def _draw(number: int, made: Path, work: Path, truth: ScanTruth) -> dict[str, float] | None:
    database = newest_copy(made, work / "placed")
    (summary, *_) = Database.open(database).snapshot().unplaced_maps()
    return placed_by(database, summary.map_id, work, truth, near_words(database, number))


def near_words(database: Path, number: int) -> str:
    """A circle whose middle lies in a random direction from the middle of a database's scan."""
    angle = np.random.default_rng((_SEED, number)).uniform(0.0, 2.0 * np.pi)
    (scan, *_) = list_scans(Database.open(database))
    box = scan.box
    middle = np.array([box.min_easting + box.max_easting, box.min_northing + box.max_northing]) / 2.0
    point = middle + _AWAY_M * np.array([np.cos(angle), np.sin(angle)])
    lat, lon, _ = geodetic_from_utm((*point, box.min_height), scan.epsg)
    return f"--near={lat:.7f},{lon:.7f},{_RADIUS_M:g}"


if __name__ == "__main__":
    main()
