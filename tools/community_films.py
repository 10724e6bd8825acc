"""A folder of films by strangers: maps of what shows the place, placed by one frame, every frame tracked.

    python -m tools.community_films --work DIR [--seed N]

1. Six simulated films without telemetry: three of one place (cuts, a title, black, a zoom, a logo, bars), one
   of another town, two of the place that are compressed badly, one of which shows the other town in between.
   They are drawn once and kept.
2. `featuredb init`, `featuredb ingest video DB FOLDER --no-telemetry`: every shot of the place must be in a
   map, nothing else in that map, and what is in none must have a reason in the report.
3. `featuredb lidar add` of the place's scan (intensities only); `featuredb anchor --picks` by six picks with
   3 px of error in one keyframe.
4. `featuredb track` of every film, without being told a lens. A frame's errors are inside their bounds where
   all six together are in the region that the stated covariance gives 95 %.
"""

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.stats import chi2

from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.scan_world import write_scan
from featuredb.store import Database
from ingest.report.page import REPORT_JSON
from reloc.tracking.trajectory.read import read_trajectory_csv
from reloc.tracking.trajectory.values import Trajectory
from tools.commands import featuredb, newest_copy
from tools.figures import median, say, squared, study_parser, write_figures
from tools.film_folder import HEIGHT, FilmsTruth, FrameTruth, Script, place_scene, six_films, write_films
from tools.made_maps import once
from tools.picked import Seen, place_by_picks, read_scan
from tools.track_evaluation import axis_errors

_INSIDE = float(chi2.ppf(0.95, 6))
Shot = tuple[str, int]  # name of a film's file, number of the piece


def track_figures(tracks: Mapping[str, Trajectory], truth: FilmsTruth) -> dict[str, float]:
    """Of tracks by film: frames that show the place, those tracked and inside their bounds, their errors; and
    poses of frames that do not show it."""
    frames = foreign = 0
    metres, squares = [], []
    for film, trajectory in tracks.items():
        poses = [one.pose for one in truth.films[film]]
        frames += sum(pose is not None for pose in poses)
        off = axis_errors(trajectory, truth.frame, poses)
        for point, error in zip(trajectory.points, off, strict=True):
            if point.pose is not None and np.isfinite(error).all():
                metres.append(np.linalg.norm(error[3:]))
                squares.append(squared(error, point.pose.covariance))
            elif point.pose is not None:
                foreign += 1
    return {
        "place_frames": frames,
        "tracked_share": len(metres) / max(frames, 1),
        "inside_share": sum(one <= _INSIDE for one in squares) / max(frames, 1),
        "foreign_tracked": foreign,
        "median_m": median(metres),
        "largest_m": float(max(metres, default=np.nan)),
    }


def main() -> None:
    args = study_parser(__doc__, "--work", "--inputs", "--seed").parse_args()
    inputs = (args.inputs or args.work) / f"community-{args.seed}"
    scripts = six_films(args.seed)
    truth = write_films(inputs / "films", scripts)
    work = args.work / f"run-{args.seed}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    made = work / "made"
    featuredb("init", str(made))
    words = ("ingest", "video", str(made), str(inputs / "films"), "--no-telemetry", "--quiet")
    featuredb(*words, "--report", str(work / "report"), "--work", str(work / "stages"), refusals=(1,))
    found = read_film_maps(made, work / "report", truth)
    figures: dict[str, Any] = found.figures(scripts) | {"placed": 0}
    if found.of_place:
        database = newest_copy(made, work / "placed")
        town = place_scene(args.seed)
        scan = once(
            inputs / "scan.laz", lambda file: write_scan(file, scan_town(town, AirborneScanOptions()))
        )
        placed = _placed(database, found, truth, scan, work, args.seed)
        figures["placed"] = int(placed)
        tracks = _tracked(database, inputs / "films", work, truth) if placed else {}
        figures |= track_figures(tracks, truth)
        say("".join(f"\n{film}: {track_figures({film: track}, truth)}" for film, track in tracks.items()))
    write_figures(args.json, figures)


def _placed(database: Path, found: FilmMaps, truth: FilmsTruth, scan: Path, work: Path, seed: int) -> bool:
    """Place the largest map of the place."""
    featuredb("lidar", "add", str(database), str(scan), "--quiet")
    biggest, keyframes = max(found.of_place.items(), key=lambda one: len(one[1]))
    photos, seen = keyframe_to_pick_in(keyframes, work / "stages" / "films")
    cloud = read_scan(scan, truth.frame, truth.epsg)
    return place_by_picks(database, biggest, photos, seen, cloud, work, seed)


