"""Which frames of which films are in which maps of a database, and what became of the others."""

import json
import re
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
class FilmMap:
    """A map and its keyframes."""

    map_id: str
    keyframes: tuple[MapKeyframe, ...]

    @property
    def of_place(self) -> bool:
        """Whether most of it shows the place."""
        return 2 * sum(k.truth.kind == "place" for k in self.keyframes) > len(self.keyframes)


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmMaps:
    """All maps.

    Attributes:
        left: keyframes that are in none.
        given_up: films and spans (seconds) of which the report says that no keyframe was made, and why.
    """

    maps: tuple[FilmMap, ...]
    left: tuple[MapKeyframe, ...]
    given_up: tuple[tuple[str, float, float, str], ...]

    @property
    def of_place(self) -> tuple[FilmMap, ...]:
        return tuple(one for one in self.maps if one.of_place)

    def figures(self, scripts: Sequence[Script]) -> dict[str, int]:
        """Shots of the place, of which most keyframes are in maps of it; what is in them beside; losses."""
        shots = {
            (f"{s.name}.mp4", n): s.span_s(n)
            for s in scripts
            for n, piece in enumerate(s.pieces)
            if piece.kind == "place"
        }
        inside = [k for one in self.of_place for k in one.keyframes]
        elsewhere = [k for one in self.maps if not one.of_place for k in one.keyframes]
        whole = [s for s in shots if _count(inside, s) > _count([*elsewhere, *self.left], s)]
        unseen = [s for s in shots if not _count([*inside, *elsewhere, *self.left], s)]
        silent = [s for s in unseen if not self._explained(s[0], shots[s])]
        return {
            "place_maps": len(self.of_place),
            "place_shots": len(shots),
            "shots_in_maps": len(whole),
            "foreign_in_maps": sum(k.truth.kind != "place" for k in inside),
            "lost_without_reason": len(silent) + sum(not k.reason for k in self.left),
        }

    def _explained(self, film: str, span_s: tuple[float, float]) -> bool:
        """Whether the report says why there is no keyframe of a span of a film."""
        first, last = span_s
        return any(f == film and a < last and first < b and why for f, a, b, why in self.given_up)

    def as_text(self) -> str:
        """A line for each map and shot, and for what was left."""
        lines = []
        for one in self.maps:
            shots = sorted({k.shot for k in one.keyframes})
            parts = (f"{film} {piece}: {_count(one.keyframes, (film, piece))}" for film, piece in shots)
            kinds = sorted({k.truth.kind for k in one.keyframes})
            lines.append(f"map {one.map_id} of {'/'.join(kinds)}: {', '.join(parts)}")
        lines += [f"in no map: {k.image} ({k.truth.kind}): {k.reason}" for k in self.left]
        lines += [f"no keyframes: {film}, {a:.2f} to {b:.2f} s: {why}" for film, a, b, why in self.given_up]
        return "\n".join(lines)


def read_film_maps(database: Path, report: Path, truth: FilmsTruth) -> FilmMaps:
    """What the database and the report of the ingest say."""
    snapshot = Database.open(database).snapshot()
    loaded = [snapshot.load_unplaced(one.map_id) for one in snapshot.unplaced_maps()]
    maps = [
        FilmMap(map_id=one.map_id, keyframes=tuple(_keyframe(image.name, truth) for image in one.images))
        for one in loaded
    ]
    mapped = {k.image for one in maps for k in one.keyframes}
    document: dict[str, Any] = json.loads((report / REPORT_JSON).read_text(encoding="utf-8"))
    left = [
        _keyframe(photo["name"], truth, photo["reason"])
        for photo in document["photos"]
        if photo["name"] not in mapped
    ]
    return FilmMaps(maps=tuple(maps), left=tuple(left), given_up=tuple(_given_up(document["films"])))


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


def keyframe_to_pick_in(one: FilmMap, stills: Path) -> tuple[Path, Seen]:
    """Folder of the map's images, below `stills`, and the one to pick in: whole and rich in detail."""
    files = {file.as_posix(): file for file in stills.rglob("*.jpg")}
    best: tuple[int, Path, Seen] | None = None
    for keyframe in one.keyframes:
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
        raise SystemExit(f"map {one.map_id} has no keyframe to pick in")
    return best[1:]


def _keyframe(image: str, truth: FilmsTruth, reason: str = "") -> MapKeyframe:
    """The film is a part of the image's path, and the last number of its name the frame."""
    path = Path(image)
    stems = {Path(film).stem: film for film in truth.films}
    named = [film for stem, film in stems.items() if stem in path.parts[:-1]]
    numbers = re.findall(r"\d+", path.stem)
    if len(named) != 1 or not numbers:
        raise SystemExit(f"{image}: expected FILM/FRAME.jpg of {', '.join(truth.films)}")
    return MapKeyframe(
        image=image, film=named[0], truth=truth.films[named[0]][int(numbers[-1])], reason=reason
    )


def _count(keyframes: Sequence[MapKeyframe], shot: Shot) -> int:
    return sum(k.shot == shot for k in keyframes)
