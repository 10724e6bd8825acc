"""Albums: photos of many people as planned, taken, edited, tagged, and written with a table and the truth.

They show a town on many days, of a part of which there is an anchored survey.

An album's photos lie in a folder per owner under names that give nothing away. Beside them stand
`table.jsonl` as a photo site's programming interface would give it, `truth.json` with every true pose, and
`facts.jsonl` with what each photo really is.
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import ExifTags, Image

from featuredb.simworld.camera.photograph import SensorOptions, Shot, exif_of, jpeg_bytes, take_photo
from featuredb.simworld.flight import FlightOptions, survey
from featuredb.simworld.town.scene import DayOptions, Scene, another_day
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.town.town import OTHER_TOWN_PLACE, TOWN_PLACE, make_town
from featuredb.simworld.world import TRUTH_FILE, Progress, TrueImage, Truth, in_order, true_image, write_truth
from tools.worlds.edits import Edit, edited, edited_camera, indoor_photo, portrait_photo

FACTS_FILE = "facts.jsonl"
TABLE_FILE = "table.jsonl"

# Suns by the hour, town axes; index 0 is the scene's own.
_SUNS = (None, (0.62, -0.42, 0.62), (0.10, -0.55, 0.83), (-0.66, -0.30, 0.55))
_SEASONS = ((1.0, 1.0, 1.0), (1.05, 1.08, 0.9), (1.35, 0.95, 0.6), (0.9, 0.95, 0.9))
_FIRST = datetime(2024, 3, 2, 0, 0, tzinfo=UTC)
DAYS = 730
_OTHER_SEED = 1000

Subject = Literal["town", "indoor", "portrait"]
ExifPolicy = Literal["full", "no_gps", "none"]


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
        owner, licence: as in the table. time: of capture as claimed, timezone-aware.
        home: it shows the town whose frame the truth is in, so that it has a true pose.
        copy_of: the original, "" where this is one. batch: the step in which it arrives.
        visit: photos of one visit by one person share it; -1 for those of none.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class TownOptions:
    """What to write. The same options give the same bytes.

    Attributes:
        seed: of everything. town_size_m: width and height of the town.
        flight: the anchored survey. width: of people's widest camera, pixels.
        texel_m: resolution of the painted ground. pieces: of walls and roofs (see `make_town`).
    """

    seed: int
    town_size_m: tuple[float, float]
    flight: FlightOptions
    width: int = 1200
    texel_m: float = 0.06
    pieces: int = 4

    def scene(self, key: str) -> Scene:
        """Scenes "home/light/week" and, of another town, "away/light/week"."""
        return day_scene(town_of(self, away=key.startswith("away/")), key)


@lru_cache(maxsize=4)
def town_of(options: TownOptions, *, away: bool = False) -> Scene:
    """The town as it was built, or another one elsewhere on Earth."""
    return make_town(
        options.seed + (_OTHER_SEED if away else 0),
        size_m=options.town_size_m,
        place=OTHER_TOWN_PLACE if away else TOWN_PLACE,
        texel_m=options.texel_m,
        pieces=options.pieces,
    )


def day_key(town: str, day: int, hour: float) -> str:
    """Key of the scene of a town on a day (0 to 729) at an hour; days of a week share their parked cars."""
    light = 1 if hour < 11 else 2 if hour < 15 else 3
    return f"{town}/{light}/{day // 7:03d}"


def day_scene(base: Scene, key: str) -> Scene:
    """The scene of a key made by `day_key`; "town/0/000" is the base itself."""
    _, light, week = key.split("/")
    sun = _SUNS[int(light)]
    if sun is None:
        return base
    season = _SEASONS[(int(week) // 13) % 4]
    return another_day(base, DayOptions(seed=int(week) + 1, to_sun=sun, leaf_tint=season))


def moment(day: int, hour: float) -> datetime:
    """Time of a day of the two years."""
    return _FIRST + timedelta(days=day, hours=hour)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedPhoto:
    """One photo of an album.

    Attributes:
        shot: camera, pose, time, name within the album's folder. Its gps_enu is not used.
        scene: key of the scene that it shows. fact: what is true of it. geotag: what it claims.
        exif: full, no_gps (the position is in the table only), or none.
        edits: what was done to it afterwards. quality: of the JPEG.
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
    world: TownOptions,
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
    """
    if (folder / TRUTH_FILE).exists():  # it comes last
        return folder
    home, photos = world.scene("home/0/000"), plan()
    for parent in {(folder / photo.shot.name).parent for photo in photos}:
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
    shot = photo.shot
    camera = edited_camera(shot.device.camera, photo.edits, shot.seed)
    if camera is None:
        return None
    return true_image(home, replace(shot, device=replace(shot.device, camera=camera), gps_enu=None))


def _picture(scene: Scene, photo: PlannedPhoto) -> Image8:
    if photo.subject == "town":
        return take_photo(scene, photo.shot, photo.sensor)
    draw = indoor_photo if photo.subject == "indoor" else portrait_photo
    return draw(scene, photo.shot.device, photo.shot.seed, photo.sensor)


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
def _scene(world: TownOptions, key: str) -> Scene:
    return world.scene(key)


def _write(folder: Path, world: TownOptions, photos: Sequence[PlannedPhoto], number: int) -> None:
    """Write one file under its name by renaming, so that a file that is there is whole."""
    photo = photos[number]
    target = folder / photo.shot.name
    part = target.with_suffix(f".{os.getpid()}.part")
    image = edited(_picture(_scene(world, photo.scene), photo), photo.edits, photo.shot.seed)
    part.write_bytes(jpeg_bytes(image, _exif(photo, image), photo.quality))
    part.replace(target)


def read_facts(folder: Path) -> dict[str, AlbumFact]:
    """Facts by name."""
    rows = map(json.loads, (folder / FACTS_FILE).read_text(encoding="utf-8").splitlines())
    return {row["name"]: AlbumFact(**row | {"time": datetime.fromisoformat(row["time"])}) for row in rows}


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


def survey_photos(
    scene: Scene, flight: FlightOptions, seed: int, *, folder: str = "survey"
) -> list[PlannedPhoto]:
    """An anchored survey as planned photos: full EXIF, positions as its receiver believes them."""
    photos = []
    for i, shot in enumerate(survey(scene, flight, seed)):
        shot = replace(shot, name=f"{folder}/SW_{i + 1:04d}.jpg")
        assert shot.gps_enu is not None
        latitude, longitude, height = (float(v) for v in scene.frame.geodetic_from_enu(shot.gps_enu))
        fact = AlbumFact(
            name=shot.name,
            photo_id=f"{folder}-{i + 1}",
            kind="survey",
            owner="survey office",
            licence="CC-BY-4.0",
            time=shot.time,
        )
        tag = Geotag(latitude_deg=latitude, longitude_deg=longitude, height_m=height)
        photos.append(PlannedPhoto(shot=shot, scene="home/0/000", fact=fact, geotag=tag))
    return photos


@lru_cache(maxsize=64)
def photo_ids(seed: int, count: int) -> tuple[str, ...]:
    """Numbers as a photo site gives them, all different."""
    rng = np.random.default_rng((seed, 57))
    return tuple(str(n) for n in rng.choice(900_000_000, count, replace=False) + 100_000_000)
