"""Albums: photos of many people as planned, taken, edited, tagged, and written with a table and the truth.

An album's photos lie in a folder per owner under names that give nothing away. Beside them stand
`table.jsonl` as a photo site's programming interface would give it, `truth.json` with every true pose, and
`facts.jsonl` with what each photo really is.
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from PIL import ExifTags, Image

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import (
    Device,
    SensorOptions,
    Shot,
    exif_of,
    expose,
    jpeg_bytes,
    look_pose,
    scene_look,
    take_photo,
)
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.blocks import box, face
from featuredb.simworld.town.scene import Ellipsoids, Faces, Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import TRUTH_FILE, TrueImage, Truth, in_order, true_image, write_truth
from tools.worlds.edits import Edit, edited, edited_camera

FACTS_FILE = "facts.jsonl"
TABLE_FILE = "table.jsonl"

Progress = Callable[[int, int], None]
Subject = Literal["town", "indoor", "portrait"]
ExifPolicy = Literal["full", "no_gps", "none"]
_SKIN = (1.9, 1.25, 1.9)  # factors on the leaf texture's green


@dataclass(frozen=True, slots=True, kw_only=True)
class Geotag:
    """A position as claimed.

    Attributes:
        latitude_deg, longitude_deg: WGS84. height_m: above the ellipsoid, or None.
        accuracy_m: what the site or the phone says of it, or None.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    accuracy_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AlbumFact:
    """What a photo really is; nobody but the evaluation reads it.

    Attributes:
        name: path within the album. photo_id: the site's number.
        kind: survey, street, drone, other_town, copy, indoor, portrait, ...; the worlds' modules list theirs.
        owner, licence: as in the table.
        time: of capture as claimed, timezone-aware.
        home: it shows the town whose frame the truth is in, so that it has a true pose.
        copy_of: the original, "" where this is one.
        visit: photos of one visit by one person share it; -1 for those of none.
        batch: when it arrives, for worlds that arrive in steps.
    """

    name: str
    photo_id: str
    kind: str
    owner: str
    licence: str
    time: datetime
    home: bool = True
    copy_of: str = ""
    visit: int = -1
    batch: int = 0


class SceneSource(Protocol):
    """Options of a world: hashable, picklable, and able to build its scenes."""

    def __hash__(self) -> int: ...

    def scene(self, key: str) -> Scene:
        """The scene of that name."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedPhoto:
    """One photo of an album.

    Attributes:
        shot: camera, pose, time, name within the album's folder. Its gps_enu is not used.
        scene: key of the scene that it shows.
        fact: what is true of it.
        geotag: what it claims, or None.
        exif: full, no_gps (the position is in the table only), or none.
        subject: what it shows.
        edits: what was done to it afterwards.
        quality: of the JPEG.
        sensor: of its camera, as this person uses it.
        orientation: EXIF orientation, 6 or 8 for a phone held upright that stores landscape pictures.
    """

    shot: Shot
    scene: str
    fact: AlbumFact
    geotag: Geotag | None = None
    exif: ExifPolicy = "full"
    subject: Subject = "town"
    edits: tuple[Edit, ...] = ()
    quality: int = 90
    sensor: SensorOptions = field(default_factory=SensorOptions)
    orientation: int = 1


def renamed(photo: PlannedPhoto, name: str, **fact: Any) -> PlannedPhoto:
    """The photo under another name, and with other facts."""
    told = replace(photo.fact, name=name, **fact)
    return replace(photo, shot=replace(photo.shot, name=name), fact=told)


def write_album(
    folder: Path,
    world: SceneSource,
    plan: Callable[[], list[PlannedPhoto]],
    workers: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Write all photos, the table and the truth into `folder`; files that are there already are kept.

    Photos whose fact says `home` get a true pose in the frame of the scene "home/0/000".

    Args:
        plan: gives the photos; it is not asked where the album is complete.
        workers: processes; 0 takes one per core.
        progress: called with (files done, files in all).

    Raises:
        OSError: the folder cannot be written.
        InvalidValueError: two photos of one name.
    """
    folder = Path(folder)
    if (folder / TRUTH_FILE).exists():  # it comes last
        return folder
    home, photos = world.scene("home/0/000"), plan()
    names = [photo.shot.name for photo in photos]
    if len(set(names)) < len(names):
        raise InvalidValueError("write_album: expected names that differ, found one twice")
    for parent in {(folder / name).parent for name in names}:
        parent.mkdir(parents=True, exist_ok=True)
    # The same scenes lie together: a process takes a part of the list, and paints few scenes.
    todo = sorted((p for p in photos if not (folder / p.shot.name).exists()), key=lambda p: p.scene)
    there = len(photos) - len(todo)
    written = in_order(partial(_write, folder, world, todo), len(todo), workers, None)
    for done, _ in enumerate(written, start=there + 1):
        if progress is not None:
            progress(done, len(photos))
    truths = {p.shot.name: true for p in photos if (true := _truth(home, p)) is not None}
    told = sorted(photos, key=lambda p: p.fact.name)
    # Photos of a survey are not part of a photo site.
    _write_lines(folder / TABLE_FILE, (_table_row(p.fact, p.geotag) for p in told if p.fact.kind != "survey"))
    _write_lines(folder / FACTS_FILE, (asdict(p.fact) | {"time": p.fact.time.isoformat()} for p in told))
    write_truth(folder, Truth(seed=home.seed, epsg=home.epsg, frame=home.frame, images=truths))
    return folder


