"""How right tracked films are: flights over the simulated town, anchored on its scan, against true poses.

1. The world of `tools.worlds.scan_world`: `featuredb ingest photos` maps the drone's photos,
   `featuredb lidar add` and `featuredb anchor --auto` place the map on the scan.
2. Films of the same town at 1280x720 and 30 Hz: smooth; jerky, with gusts and turns on the spot; cut, which
   shows another town for a while. All pass over water. They are drawn once and kept.
3. Each is tracked as `featuredb track` does, with the lens of its camera. --on says by what: the map, or the
   scan alone (from a pose of the first frame that is off by 10 m and 5 degrees).

Figures of each film: what `judge_film` says; with --draw how far a layer that `featuredb draw` lays over the
film by that track is from where it belongs (tools/drawn_layer.py), too.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, so3_log
from featuredb.lidar.load import load_cloud
from featuredb.simworld.world import WorldOptions, town_of
from featuredb.store import Database
from featuredb.store.scans import list_scans
from ingest.register.frame_registration import FramePrior
from ingest.track.scan_ground import ScanFinder
from reloc.localiser import Localiser
from reloc.tracking.ground import Finder
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, track_video
from reloc.tracking.trajectory.values import Trajectory
from tools.anchor_simworld import anchored
from tools.drawn_layer import drawn_marks
from tools.figures import inside, off_pose, say, squared, study_parser, write_figures
from tools.worlds.film_world import (
    FILM_FILE,
    FilmOptions,
    FilmTruth,
    FlightStyle,
    PathOptions,
    film_truth,
    write_film,
)
from tools.worlds.scan_world import make_scan_world

_FILMS = ("smooth", "jerky", "cut")
_START_M, _START_DEG = 10.0, 5.0  # how far off the first pose on a scan is
_END = 200  # frames at each end whose errors are compared; of short films, a half each
FRAMES, _SEED = 1200, 1
_WORLD = WorldOptions.short(_SEED)
_CUT = (0.4, 0.55)  # of the film


def main() -> None:
    parser = study_parser(__doc__, "--work", "--inputs")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--films", nargs="+", choices=_FILMS, default=list(_FILMS))
    parser.add_argument("--on", choices=("map", "scan"), default="map", help="what is tracked by")
    parser.add_argument("--draw", action="store_true", help="lay a layer over each film, too")
    args = parser.parse_args()
    database, placed = anchored(args.work, make_scan_world(args.inputs), other=False)
    if not placed:
        raise SystemExit("track_evaluation: the map was not placed on its scan; its report is in DIR")
    results: dict[str, dict[str, float]] = {}
    for name in args.films:
        film, truth = drawn_film(name, args.frames, args.inputs)
        tracked = track_video(film, finder_on(args.on, database, truth), camera=truth.camera)
        results[name] = judge_film(tracked, truth)
        say(f"{name}: {results[name]}; stages {tracked.seconds}")
        if args.draw:
            scene, track = town_of(_WORLD), tracked.trajectory
            results[f"{name}_layer"] = drawn_marks(args.work, film, truth, scene, track, database)
    write_figures(args.json, results)


def finder_on(what: str, database: Path, truth: FilmTruth) -> Finder:
    """What a film is tracked by: its map, or its scan from a coarse first pose."""
    if what == "map":
        return MapFinder(Localiser.open(Database.open(database)).areas)
    (scan,) = list_scans(Database.open(database))
    cloud = load_cloud(Database.open(database), truth.frame, scan_ids=[scan.scan_id])
    start = off_pose(truth.cam_from_local[0], np.random.default_rng((_SEED, 5)), _START_M, _START_DEG)
    prior = FramePrior.around(start, _START_M, _START_DEG)
    return ScanFinder(cloud, scan.scan_id, truth.epsg, prior)


def film_options(name: str, frames: int) -> FilmOptions:
    style: FlightStyle = "jerky" if name == "jerky" else "smooth"
    path = PathOptions(seed=_SEED, style=style, half_extent_m=(32.0, 26.0))
    cut = (round(_CUT[0] * frames), round(_CUT[1] * frames)) if name == "cut" else None
    return FilmOptions(world=_WORLD, path=path, frames=frames, cut=cut)


def drawn_film(name: str, frames: int, inputs: Path) -> tuple[Path, FilmTruth]:
    """A film, with its telemetry beside it, and its truth; drawn once."""
    options = film_options(name, frames)
    return write_film(inputs / f"film-{name}-{frames}-{_SEED}", options) / FILM_FILE, film_truth(options)


def axis_errors(
    trajectory: Trajectory, frame: LocalFrame, cam_from_local: Sequence[Rigid3 | None]
) -> FloatArray:
    """(n, 6) of every frame, east-north-up: rotation (rad) before displacement (m); NaN without a pose."""
    off = np.full((len(trajectory.points), 6), np.nan)
    for row, point in enumerate(trajectory.points):
        pose, true = point.pose, cam_from_local[point.index]
        if pose is not None and true is not None:
            center = frame.enu_from_utm(pose.utm, pose.epsg)
            rotation = matrix_from_quaternion(pose.cam_from_utm_xyzw) @ frame.grid_from_enu(center, pose.epsg)
            off[row] = [*so3_log(rotation.T @ true.rotation), *(center - true.center)]
    return off


def judge_film(tracked: TrackedVideo, truth: FilmTruth, most: int = _END) -> dict[str, float]:
    """The film's track against its truth.

    - frames, lost: of the frames that show the town. invented: poses of frames that do not.
    - mean_m, largest_m: errors of the frames that have poses. first_m, last_m: means over the first and the
      last of them, `most` or a half.
    - found_s: from the town's return to the first pose, of the film's time; 0 without a cut.
    - rate_hz: frames a second over the whole run.
    - position_95, orientation_95: shares of the errors inside these bounds. squared: mean squared error of
      the position over its covariance; 3 is right. few_*: of the quarter of the frames with fewest landmarks.
    """
    off = axis_errors(tracked.trajectory, truth.frame, truth.cam_from_local)
    metres = np.linalg.norm(off[:, 3:], axis=1)
    known = np.isfinite(metres)
    m = metres[known]
    end = min(most, max(len(m) // 2, 1))  # ends that overlap could not differ
    return {
        "frames": int(truth.at_home.sum()),
        "lost": int((truth.at_home & np.isnan(metres)).sum()),
        "invented": sum(p.pose is not None for p in tracked.trajectory.points) - int(known.sum()),
        "mean_m": float(m.mean()),
        "largest_m": float(m.max()),
        "first_m": float(m[:end].mean()),
        "last_m": float(m[-end:].mean()),
        "found_s": _found_s(truth, known),
        "rate_hz": len(metres) / tracked.seconds["total"],
        **_inside(tracked.trajectory, off),
    }


def _inside(trajectory: Trajectory, off: FloatArray) -> dict[str, float]:
    """How true the bounds are: the last figures of `judge_film`."""
    found = [(p, error) for p, error in zip(trajectory.points, off, strict=True) if np.isfinite(error).all()]
    few = np.argsort([p.inliers for p, _ in found], kind="stable")[: (len(found) + 3) // 4]
    figures: dict[str, float] = {}
    for name, k in (("orientation", slice(0, 3)), ("position", slice(3, 6))):
        squares = np.array([squared(error[k], p.pose.covariance[k, k]) for p, error in found])
        figures |= {f"{name}_95": inside(squares, 0.95), f"few_{name}_95": inside(squares[few], 0.95)}
    return figures | {"squared": float(squares.mean()), "few_squared": float(squares[few].mean())}


def _found_s(truth: FilmTruth, known: NDArray[np.bool_]) -> float:
    """From the town's return to the first frame with a pose; infinite if there is none."""
    away = np.flatnonzero(~truth.at_home)
    if len(away) == 0:
        return 0.0
    back = int(away[-1]) + 1
    again = np.flatnonzero(known[back:])
    return float(truth.times_s[back + again[0]] - truth.times_s[back]) if len(again) else float("inf")


if __name__ == "__main__":
    main()
