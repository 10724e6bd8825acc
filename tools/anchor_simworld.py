"""The simulated world end to end: photos, scan, anchoring without a person, queries against the truth.

    python -m tools.anchor_simworld --work DIR [--inputs DIR] [--seed N]

1. `featuredb simworld --lidar` writes photos whose GPS has a drone's errors, an airborne scan with
   intensities only, an ortho image of another day, and the same of another town at the same place.
2. `featuredb ingest photos` places the map by GPS; `featuredb lidar add` adds the scan.
3. `featuredb anchor --auto` places the map on the scan of the other town, which it must refuse, and then on
   its own.
4. The map's cameras and the held-out queries are compared with the truth, before and after.

Exit code 0 if the map was placed, and the other town's scan was refused.
"""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.scoring import PoseError, pose_difference
from featuredb.simworld.truth import Truth
from featuredb.store import Database
from reloc.client import Client
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from tools.figures import study_parser, write_figures
from tools.worlds.scan_world import ScanWorld, make_scan_world

_ROOT = Path(__file__).resolve().parent.parent


def main(argv: Sequence[str] | None = None) -> int:
    parser = study_parser(__doc__, "--work", "--inputs")
    parser.add_argument("--seed", type=int, default=1, help="of the world; default: 1")
    args = parser.parse_args(argv)
    work: Path = args.work
    world = make_scan_world(args.inputs or work, args.seed)
    mapped = work / "mapped"
    if not mapped.exists():
        featuredb("ingest", "photos", str(mapped), str(world.world.folder / "drone"), "--quiet")
    refused = anchored(work, mapped, world, other=True)[1]
    database, placed = anchored(work, mapped, world, other=False)
    queries = world.world.images("queries")
    figures: dict[str, float] = {"placed": int(placed), "other_placed": int(refused)}
    for name, path in (("gps", mapped), ("scan", database)):
        found = judged(Database.open(path), world.world.truth, queries)
        figures |= {f"{name}_{key}": value for key, value in found.items()}
    write_figures(args.json, figures)
    return 0 if placed and not refused else 1


def anchored(work: Path, mapped: Path, world: ScanWorld, *, other: bool) -> tuple[Path, bool]:
    """A copy of the database with one of the scans, anchored; and whether the map was placed."""
    database = work / f"anchored-{'other' if other else 'own'}-intensity"
    shutil.rmtree(database, ignore_errors=True)
    shutil.copytree(mapped, database)
    featuredb("lidar", "add", str(database), str(world.other_scan if other else world.scan))
    map_id = Database.open(database).snapshot().maps()[0].map_id
    photos, out = world.world.folder / "drone", work / f"{database.name}-report"
    words = ("anchor", str(database), map_id, "--photos", str(photos), "--out", str(out), "--auto", "--quiet")
    return database, featuredb(*words, may_refuse=True) == 0


def judged(database: Database, truth: Truth, queries: Sequence[Path]) -> dict[str, float]:
    """Errors of the map's cameras and of what is answered to queries."""
    snapshot = database.snapshot()
    metres, degrees = camera_errors(snapshot.load_map(snapshot.maps()[0].map_id), truth)
    answers = ask(database, truth, queries)
    asked_m = [e.position_m for e in answers] or [float("nan")]
    return {
        "cameras_m": float(np.median(metres)),
        "cameras_deg": float(np.median(degrees)),
        "cameras_largest_m": float(metres.max()),
        "queries": len(queries),
        "answered": len(answers),
        "queries_m": float(np.median(asked_m)),
        "queries_largest_m": max(asked_m),
    }


def ask(database: Database, truth: Truth, photos: Sequence[Path]) -> list[PoseError]:
    """Errors of what a server answers to photos of the world."""
    with (
        start_server(database, ServeOptions(listen=("tcp/127.0.0.1:0",))) as server,
        Client(server.endpoints[0]) as client,
    ):
        replies = {photo: client.localise(photo, timeout_s=60.0).utm for photo in photos}
    return [
        pose_difference(
            truth.frame,
            truth.images[f"{photo.parent.name}/{photo.name}"].cam_from_local,
            utm.epsg,
            (utm.easting, utm.northing, utm.height),
            utm.cam_from_utm_xyzw,
        )
        for photo, utm in replies.items()
        if utm is not None
    ]


def camera_errors(feature_map: FeatureMap, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees between the map's images and the truth."""
    truth_from_map = truth.frame.enu_from(feature_map.frame)
    metres, degrees = [], []
    for image in feature_map.images:
        true = truth.images[f"drone/{image.name}"].cam_from_local
        pose = image.cam_from_local @ truth_from_map.inverse()
        metres.append(float(np.linalg.norm(pose.center - true.center)))
        degrees.append(pose.angle_to_deg(true))
    return np.array(metres), np.array(degrees)


def featuredb(*words: str, may_refuse: bool = False, refusals: Sequence[int] = (1,)) -> int:
    """Run a command of featuredb and show what it says; `refusals` are answers where it may refuse."""
    sys.stdout.write(f"$ featuredb {' '.join(words)}\n")
    sys.stdout.flush()
    if words[0] == "ingest":  # it makes a database, but no folders around it
        Path(words[2]).parent.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", "featuredb.cli", *words],
        cwd=_ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    sys.stdout.write(done.stdout)
    if done.returncode != 0 and not (may_refuse and done.returncode in refusals):
        raise SystemExit(f"exit code {done.returncode}\n{done.stderr}")
    sys.stdout.write(done.stderr if done.returncode > 1 else "")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
