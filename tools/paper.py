"""The paper's results beside ours, row by row (Bodensteiner et al., section 3).

    python -m tools.paper --out DIR [--data FOLDER] [--only film shares]

film    section 3.1.2 and 3.2: a simulated film without any telemetry becomes a map; six picks in one frame
        place it on an intensity-only scan; all frames are tracked. The paper measures distances from a bundle
        adjustment; here from the truth, which no adjustment's own error softens, and beside it from the map's
        adjusted keyframes.
shares  section 3 and 3.1: films and collections that become maps: karma, `brighton` as a film without GPS,
        and two photo collections of many people.

Prints a table and writes paper.json. What fails stands in the table with its reason.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.workspace import default_root
from reloc.localiser import Localiser
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, track_video
from tools.anchor_simworld import featuredb
from tools.figures import write_figures
from tools.growth_common import table
from tools.made_maps import bare_film, copied, make, photo_names
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import errors, film_options
from tools.worlds.film_world import FILM_FILE, FilmTruth, read_film_truth, write_film
from tools.worlds.scan_world import make_scan_world

_PARTS = ("film", "shares")
_FILM_SEED, _FRAMES = 1, 1200
_PLACED = "placed.json"  # what came of the film; who starts again goes on from there


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A result: what, where the paper has it, the paper's figure and ours."""

    what: str
    section: str
    paper: str
    ours: str


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    lines: list[Line] = []
    figures: dict[str, Any] = {}
    parts = {"film": film, "shares": shares}
    for name in args.only:
        found, numbers = parts[name](args)
        lines += found
        figures |= numbers
    rows = [(line.what, line.section, line.paper, line.ours) for line in lines]
    sys.stdout.write(table(rows, ("result", "section", "paper", "ours")) + "\n")
    write_figures(args.out / "paper.json", figures)
    return 0


def film(args: argparse.Namespace) -> tuple[list[Line], dict[str, Any]]:
    """A film that says nothing of its place, placed by one frame, tracked from end to end."""
    inputs = args.inputs or args.out
    world = make_scan_world(inputs / f"scan-world-short-{_FILM_SEED}", _FILM_SEED, "short", 0)
    options = film_options("smooth", "short", _FILM_SEED, _FRAMES)
    folder = write_film(inputs / f"film-short-{_FILM_SEED}-smooth-{_FRAMES}", options, 0)
    truth = read_film_truth(folder)
    work = args.out / "film"
    if not (work / _PLACED).exists():
        write_figures(work / _PLACED, placed_film(folder / FILM_FILE, world.scan, truth, work, args.seed))
    made = json.loads((work / _PLACED).read_text(encoding="utf-8"))
    if made["refused"]:
        return [_refused(made["refused"])], {"placed": 0}
    feature_map = Database.open(work / "db").snapshot().load_map(made["map_id"])
    areas = Localiser.open(Database.open(work / "db")).areas
    camera = feature_map.cameras[0].scaled_to(truth.camera.width, truth.camera.height)
    tracked = track_video(work / FILM_FILE, MapFinder(areas), camera=camera)
    metres, _ = errors(tracked, truth)
    figures = track_figures(metres) | {"placed": 1, "keyframes": made["keyframes"], "made_s": made["made_s"]}
    figures["adjusted_m"] = from_keyframes(tracked, feature_map)
    figures["rate_hz"] = len(metres) / tracked.seconds.total
    times = json.loads((work / "anchor" / "anchor.json").read_text(encoding="utf-8"))["times_s"]
    frame_s = times.get("(B) one frame, median", float("nan"))
    projection_s = times.get("(C) structure projection, all frames", float("nan"))
    figures |= {"frame_s": frame_s, "projection_s": projection_s}
    return film_lines(figures, _FRAMES), figures


def placed_film(film_file: Path, scan: Path, truth: FilmTruth, work: Path, seed: int) -> dict[str, Any]:
    """The film's map in `work`/db, placed by picks in one frame: its id, keyframes, seconds; or why not."""
    shutil.rmtree(work, ignore_errors=True)
    bare, database = bare_film(film_file, work), work / "db"
    made = make(database, "video", bare, 0)
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    unplaced = Database.open(database).snapshot().unplaced_maps()
    if not unplaced:
        return {"refused": "no map came of the film"}
    biggest = max(unplaced, key=lambda one: one.images)
    stills = next((default_root(Database.open(database).url) / "films").iterdir())
    seen = seen_in_the_middle(database, biggest.map_id, truth)
    cloud = read_scan(scan, truth.frame, truth.epsg)
    placed = place_by_picks(database, biggest.map_id, stills, seen, cloud, work, seed)
    return {
        "refused": "" if placed else "the map was not placed by the picks of one frame",
        "map_id": biggest.map_id,
        "keyframes": biggest.images,
        "made_s": made.seconds,
    }


