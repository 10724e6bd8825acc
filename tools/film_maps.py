"""Which frames of which films are in which maps of a database, and what became of the others."""

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from featuredb.store import Database
from ingest.report.page import REPORT_JSON
from tools.film_folder import HEIGHT, FilmsTruth, FrameTruth, Script
from tools.picked import Seen

Shot = tuple[str, int]  # name of a film's file, number of the piece


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