def _truth(home: Scene, photo: PlannedPhoto) -> TrueImage | None:
    if not photo.fact.home:
        return None
    camera = edited_camera(photo.shot.device.camera, photo.edits, photo.shot.seed)
    if camera is None:
        return None
    device = replace(photo.shot.device, camera=camera)
    return true_image(home, replace(photo.shot, device=device, gps_enu=None))


def _picture(scene: Scene, photo: PlannedPhoto) -> Image8:
    if photo.subject == "indoor":
        return indoor_photo(scene, photo.shot.device, photo.shot.seed, photo.sensor)
    if photo.subject == "portrait":
        return portrait_photo(scene, photo.shot.device, photo.shot.seed, photo.sensor)
    return take_photo(scene, photo.shot, photo.sensor)


def _exif(photo: PlannedPhoto, image: Image8) -> Image.Exif | None:
    """EXIF as it is after the edits: editors write the new size and keep the rest."""
    if photo.exif == "none":
        return None
    tag = photo.geotag if photo.exif == "full" else None
    position = None if tag is None else (tag.latitude_deg, tag.longitude_deg, tag.height_m or 0.0)
    exif = exif_of(photo.shot, position)
    exif[ExifTags.Base.Orientation.value] = photo.orientation
    exif[ExifTags.Base.Artist.value] = photo.fact.owner
    exif[ExifTags.Base.Copyright.value] = photo.fact.licence
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.ExifImageWidth.value] = image.shape[1]
    details[ExifTags.Base.ExifImageHeight.value] = image.shape[0]
    if tag is not None:
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        if tag.height_m is None:
            for key in (ExifTags.GPS.GPSAltitude, ExifTags.GPS.GPSAltitudeRef):
                gps.pop(key.value, None)
        if tag.accuracy_m is not None:
            gps[ExifTags.GPS.GPSHPositioningError.value] = float(tag.accuracy_m)
    return exif


@lru_cache(maxsize=4)
def _scene(world: SceneSource, key: str) -> Scene:
    return world.scene(key)


def _write(folder: Path, world: SceneSource, photos: Sequence[PlannedPhoto], number: int) -> None:
    """Write one file under its name by renaming, so that a file that is there is whole."""
    photo = photos[number]
    target = folder / photo.shot.name
    part = target.with_suffix(f".{os.getpid()}.part")
    image = edited(_picture(_scene(world, photo.scene), photo), photo.edits, photo.shot.seed)
    part.write_bytes(jpeg_bytes(image, _exif(photo, image), photo.quality))
    part.replace(target)


def read_facts(folder: Path) -> dict[str, AlbumFact]:
    """Facts by name."""
    lines = (folder / FACTS_FILE).read_text(encoding="utf-8").splitlines()
    facts = [
        AlbumFact(**{**row, "time": datetime.fromisoformat(row["time"])}) for row in map(json.loads, lines)
    ]
    return {fact.name: fact for fact in facts}


