"""A map without a place, placed on a scan by six picks in one photo, or found near a point: how right?

1. The photos but the held-out ones, without any position, become one map without a place.
2. Each draw picks six points of the scan in one photo of the map, with 3 px of error, and
   `featuredb anchor --picks` places a copy of the map by them. True pixels come from the poses that
   tools/scan_poses.py finds by the scan alone (kept in the file of --poses).
3. The held-out photos are asked of the placed map and compared with those poses.

With --near each draw names a point 100 m from the middle of the scan in a random direction, and
`featuredb anchor --near` places the copy within 250 m: ten draws on the scan with its colours, ten on one
whose intensities are its grey values, and ten on a mirrored scan, which is no place on Earth.

A draw is placed, refused, or wrong: placed with the held-out photos a metre off or not answered. A run that
was stopped goes on in --work.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import laspy
import numpy as np

from featuredb.geo.utm import geodetic_from_utm
from featuredb.store import Database
from featuredb.store.scans import list_scans
from tools.commands import anchor, make, newest_copy, with_scan
from tools.figures import kept, spread, write_figures
from tools.photo_files import copied, photo_names
from tools.picked import Seen, read_scan, write_picks
from tools.real_photos import ask_poses, error_figures
from tools.scan_poses import ScanTruth, scan_parser, scan_truth

HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")
_WRONG_M = 1.0
_DRAWS, _NEAR_DRAWS, _SEED = 20, 10, 1
_KINDS = ("colour", "intensity", "mirrored")
_AWAY_M, _RADIUS_M = 100.0, 250.0
_GREY = np.array([0.299, 0.587, 0.114])
_WITHOUT_COLOUR = 1  # of the point formats of LAS


def main() -> None:
    parser = scan_parser(__doc__, "--work")
    parser.add_argument("--near", action="store_true", help="near a point, without picks")
    args = parser.parse_args()
    figures = unplaced_map(args.photos, args.work)
    write_figures(args.json, figures | (found_near if args.near else by_picks)(args, scan_truth(args)))


def by_picks(args: argparse.Namespace, truth: ScanTruth) -> dict[str, float]:
    """What comes of copies of the map that are placed by picks in a photo."""
    scan, work = read_scan(args.scan, truth.frame, truth.epsg), args.work
    made = with_scan(work / "db", args.scan, work / "scanned")
    names = [name for name in photo_names(work / "photos") if name in truth.poses]

    def draw(number: int) -> dict[str, float] | None:
        rng = np.random.default_rng((_SEED, number))
        image = str(rng.choice(names))
        seen = Seen(image=image, camera=truth.cameras[image], cam_from_local=truth.poses[image])
        file = write_picks(work / f"picks-{number}.csv", scan, seen, rng)
        return placed_by(made, work, truth, "--picks", str(file), "--image", image)

    return {"draws": _DRAWS, **summed(all_drawn("draw", _DRAWS, draw, work), _DRAWS)}


def found_near(args: argparse.Namespace, truth: ScanTruth) -> dict[str, float]:
    """What comes of copies of the map that are looked for near a point, on three scans."""
    figures: dict[str, float] = {"draws": _NEAR_DRAWS}
    for kind in _KINDS:
        made = with_scan(args.work / "db", scan_of(kind, args.scan, args.work), args.work / kind)

        def draw(number: int, made: Path = made) -> dict[str, float] | None:
            return placed_by(made, args.work, truth, near_words(made, number))

        placed = all_drawn(kind, _NEAR_DRAWS, draw, args.work)
        figures |= {f"{kind}_{name}": value for name, value in summed(placed, _NEAR_DRAWS).items()}
    return figures


def all_drawn(
    name: str, draws: int, draw: Callable[[int], dict[str, float] | None], work: Path
) -> list[dict[str, float]]:
    """What comes of each draw that is not refused; `work` keeps them, so that who starts again goes on."""
    found = [kept(work / f"{name}-{number}.json", partial(draw, number)) for number in range(draws)]
    return [one for one in found if one]


def unplaced_map(photos: Path, work: Path) -> dict[str, float]:
    """Photos but the held-out ones, without positions, as a map in `work`/db; how many maps came."""
    names = [name for name in photo_names(photos) if name not in HELD_OUT]

    def made() -> dict[str, float]:
        without = copied(photos, names, work / "photos", strip=True)
        copied(photos, HELD_OUT, work / "asked", strip=True)
        return make(work / "db", "photos", without)

    told = kept(work / "made.json", made)
    return {"maps": told["maps"], "largest": told["largest"]}


def placed_by(made: Path, work: Path, truth: ScanTruth, *start: str) -> dict[str, float] | None:
    """Place a copy of the map by `featuredb anchor` and arguments: errors of the held-out photos, if any."""
    database = newest_copy(made, work / "placed")
    (summary, *_) = Database.open(database).snapshot().unplaced_maps()
    # 1: the map is not placed. 2: where it starts from is open, before anything is tried.
    if not anchor(database, summary.map_id, work / "photos", work / "anchor", *start, refusals=(1, 2)):
        return None
    asked = ask_poses(Database.open(database), work / "asked", HELD_OUT, truth.frame, truth.poses)
    return error_figures(asked)


def summed(placed: Sequence[dict[str, float]], draws: int) -> dict[str, float]:
    """How many were placed, refused, wrong; medians over the draws, and the worst draw's."""
    off = spread([one["median_m"] for one in placed], [one["median_deg"] for one in placed])
    return {
        "placed": len(placed),
        "refused": draws - len(placed),
        "wrong": sum(not one["median_m"] <= _WRONG_M or one["answered"] < one["asked"] for one in placed),
        **{name.replace("largest", "worst"): value for name, value in off.items()},
    }


def scan_of(kind: str, scan: Path, work: Path) -> Path:
    """The scan as it is, with grey values as intensities in place of colours, or mirrored in east."""
    if kind == "colour":
        return scan
    read = laspy.read(scan)
    if kind == "intensity":
        rgb = np.column_stack([read.red, read.green, read.blue])
        grey = rgb @ _GREY * (65535 / max(int(rgb.max()), 1))
        read = laspy.convert(read, point_format_id=_WITHOUT_COLOUR)
        read.intensity = np.asarray(np.minimum(grey, 65535), np.uint16)
    else:
        east = np.asarray(read.x)
        read.x = east.min() + east.max() - east
    path = work / f"{kind}.laz"
    read.write(path)
    return path


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
