"""A map without a place, placed on a scan by six picks in one photo: how often, and how right?

    python -m tools.unplaced_brighton --photos FOLDER --scan SCAN.laz --poses poses.json --work FOLDER

1. The photos but the held-out ones, without any position, become one map without a place.
2. Each draw picks six points of the scan in one photo of the map, with the given error in pixels, and
   `featuredb anchor --picks` places a copy of the map by them. True pixels come from the poses that
   tools/scan_poses.py finds by the scan alone (kept in the file of --poses).
3. The held-out photos are asked of the placed map and compared with those poses.

A draw is placed, refused, or wrong: placed with the held-out photos a metre off or not answered. A run that
was stopped goes on in --work.
"""

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from featuredb.store import Database
from tools.commands import anchor, featuredb, newest_copy
from tools.figures import write_figures
from tools.made_maps import copied, make, photo_names
from tools.picked import Scan, picks, read_scan, write_picks
from tools.real_photos import ask_poses, error_figures
from tools.scan_truth import ScanTruth, scan_parser, scan_truth

HELD_OUT = ("DJI_0020.JPG", "DJI_0025.JPG", "DJI_0030.JPG", "DJI_0033.JPG")
_MADE = "made.json"  # what came of the photos; who starts again goes on from there
_WRONG_M = 1.0
_DRAWS, _SEED = 20, 1
_SIGMA_PX = 3.0  # of a pick, each axis


def main() -> None:
    args = scan_parser(__doc__, "--work").parse_args()
    truth = scan_truth(args)
    scan = read_scan(args.scan, truth.frame, truth.epsg)
    work: Path = args.work
    figures: dict[str, object] = {"draws": _DRAWS, **unplaced_map(args.photos, work)}
    if not (work / "scanned").exists():
        featuredb("lidar", "add", str(work / "db"), str(args.scan), "--quiet")
        (work / "scanned").touch()
    (summary, *_) = Database.open(work / "db").snapshot().unplaced_maps()
    draw = partial(_draw, work=work, map_id=summary.map_id, scan=scan, truth=truth)
    write_figures(args.json, figures | summed(all_drawn("draw", _DRAWS, draw, work), _DRAWS))


def all_drawn(
    name: str, draws: int, draw: Callable[[int], dict[str, float] | None], work: Path
) -> list[dict[str, float]]:
    """What comes of each draw that is not refused; `work` keeps them, so that who starts again goes on."""
    placed = []
    for number in range(draws):
        done = work / f"{name}-{number}.json"
        if not done.exists():
            done.write_text(json.dumps(draw(number)), encoding="utf-8")
        one = json.loads(done.read_text(encoding="utf-8"))
        sys.stdout.write(f"{name} {number}: {one or 'refused'}\n")
        sys.stdout.flush()
        placed += [one] if one else []
    return placed


def _draw(number: int, work: Path, map_id: str, scan: Scan, truth: ScanTruth) -> dict[str, float] | None:
    """Place a copy of the map by the picks of one draw: errors of the held-out photos, or None: refused."""
    rng = np.random.default_rng((_SEED, number))
    photos = work / "photos"
    image = str(rng.choice([name for name in photo_names(photos) if name in truth.poses]))
    drawn = picks(scan, truth.cameras[image], truth.poses[image], rng, _SIGMA_PX)
    file = write_picks(work / f"picks-{number}.csv", image, *drawn)
    database = newest_copy(work / "db", work / "placed")
    return placed_by(database, map_id, work, truth, "--picks", str(file), "--image", image)


def unplaced_map(photos: Path, work: Path) -> dict[str, object]:
    """Photos but the held-out ones, without positions, as a map in `work`/db; how many maps came."""
    names = [name for name in photo_names(photos) if name not in HELD_OUT]
    if not (work / _MADE).exists():
        without = copied(photos, names, work / "photos", strip=True)
        copied(photos, HELD_OUT, work / "asked", strip=True)
        made = make(work / "db", "photos", without)
        write_figures(work / _MADE, {"maps": made.maps, "largest": made.largest})
    told: dict[str, object] = json.loads((work / _MADE).read_text(encoding="utf-8"))
    return {"photos": len(names), **told}


def placed_by(
    database: Path, map_id: str, work: Path, truth: ScanTruth, *start: str
) -> dict[str, float] | None:
    """Place the map by `featuredb anchor` and its arguments: errors of the held-out photos; None: refused."""
    # 1: the map is not placed. 2: where it starts from is open, before anything is tried.
    if not anchor(database, map_id, work / "photos", database.parent / "anchor", *start, refusals=(1, 2)):
        return None
    asked = ask_poses(Database.open(database), work / "asked", HELD_OUT, truth.frame, truth.poses)
    return error_figures(asked)


def summed(placed: Sequence[dict[str, float]], draws: int) -> dict[str, float]:
    """How many were placed, refused, wrong; medians over the draws, and the worst draw's."""
    nothing = float("nan")
    metres = [one["median_m"] for one in placed] or [nothing]
    degrees = [one["median_deg"] for one in placed] or [nothing]
    wrong = [one for one in placed if not one["median_m"] <= _WRONG_M or one["answered"] < one["asked"]]
    return {
        "placed": len(placed),
        "refused": draws - len(placed),
        "wrong": len(wrong),
        "median_m": float(np.median(metres)),
        "worst_m": max(metres),
        "median_deg": float(np.median(degrees)),
        "worst_deg": max(degrees),
    }


if __name__ == "__main__":
    main()
