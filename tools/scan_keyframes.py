"""How many pieces of a frame agree with a scan where a track has it: of the town, and of another one.

    python -m tools.scan_keyframes --out DIR [--size full] [--films smooth cut] [--frames 1200] [--every 24]

DIR, films and options are those of `tools.track_evaluation`. Every so many frames the pose that a track might
have (off by 0.3 m and 0.2 degrees to some side) is fitted to the scan and shown to the pictures, as
`ingest.track.scan_ground` does with a keyframe. Frames of the cut film that show another town are fitted from
where the flight would be. Prints the share of pieces that agree, what the fit is off by, and both limits.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.geometry.rigid3 import Rigid3
from featuredb.lidar.load import load_cloud
from featuredb.render.cloud import PointCloud
from featuredb.simworld.film_world import FILM_FILE, FilmOptions, FilmTruth, read_film_truth, write_film
from featuredb.simworld.flight_path import FlightPath
from featuredb.simworld.world import town_of
from featuredb.store import Database
from featuredb.store.scans import list_scans
from featuredb.video.film import VideoOptions
from featuredb.video.frames import open_video
from ingest.register.frame.candidates import available_sources
from ingest.register.frame.near import NearFit, fit_near
from ingest.register.frame_registration import FramePrior
from ingest.track.scan_ground import ScanTrackOptions
from tools.growth_common import table
from tools.track_evaluation import anchored_map, film_options

_OFF_M, _OFF_DEG = 0.3, 0.2


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database = Database.open(anchored_map(args.out, args.size, args.seed, args.workers))
    (scan,) = list_scans(database)
    rows: list[tuple[str, int, str, float, float, float]] = []
    for name in args.films:
        options = film_options(name, args.size, args.seed, args.frames)
        folder = write_film(args.out / f"film-{name}", options, args.workers)
        truth = read_film_truth(folder)
        cloud = load_cloud(database, truth.frame, scan_ids=[scan.scan_id])
        rows += shares(name, folder / FILM_FILE, truth, options, cloud, args.every)
    sys.stdout.write(table(rows, ("film", "frame", "shows", "agree", "off m", "s")) + "\n")
    own = ScanTrackOptions()
    for what in ("the town", "another town"):
        some = np.array([row[3] for row in rows if row[2] == what])
        if len(some):
            sys.stdout.write(
                f"{what}: {len(some)} frames, {some.min():.2f} to {some.max():.2f} agree, median "
                f"{np.median(some):.2f}; limit of a keyframe {own.near.confirm.min_agreeing:g}, "
                f"of a first pose {own.first.confirm.min_agreeing:g}\n"
            )
    return 0


def shares(
    name: str, film: Path, truth: FilmTruth, options: FilmOptions, cloud: PointCloud, every: int
) -> list[tuple[str, int, str, float, float, float]]:
    """A row for every so many frames of a film."""
    own = ScanTrackOptions()
    flight = replace(options.path, duration_s=options.frames / options.rate_hz)
    path = FlightPath(town_of(options.world), flight)
    source = available_sources(cloud)[0]
    rng = np.random.default_rng(3)
    rows = []
    with open_video(film, VideoOptions()) as video:
        for frame in video:
            if frame.index % every:
                continue
            true = path.pose(float(truth.times_s[frame.index]))
            side, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
            step = np.concatenate([np.radians(_OFF_DEG) * axis, _OFF_M * side])
            prior = FramePrior(
                cam_from_local=Rigid3.exp(step) @ true,
                sigma_horizontal_m=own.track_sigma_m,
                sigma_vertical_m=own.track_sigma_m,
                sigma_heading_deg=own.track_sigma_deg,
                sigma_tilt_deg=own.track_sigma_deg,
            )
            began = time.perf_counter()
            found = fit_near(frame.gray, truth.camera, prior, cloud, source, own.near)
            off_m = (
                float(np.linalg.norm(found.pose.cam_from_local.center - true.center))
                if isinstance(found, NearFit)
                else float("nan")
            )
            shows = "the town" if truth.at_home[frame.index] else "another town"
            rows.append((name, frame.index, shows, found.agreeing_share, off_m, time.perf_counter() - began))
    return rows


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("track-evaluation"))
    parser.add_argument("--size", choices=("short", "full"), default="full")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--films", nargs="+", choices=("smooth", "jerky", "cut"), default=["smooth", "cut"])
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--every", type=int, default=24, help="frames from one to the next (24)")
    parser.add_argument("--workers", type=int, default=0, help="processes that draw; default: cores")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
