"""Writes a simulated world: folders of photos, and the truth beside them."""

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld import negatives
from featuredb.simworld.camera.photograph import SensorOptions, Shot, jpeg_bytes, photo_bytes, take_photo
from featuredb.simworld.flight import FlightOptions, pedestrians, survey, survey_half_extent, visitors
from featuredb.simworld.negatives import NEGATIVE_KINDS, NegativeKind
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.town import OTHER_TOWN_PLACE, make_town

T = TypeVar("T")


def in_order(draw: Callable[[int], T], count: int, workers: int = 0, chunk: int | None = 1) -> Iterator[T]:
    """`draw(i)` of all i below `count` in their order, from a pool of processes (or here, for one worker).

    Args:
        workers: processes; 0 takes one per core.
        chunk: numbers that travel to a process at a time; None: to each process a row of its own.
    """
    processes = min(workers or os.cpu_count() or 1, count)
    if processes <= 1:
        yield from map(draw, range(count))
        return
    size = chunk or -(-count // processes)
    # Spawned, not forked: the caller may have threads (Zenoh, a progress bar) that a fork would cut off.
    # OpenCV's own threads would fight over the same cores.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, cv2.setNumThreads, (1,)) as pool:
        # A few chunks ahead of the writer, so that a slow disk does not fill the memory.
        chunks = [range(first, min(first + size, count)) for first in range(0, count, size)]
        ahead = 4 * processes
        waiting = [pool.submit(_drawn, draw, numbers) for numbers in chunks[:ahead]]
        for k in range(len(chunks)):
            yield from waiting.pop(0).result()
            if k + ahead < len(chunks):
                waiting.append(pool.submit(_drawn, draw, chunks[k + ahead]))


def _drawn(draw: Callable[[int], T], numbers: range) -> list[T]:
    return [draw(number) for number in numbers]


Progress = Callable[[int, int], None]

_VISITORS_SEED = 40  # negatives made of town photos are other photos than the queries

TRUTH_FILE = "truth.json"
_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueImage:
    """One photo's truth.

    Attributes:
        name: path within the world's folder, with forward slashes.
        cam_from_local: true pose, local ENU frame to camera, metres.
        utm: (3,) easting, northing, ellipsoidal height of the camera centre, metres.
        gps_error_m: (3,) east, north, up: what the EXIF position is off by, None without GPS.
    """

    name: str
    camera: Camera
    cam_from_local: Rigid3
    utm: FloatArray
    gps_error_m: FloatArray | None

    def __post_init__(self) -> None:
        freeze(self, utm=(3,))
        if self.gps_error_m is not None:
            freeze(self, gps_error_m=(3,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """The truth of a world.

    Attributes:
        seed: of the world. epsg: UTM zone of `TrueImage.utm`; heights are ellipsoidal.
        frame: local frame of the poses.
        images: every photo of the town by name; negatives have no truth, since they have no place.
    """

    seed: int
    epsg: int
    frame: LocalFrame
    images: dict[str, TrueImage]

    def group(self, folder: str) -> list[TrueImage]:
        """Images of one folder (drone, queries, street), by name."""
        return [self.images[name] for name in sorted(self.images) if name.startswith(f"{folder}/")]


def true_image(scene: Scene, shot: Shot) -> TrueImage:
    """The truth of a planned photo."""
    center = shot.cam_from_local.center
    return TrueImage(
        name=shot.name,
        camera=shot.device.camera,
        cam_from_local=shot.cam_from_local,
        utm=scene.frame.utm_from_enu(center, scene.epsg),
        gps_error_m=None if shot.gps_enu is None else shot.gps_enu - center,
    )


def write_truth(folder: Path, truth: Truth) -> None:
    """Write folder/truth.json; floats are written so that they read back exactly."""
    images = [
        {
            "name": name,
            "camera": asdict(image.camera),
            "cam_from_local": {
                "quaternion_xyzw": image.cam_from_local.quaternion_xyzw.tolist(),
                "translation_m": image.cam_from_local.translation.tolist(),
            },
            "utm": image.utm.tolist(),
            "gps_error_m": None if image.gps_error_m is None else image.gps_error_m.tolist(),
        }
        for name, image in sorted(truth.images.items())
    ]
    document = {
        "version": _VERSION,
        "seed": truth.seed,
        "epsg": truth.epsg,
        "height_datum": "WGS84 ellipsoid",
        "frame": asdict(truth.frame),
        "images": images,
    }
    (folder / TRUTH_FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_truth(folder: Path) -> Truth:
    """Read folder/truth.json.

    Raises:
        InvalidValueError: no such file, or not one that this version wrote.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["version"] != _VERSION:
            raise InvalidValueError(f"{path}: expected version {_VERSION}, found {document['version']}")
        images = [
            TrueImage(
                name=entry["name"],
                camera=Camera(**{**entry["camera"], "params": tuple(entry["camera"]["params"])}),
                cam_from_local=Rigid3.from_quaternion(
                    entry["cam_from_local"]["quaternion_xyzw"], entry["cam_from_local"]["translation_m"]
                ),
                utm=np.asarray(entry["utm"]),
                gps_error_m=None if entry["gps_error_m"] is None else np.asarray(entry["gps_error_m"]),
            )
            for entry in document["images"]
        ]
        return Truth(
            seed=document["seed"],
            epsg=document["epsg"],
            frame=LocalFrame(**document["frame"]),
            images={image.name: image for image in images},
        )
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise InvalidValueError(
            f"{path}: expected the truth of a simulated world, found {error!r}; "
            "make one with featuredb simworld"
        ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldOptions:
    """What to write. The same options give the same bytes.

    Attributes:
        flight: the survey; its gps_error holds for the queries too.
        queries, street: numbers of held-out drone photos and of street photos.
        street_width: pixels, of the widest of the cameras.
        negatives_per_kind: photos of each of NEGATIVE_KINDS.
        workers: processes; 0 takes one per core.
    """

    seed: int = 1
    town_size_m: tuple[float, float] = (380.0, 330.0)
    flight: FlightOptions = field(default_factory=FlightOptions)
    queries: int = 60
    query_width: int = 1600
    street: int = 40
    street_width: int = 1600
    negatives_per_kind: int = 34
    sensor: SensorOptions = field(default_factory=SensorOptions)
    workers: int = 0

    def __post_init__(self) -> None:
        if min(self.queries, self.street, self.negatives_per_kind, self.workers) < 0:
            raise InvalidValueError(f"WorldOptions: expected numbers >= 0, found {self}")

    @classmethod
    def short(cls, seed: int = 1) -> "WorldOptions":
        """A world for tests: 24 survey photos, 8 queries, few of the rest, seconds to make."""
        return cls(
            seed=seed,
            town_size_m=(260.0, 230.0),
            flight=FlightOptions(lines=4, per_line=5, oblique=4, width=1024),
            queries=8,
            query_width=1024,
            street=4,
            street_width=1024,
            negatives_per_kind=1,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """A world on disk.

    Attributes:
        folder: holds drone/, queries/, street/, negatives/<kind>/ and truth.json.
    """

    folder: Path
    truth: Truth

    def images(self, group: Literal["drone", "queries", "street"]) -> list[Path]:
        """Photos of one group, by name."""
        return [self.folder / image.name for image in self.truth.group(group)]

    def negatives(self, kind: NegativeKind | None = None) -> list[Path]:
        """Negatives of one kind, or all."""
        return sorted((self.folder / "negatives").glob(f"{kind or '*'}/*.jpg"))


_GROUPS = ("drone", "queries", "street")


def write_world(folder: Path, options: WorldOptions, progress: Progress | None = None) -> World:
    """Write all photos and truth.json into `folder` (made if missing; files of the same names are replaced).

    Args:
        progress: called with (files done, files in all).
    """
    folder = Path(folder)
    files = _files(options)
    for parent in {(folder / name).parent for name, _ in files}:
        parent.mkdir(parents=True, exist_ok=True)
    # truth.json comes last: a folder with it is complete.
    (folder / TRUTH_FILE).unlink(missing_ok=True)
    made = in_order(partial(_made, options), len(files), options.workers)
    for done, (name, data) in enumerate(made, start=1):
        (folder / name).write_bytes(data)
        if progress is not None:
            progress(done, len(files))
    scene = town_of(options)
    images = [true_image(scene, shot) for group in _GROUPS for shot in _shots(options, group)]
    truth = Truth(seed=options.seed, epsg=scene.epsg, frame=scene.frame, images={i.name: i for i in images})
    write_truth(folder, truth)
    return open_world(folder)


def open_world(folder: Path) -> World:
    """A world that was written before.

    Raises:
        InvalidValueError: no truth.json there.
    """
    return World(folder=Path(folder), truth=read_truth(Path(folder)))


@lru_cache(maxsize=2)
def town_of(options: WorldOptions) -> Scene:
    """The scene of a world: for depth truth, other sensors, other cameras."""
    return make_town(options.seed, size_m=options.town_size_m)


@lru_cache(maxsize=2)
def other_town_of(options: WorldOptions) -> Scene:
    """A town of another place, which no map of the world's town knows."""
    return make_town(
        options.seed + 1000, name="other town", size_m=options.town_size_m, place=OTHER_TOWN_PLACE
    )


@lru_cache(maxsize=16)
def _shots(options: WorldOptions, group: str, other: bool = False, seed_shift: int = 0) -> tuple[Shot, ...]:
    scene = other_town_of(options) if other else town_of(options)
    seed = options.seed + seed_shift
    if group == "drone":
        return tuple(survey(scene, options.flight, seed))
    if group == "queries":
        count = options.negatives_per_kind if seed_shift else options.queries
        return tuple(visitors(scene, options.flight, count, seed, width=options.query_width))
    extent = survey_half_extent(options.flight)
    return tuple(pedestrians(scene, options.street, seed, width=options.street_width, extent_m=extent))


@lru_cache(maxsize=2)
def _files(options: WorldOptions) -> tuple[tuple[str, Callable[[], bytes]], ...]:
    """Names of all files, and what makes their bytes."""
    files = [
        (shot.name, partial(_photo, options, shot)) for group in _GROUPS for shot in _shots(options, group)
    ]
    # Kind by kind, so that a process paints the other town once at most.
    for kind in NEGATIVE_KINDS:
        for index in range(options.negatives_per_kind):
            name = f"negatives/{kind}/{kind}_{index + 1:04d}.jpg"
            files.append((name, partial(_negative, options, kind, index)))
    return tuple(files)


def _made(options: WorldOptions, number: int) -> tuple[str, bytes]:
    """Name and bytes of one file."""
    name, make = _files(options)[number]
    return name, make()


def _photo(options: WorldOptions, shot: Shot) -> bytes:
    return photo_bytes(town_of(options), shot, options.sensor)


def _negative(options: WorldOptions, kind: str, index: int) -> bytes:
    rng = np.random.default_rng((options.seed, 21, NEGATIVE_KINDS.index(kind), index))
    width = options.query_width
    if kind == "other_town":
        shot = _shots(options, "queries", other=True, seed_shift=_VISITORS_SEED)[index]
        return photo_bytes(other_town_of(options), shot, options.sensor)
    if kind in ("mirrored", "blurred"):
        shot = _shots(options, "queries", seed_shift=_VISITORS_SEED)[index]
        photo = take_photo(town_of(options), shot, options.sensor)
        image = negatives.mirrored(photo) if kind == "mirrored" else negatives.blurred(photo, rng)
    else:
        painter = {"blank": negatives.blank, "noise": negatives.noise, "text": negatives.text}[kind]
        image = painter(rng, width, width * 3 // 4)
    return jpeg_bytes(image)