def track_figures(metres: np.ndarray) -> dict[str, float]:
    """Mean error of all frames with a pose, of the first and of the last quarter; frames without one."""
    quarter = len(metres) // 4
    first, last = float(np.nanmean(metres[:quarter])), float(np.nanmean(metres[-quarter:]))
    return {
        "lost": int(np.isnan(metres).sum()),
        "mean_m": float(np.nanmean(metres)),
        "first_m": first,
        "last_m": last,
        "last_over_first": last / first,
        "largest_m": float(np.nanmax(metres)),
    }


def from_keyframes(tracked: TrackedVideo, feature_map: FeatureMap) -> float:
    """Mean distance of tracked centres from those of the map's keyframes, which were adjusted together."""
    poses = {p.index: p.pose for p in tracked.trajectory.points}
    apart = []
    for image in feature_map.images:
        pose = poses.get(frame_of(image.name))
        if pose is not None:
            center = feature_map.frame.enu_from_utm(pose.utm, pose.epsg)
            apart.append(float(np.linalg.norm(center - image.cam_from_local.center)))
    return float(np.mean(apart)) if apart else float("nan")


def film_lines(figures: dict[str, Any], frames: int) -> list[Line]:
    """The rows of sections 3.1.2 and 3.2."""
    mean = f"{figures['mean_m']:.3f} m mean, {figures['largest_m']:.2f} m at most, {figures['lost']} lost"
    made = f"{figures['keyframes']} keyframes, {figures['made_s']:.0f} s"
    drift = f"first quarter {figures['first_m']:.3f} m, last {figures['last_m']:.3f} m"
    adjusted = f"{figures['adjusted_m']:.3f} m mean, from the map's adjusted keyframes"
    rows = (
        (f"tracked centres over {frames} frames", "3.1.2", "-", f"{mean}, from the truth"),
        ("the same, from a bundle adjustment", "3.1.2", "0.4 m", adjusted),
        ("drift", "3.1.2", "none seen", drift),
        ("frames a second", "3.1.2", "29.7, GPU", f"{figures['rate_hz']:.1f}, two cores"),
        ("(B) registering one frame", "3.2", "15 to 30 s, and 20 s", f"{figures['frame_s']:.1f} s"),
        ("(C) structure projection", "3.2", "1 s", f"{figures['projection_s']:.1f} s"),
        ("(A) the map of the film", "2.2", "-", made),
    )
    return [Line(what=w, section=s, paper=p, ours=o) for w, s, p, o in rows]


def _refused(why: str) -> Line:
    return Line(what="film without telemetry", section="3.1.2", paper="0.4 m", ours=f"FAILED: {why}")


def seen_in_the_middle(database: Path, map_id: str, truth: FilmTruth) -> Seen:
    """The map's middle keyframe."""
    unplaced = Database.open(database).snapshot().load_unplaced(map_id)
    image = unplaced.images[len(unplaced.images) // 2].name
    pose = truth.cam_from_local[frame_of(image)]
    if pose is None:
        raise SystemExit(f"{image}: a frame that does not show the town cannot be picked in")
    return Seen(image=image, camera=truth.camera, cam_from_local=pose)


def frame_of(image: str) -> int:
    """The number of the film's frame that a keyframe is, by its name."""
    return int("".join(c for c in Path(image).stem if c.isdigit()))


def shares(args: argparse.Namespace) -> tuple[list[Line], dict[str, Any]]:
    """Films and collections that become maps."""
    data, work = args.data, args.out / "shares"
    shutil.rmtree(work, ignore_errors=True)
    films, collections = [], []
    figures: dict[str, Any] = {}
    if (data / "video" / "karma.mp4").is_file():
        films.append(("karma", make(work / "karma", "video", data / "video" / "karma.mp4", 0)))
    brighton = data / "brighton" / "images"
    if brighton.is_dir():
        bare = copied(brighton, photo_names(brighton), work / "bare", strip=True)
        films.append(("brighton, no GPS", make(work / "brighton", "photos", bare, len(photo_names(bare)))))
    for name, folder in (("reichstag", "reichstag/images"), ("sacre_coeur", "sacre_coeur/mapping")):
        if (data / folder).is_dir():
            count = len(photo_names(data / folder))
            collections.append((name, make(work / name, "photos", data / folder, count)))
    lines = []
    if films:
        became = sum(made.maps > 0 for _, made in films)
        ours = f"{became} of {len(films)}: " + ", ".join(f"{n} ({m.largest} images)" for n, m in films)
        lines.append(Line(what="films that become maps", section="3", paper="98 of 115", ours=ours))
        figures |= {"films": len(films), "films_mapped": became}
    for (name, made), paper in zip(collections, ("341 of 4950", "335 of 1498"), strict=False):
        ours = f"{name}: {made.largest} of {made.photos} in the largest map, {made.mapped} in {made.maps}"
        lines.append(Line(what="photos of a collection in a map", section="3.1", paper=paper, ours=ours))
        figures[name] = made.largest
    return lines, figures


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--inputs", type=Path, default=None, help="keep world and film there, not in --out")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the real sets")
    parser.add_argument("--only", nargs="+", choices=_PARTS, default=list(_PARTS))
    parser.add_argument("--seed", type=int, default=1, help="of the picks")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
