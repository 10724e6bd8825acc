"""A map made of a film: keyframes, minutes, and what it answers to photos of another camera.

    python -m tools.video_map --out DIR [--size short|full] [--frames 1200]

1. The film `smooth` of `tools.track_evaluation` (kept in DIR/film-smooth), a drone's telemetry beside it.
2. `featuredb lidar add` of the town's scan; `featuredb ingest video`; `featuredb anchor --auto` of its map.
3. The map's cameras against the truth; then photos that another drone and other people took of the town, none
   of which are in the database, are asked of a server: with their true lens, and with what EXIF tells.

Photos count that look at what the film saw: those whose view's middle lies within the ground that the map's
points cover. Writes video_map.json; exit code 0 if everything holds.
"""

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.scan_world import make_scan_world
from featuredb.simworld.truth import Truth
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from ingest.workspace import default_root
from tools.anchor_simworld import featuredb
from tools.asked_photos import Answered, ask
from tools.growth_common import Verdict, conclude, say
from tools.track_evaluation import film_options
from tools.worlds.film_world import FILM_FILE, FilmTruth, read_film_truth, write_film

_KEYFRAMES, _SECONDS = 60, 300.0
_NEAR_M, _SHARE, _WRONG_M = 0.3, 0.9, 2.0


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    world = make_scan_world(
        args.out / f"{args.size}-{args.seed}" / "world", args.seed, args.size, args.workers
    )
    options = film_options("smooth", args.size, args.seed, args.frames)
    folder = write_film(args.out / "film-smooth", options, args.workers)
    database = args.out / "film.db"
    shutil.rmtree(database, ignore_errors=True)
    featuredb("lidar", "add", str(database), str(world.scan))
    clock = StageClock()
    featuredb("ingest", "video", str(database), str(folder / FILM_FILE), "--quiet")
    clock.lap("ingest")
    (made,) = Database.open(database).snapshot().maps()
    (stills,) = (default_root(Database.open(database).url) / "films").iterdir()
    out = args.out / "film-anchor"
    words = ("anchor", str(database), made.map_id, "--photos", str(stills), "--out", str(out), "--auto")
    placed = featuredb(*words, "--quiet", may_refuse=True) == 0
    clock.lap("anchor")
    made_s, anchored_s = clock.seconds["ingest"], clock.seconds["anchor"]
    snapshot = Database.open(database).snapshot()
    feature_map = snapshot.load_map(made.map_id)
    off = keyframe_errors(feature_map, read_film_truth(folder))
    truth = world.world.truth
    photos = [p for group in ("drone", "queries") for p in world.world.images(group)]
    asked = looking_at_map(photos, truth, feature_map)
    verdicts = [
        Verdict(
            name="keyframes",
            text=f"{len(feature_map.images)}, at most {_KEYFRAMES} wanted",
            holds=len(feature_map.images) <= _KEYFRAMES,
        ),
        Verdict(
            name="anchored",
            text=f"{'' if placed else 'NOT '}placed on the scan; keyframes off by {np.median(off):.3f} m "
            f"at the median, {off.max():.3f} m at most",
            holds=placed,
        ),
        Verdict(
            name="time",
            text=f"{made_s + anchored_s:.0f} s, of which anchoring {anchored_s:.0f}; {_SECONDS:g} wanted",
            holds=made_s + anchored_s <= _SECONDS,
        ),
    ]
    figures: dict[str, Any] = {
        "keyframes": len(feature_map.images),
        "keyframes_m": float(np.median(off)),
        "keyframes_largest_m": float(off.max()),
        "placed": int(placed),
        "made_s": made_s,
        "anchored_s": anchored_s,
    }
    served = Database.open(database)
    for name, answers in (
        ("photos of a known lens", ask(served, truth, asked, lens="known")),
        ("photos with EXIF alone, one by one", ask(served, truth, asked)),
        ("photos with EXIF alone, of shared lenses", ask(served, truth, asked, lens="shared")),
    ):
        figures[name] = {p.name: None if a is None else a.error.position_m for p, a in answers.items()}
        verdict = judge_answers(name, list(answers.values()))
        if "one by one" in name:
            say(f"{name}: {verdict.text}")  # what a photo alone can tell of its lens is not the map's doing
        else:
            verdicts.append(verdict)
    return conclude(args.out, "video_map", verdicts, figures)


def judge_answers(name: str, answers: Sequence[Answered | None]) -> Verdict:
    """Whether enough photos are near enough, and none is far off."""
    metres = np.array([np.inf if a is None else a.error.position_m for a in answers])
    normalised = np.mean([a.normalised for a in answers if a is not None] or [np.nan])
    near, wrong = int((metres <= _NEAR_M).sum()), int(((metres > _WRONG_M) & np.isfinite(metres)).sum())
    return Verdict(
        name=name,
        text=f"{near} of {len(metres)} within {_NEAR_M} m, {_SHARE:.0%} wanted; "
        f"median {np.median(metres):.3f} m, largest {metres.max():.3f} m, mean squared normalised error "
        f"{normalised:.1f}; {wrong} over {_WRONG_M:g} m off, none wanted",
        holds=near >= _SHARE * len(metres) > 0 and wrong == 0,
    )


def keyframe_errors(feature_map: FeatureMap, truth: FilmTruth) -> FloatArray:
    """Metres between the map's images and the film's cameras at their times."""
    here = truth.frame.enu_from(feature_map.frame)
    found = []
    for image in feature_map.images:
        true = truth.cam_from_local[int(Path(image.name).stem)]  # keyframes are named by their frame
        assert true is not None
        found.append(float(np.linalg.norm(here.act(image.cam_from_local.center) - true.center)))
    return np.array(found)


def looking_at_map(photos: Sequence[Path], truth: Truth, feature_map: FeatureMap) -> list[Path]:
    """Photos in the middle of whose view, where it meets the ground, the map has points around it."""
    points = truth.frame.enu_from(feature_map.frame).act(feature_map.points_local(feature_map.frame))
    ground = float(np.median(points[:, 2]))
    chosen = []
    for photo in photos:
        pose = truth.images[f"{photo.parent.name}/{photo.name}"].cam_from_local
        forward = pose.rotation[2]
        if forward[2] >= -0.05:
            continue
        middle = pose.center + forward * ((ground - pose.center[2]) / forward[2])
        beside = points[:, :2] - middle[:2]
        quadrants = {(bool(x > 0), bool(y > 0)) for x, y in beside[np.linalg.norm(beside, axis=1) < 15.0]}
        if len(quadrants) == 4:
            chosen.append(photo)
    return chosen


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("video-map"))
    parser.add_argument("--size", choices=("short", "full"), default="short")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--workers", type=int, default=0, help="processes that draw; default: cores")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