def _tracked(database: Path, films: Path, work: Path, truth: FilmsTruth) -> dict[str, Trajectory]:
    tracks = {}
    for film in truth.films:
        out = work / "tracks" / f"{film}.csv"
        featuredb("track", str(database), str(films / film), "--out", str(out), refusals=(1,))
        tracks[film] = read_trajectory_csv(out)
    return tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class MapKeyframe:
    """An image of a map, or of the report: what it shows by the truth. `reason`: why it is in no map."""

    image: str
    film: str
    truth: FrameTruth
    reason: str = ""

    @property
    def shot(self) -> Shot:
        return self.film, self.truth.piece


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmMaps:
    """All maps.

    Attributes:
        of_place: keyframes by map, of maps most of whose keyframes show the place. elsewhere: of other maps.
        left: keyframes that are in none.
        given_up: films and spans (seconds) of which the report says that no keyframe was made, and why.
    """

    of_place: dict[str, list[MapKeyframe]]
    elsewhere: list[MapKeyframe]
    left: list[MapKeyframe]
    given_up: list[tuple[str, float, float, str]]

    def figures(self, scripts: Sequence[Script]) -> dict[str, int]:
        """Shots of the place, of which most keyframes are in maps of it; what is in them beside; losses."""
        shots = {
            (f"{s.name}.mp4", n): s.span_s(n)
            for s in scripts
            for n, piece in enumerate(s.pieces)
            if piece.kind == "place"
        }
        inside = [k for keyframes in self.of_place.values() for k in keyframes]
        mapped, others = (Counter(k.shot for k in of) for of in (inside, [*self.elsewhere, *self.left]))
        unseen = [shot for shot in shots if not mapped[shot] + others[shot]]
        return {
            "place_maps": len(self.of_place),
            "place_shots": len(shots),
            "shots_in_maps": sum(mapped[shot] > others[shot] for shot in shots),
            "foreign_in_maps": sum(k.truth.kind != "place" for k in inside),
            "lost_without_reason": sum(not self._explained(shot[0], shots[shot]) for shot in unseen)
            + sum(not k.reason for k in self.left),
        }

    def _explained(self, film: str, span_s: tuple[float, float]) -> bool:
        """Whether the report says why there is no keyframe of a span of a film."""
        first, last = span_s
        return any(f == film and a < last and first < b and why for f, a, b, why in self.given_up)


def read_film_maps(database: Path, report: Path, truth: FilmsTruth) -> FilmMaps:
    """What the database and the report of the ingest say."""
    snapshot = Database.open(database).snapshot()
    maps = {
        one.map_id: [_keyframe(image.name, truth) for image in snapshot.load_unplaced(one.map_id).images]
        for one in snapshot.unplaced_maps()
    }
    mapped = {k.image for keyframes in maps.values() for k in keyframes}
    document: dict[str, Any] = json.loads((report / REPORT_JSON).read_text(encoding="utf-8"))
    photos = [photo for photo in document["photos"] if photo["name"] not in mapped]
    of_place = {
        map_id: those
        for map_id, those in maps.items()
        if 2 * sum(k.truth.kind == "place" for k in those) > len(those)
    }
    return FilmMaps(
        of_place=of_place,
        elsewhere=[k for map_id in maps.keys() - of_place.keys() for k in maps[map_id]],
        left=[_keyframe(photo["name"], truth, photo["reason"]) for photo in photos],
        given_up=list(_given_up(document["films"])),
    )


def _given_up(films: Sequence[dict[str, Any]]) -> Iterator[tuple[str, float, float, str]]:
    """Films that were refused, and shots without keyframes."""
    for film in films:
        name = Path(film["path"]).name
        if film["status"] == "refused":
            yield name, 0.0, np.inf, film["reason"]
        for shot in film["shots"]:
            if not shot["keyframes"]:
                reasons = ", ".join(f"{count} {why}" for why, count in shot["dropped"].items())
                yield name, shot["start_s"], shot["end_s"], reasons


def keyframe_to_pick_in(keyframes: Sequence[MapKeyframe], stills: Path) -> tuple[Path, Seen]:
    """Folder of a map's images, below `stills`, and the one to pick in: whole and rich in detail."""
    files = {file.as_posix(): file for file in stills.rglob("*.jpg")}
    best: tuple[int, Path, Seen] | None = None
    for keyframe in keyframes:
        pose, camera = keyframe.truth.pose, keyframe.truth.camera
        (file,) = [file for name, file in files.items() if name.endswith("/" + keyframe.image)]
        size = file.stat().st_size
        if pose is None or camera is None or (best is not None and size <= best[0]):
            continue
        with Image.open(file) as picture:
            whole = picture.height == HEIGHT
        if whole:
            folder = file.parents[len(Path(keyframe.image).parts) - 1]
            best = size, folder, Seen(image=keyframe.image, camera=camera, cam_from_local=pose)
    if best is None:
        raise SystemExit("the map has no keyframe to pick in")
    return best[1:]


def _keyframe(image: str, truth: FilmsTruth, reason: str = "") -> MapKeyframe:
    """The film is a part of the image's path, and the last number of its name the frame."""
    path = Path(image)
    named = [film for film in truth.films if Path(film).stem in path.parts[:-1]]
    numbers = re.findall(r"\d+", path.stem)
    if len(named) != 1 or not numbers:
        raise SystemExit(f"{image}: expected FILM/FRAME.jpg of {', '.join(truth.films)}")
    frame = truth.films[named[0]][int(numbers[-1])]
    return MapKeyframe(image=image, film=named[0], truth=frame, reason=reason)


if __name__ == "__main__":
    main()