def _write_lines(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def _table_row(fact: AlbumFact, tag: Geotag | None) -> dict[str, Any]:
    return {
        "path": fact.name,
        "id": fact.photo_id,
        "lat": None if tag is None else round(tag.latitude_deg, 7),
        "lon": None if tag is None else round(tag.longitude_deg, 7),
        "accuracy": None if tag is None else tag.accuracy_m,
        "time": fact.time.isoformat(),
        "owner": fact.owner,
        "licence": fact.licence,
    }


def indoor_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A room (h, w, 3) uint8 that nobody else has; `scene` lends its textures only."""
    rng = np.random.default_rng((seed, 95))
    size = rng.uniform(4.0, 7.0, 2)
    faces = _room(rng, size)
    plants = _balls(rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (3, 3)) * [*size, 1.0], 0.25, rng)
    centre = np.array([*(rng.uniform(-0.25, 0.25, 2) * size), rng.uniform(1.4, 1.7)])
    pose = look_pose(centre, float(rng.uniform(0, 360)), float(rng.normal(-8, 6)), float(rng.normal(0, 2)))
    return expose(_draw(scene, faces, plants, device, pose), rng, sensor)


def portrait_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A person who fills the frame, in a room out of focus."""
    rng = np.random.default_rng((seed, 96))
    size = rng.uniform(4.0, 7.0, 2)
    pose = look_pose((0.0, -0.3 * size[1], 1.55), float(rng.normal(0, 8)), float(rng.normal(-3, 2)))
    wall = _draw(scene, _room(rng, size), _balls(np.zeros((0, 3)), 0.2, rng), device, pose)
    wall = np.asarray(cv2.GaussianBlur(wall, (0, 0), 0.012 * device.camera.width), dtype=np.uint8)
    ahead = pose.inverse().rotation[:, 2]
    at = pose.center + ahead * float(rng.uniform(0.9, 1.4)) + rng.normal(0, [0.12, 0.0, 0.0])
    body = at + np.array([[0, 0, 0.02], [0, 0, -0.45], [0, 0.03, 0.10]])
    radii = np.array([[0.105, 0.12, 0.145], [0.26, 0.16, 0.36], [0.115, 0.125, 0.11]])
    cloth, hair = rng.uniform(0.2, 2.2, 3), rng.uniform(0.3, 1.2, 3)
    person = Ellipsoids(
        center=body,
        radii=radii,
        tint=np.array([_SKIN, cloth, hair]),
        texture_uv=rng.uniform(0, 500, (3, 2)),
        object_id=np.arange(1, 4, dtype=np.int32),
    )
    rendered = render(
        Faces.concatenate([]), person, device.camera, pose, look=scene_look(scene), supersample=2
    )
    assert rendered.rgb is not None
    skin = cv2.GaussianBlur(rendered.rgb, (0, 0), 2.0)
    seen = np.isfinite(rendered.depth)[..., None]
    return expose(np.where(seen, skin, wall).astype(np.uint8), rng, sensor)


def _draw(scene: Scene, faces: Faces, balls: Ellipsoids, device: Device, pose: Rigid3) -> Image8:
    rendered = render(faces, balls, device.camera, pose, look=scene_look(scene), supersample=2)
    assert rendered.rgb is not None
    return rendered.rgb


def _room(rng: np.random.Generator, size: FloatArray) -> Faces:
    """Walls, floor, ceiling, pictures, furniture; the floor's middle at the origin."""
    x, y, z = 0.5 * size[0], 0.5 * size[1], float(rng.uniform(2.4, 3.0))
    wall = tuple(float(c) for c in rng.uniform(0.75, 1.2, 3))
    corners = np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]])
    parts = [
        face(
            corners[0], corners[3] - corners[0], corners[1] - corners[0], "wood", 1, detail=_start(rng)
        ),  # floor
        face((-x, -y, z), (0, 2 * y, 0), (2 * x, 0, 0), "plain", 2, tint=(1.15,) * 3),  # ceiling
    ]
    for i in range(4):
        start, edge = corners[i], corners[(i + 1) % 4] - corners[i]
        parts.append(face(start, edge, (0, 0, z), "plain", 3 + i, detail=_start(rng), tint=wall))
        inward = np.cross(edge, [0, 0, 1]) / np.linalg.norm(edge)
        for _ in range(int(rng.integers(1, 4))):  # pictures on the wall
            w, h = rng.uniform(0.3, 1.0, 2)
            along = rng.uniform(0.1, 0.9 - w / np.linalg.norm(edge)) * edge
            origin = start + along + inward * 0.02 + [0, 0, rng.uniform(1.0, z - h - 0.1)]
            tint = tuple(float(c) for c in rng.uniform(0.3, 1.3, 3))
            texture = str(rng.choice(["leaves", "fields", "wood", "car"]))
            unit = edge / np.linalg.norm(edge)
            parts.append(face(origin, w * unit, (0, 0, h), texture, 20, detail=_start(rng), tint=tint))
    for i in range(int(rng.integers(4, 9))):
        w, d, h = rng.uniform([0.4, 0.4, 0.4], [1.8, 1.0, 1.9])
        at = rng.uniform(-0.45, 0.45, 2) * size
        away = float(np.linalg.norm(at))
        if away < 1.5:
            at *= 1.5 / max(away, 0.3)
        tint = tuple(float(c) for c in rng.uniform(0.4, 1.2, 3))
        parts.append(
            box(
                float(at[0]),
                float(at[1]),
                0.0,
                (float(w), float(d), float(h)),
                30 + i,
                yaw_deg=float(rng.choice([0, 90])),
                texture=str(rng.choice(["wood", "plain"])),
                detail=_start(rng),
                tint=tint,
            )
        )
    return Faces.concatenate(parts)


def _start(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0, 500)), float(rng.uniform(0, 500))


def _balls(centers: FloatArray, radius: float, rng: np.random.Generator) -> Ellipsoids:
    n = len(centers)
    return Ellipsoids(
        center=np.reshape(centers, (n, 3)),
        radii=radius * rng.uniform(0.7, 1.3, (n, 3)),
        tint=rng.uniform(0.8, 1.2, (n, 3)),
        texture_uv=rng.uniform(0, 500, (n, 2)),
        object_id=np.arange(100, 100 + n, dtype=np.int32),
    )
