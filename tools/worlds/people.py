"""Twelve people with cameras: what they own, how well they use it, and what they leave in their files."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.simworld.camera.photograph import Device, SensorOptions, Shot
from featuredb.simworld.town.scene import Scene
from tools.worlds.album import AlbumFact, ExifPolicy, Geotag, PlannedPhoto
from tools.worlds.edits import Edit

Upright = Literal["never", "tagged", "stored"]
_FAR_M = (1_000.0, 12_000.0)
_HEIGHT_SIGMA_M = 15.0  # of the heights, where there are any
ACCURACY_SHARE = 0.6  # of the tagged photos, those that say how accurate they are


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """A contributor.

    Attributes:
        drone, ground: cameras. drone_share: of the photos taken by drone, of who has both.
        weight: how many photos, relative to the others.
        heights_m: of most drone photos over the ground.
        skill: 0 to 1; careless people tilt the camera, stand anywhere and blur their photos.
        upright: ground photos held upright: never, stored as landscape with an EXIF orientation, or
            stored upright.
        zoom: largest factor on the focal length of the ground camera.
        exif: what is left of it. tags: share of photos with a geotag.
        by_hand: geotags are set on the site's map, without height.
        edits: on every photo. crop_share: of the photos that are cropped as well. quality: of the JPEG.
    """

    name: str
    licence: str = "CC-BY-4.0"
    drone: Device | None = None
    ground: Device | None = None
    drone_share: float = 0.0
    weight: float = 1.0
    heights_m: tuple[float, float] = (25.0, 80.0)
    skill: float = 0.7
    upright: Upright = "never"
    zoom: float = 1.0
    exif: ExifPolicy = "full"
    tags: float = 0.95
    by_hand: bool = False
    quality: int = 88
    edits: tuple[Edit, ...] = ()
    crop_share: float = 0.0
    sensor: SensorOptions = field(default_factory=SensorOptions)


def planned(person: Person, kind: str, **more: Any) -> PlannedPhoto:
    """A photo by a person; `more`: fields of `PlannedPhoto`, of its shot, and of its fact."""

    def told(of: type) -> dict[str, Any]:
        return {field.name: more.pop(field.name) for field in fields(of) if field.name in more}

    shot = Shot(**told(Shot))
    fact = {"owner": person.name, "photo_id": "", "licence": person.licence} | told(AlbumFact)
    return PlannedPhoto(
        shot=shot,
        fact=AlbumFact(name=shot.name, kind=kind, time=shot.time, **fact),
        quality=person.quality,
        sensor=person.sensor,
        **more,
    )


def make_device(
    make: str, name: str, size: tuple[int, int], focal_35mm: float, lens: tuple[float, ...], focal_mm: float
) -> Device:
    """A camera by its 35 mm equivalent (of the width) and its distortion: one number for SIMPLE_RADIAL, two
    for RADIAL, four for OPENCV."""
    w, h = size
    f = focal_35mm / 36.0 * w
    model = {1: "SIMPLE_RADIAL", 2: "RADIAL", 4: "OPENCV"}[len(lens)]
    focals = (f, 1.0005 * f) if model == "OPENCV" else (f,)
    params = (*focals, (0.5 + 0.001) * w, 0.5 * h - 0.0007 * w, *lens)
    camera = Camera(model=model, width=w, height=h, params=params)
    return Device(make=make, model=name, camera=camera, focal_mm=focal_mm, focal_35mm=round(focal_35mm))


def zoomed(device: Device, factor: float) -> Device:
    """The camera with its lens at another focal length; distortion falls with the field of view."""
    camera = device.camera
    count = 2 if camera.model == "OPENCV" else 1
    lens = tuple(k / factor**1.5 for k in camera.params[count + 2 :])
    params = (*(f * factor for f in camera.params[:count]), *camera.params[count : count + 2], *lens)
    return replace(
        device,
        camera=replace(camera, params=params),
        focal_mm=device.focal_mm * factor,
        focal_35mm=round(device.focal_35mm * factor),
    )


def stored_upright(device: Device) -> Device:
    """The same camera turned by a quarter, pixels stored upright."""
    camera = device.camera
    f, cx, cy, *lens = camera.params  # of one focal length: nobody holds others upright
    params = (f, camera.height - cy, cx, *lens)
    return replace(device, camera=replace(camera, width=camera.height, height=camera.width, params=params))


def community(width: int = 1600) -> tuple[Person, ...]:
    """Twelve people; `width` is that of the widest camera, pixels."""

    def px(share: float, aspect: float) -> tuple[int, int]:
        w = round(share * width / 4) * 4
        return w, round(w * aspect / 4) * 4

    pro = partial(make_device, "Simworld", "SW-Drone 2 Pro", px(1.0, 0.75), focal_mm=10.3)
    big = pro(24.3, (-0.062, 0.024, 0.0005, -0.0004))
    big_too = pro(24.1, (-0.059, 0.022, -0.0003, 0.0002))
    mini = make_device("Simworld", "SW-Mini", px(0.9, 0.75), 28.7, (0.021, -0.013), 6.7)
    mini_too = make_device("Simworld", "SW-Mini", px(0.9, 0.75), 29.2, (0.024, -0.016), 6.7)
    wide = make_device("Otherworld", "Action 7", px(0.95, 0.5625), 19.0, (-0.11, 0.031, 0.0002, 0.0003), 3.0)
    air = make_device("Skyward", "Air", px(0.95, 0.6667), 26.0, (-0.031, 0.009), 8.4)
    phone_a = make_device("Fruit", "Phone 13", px(0.9, 0.75), 26.4, (0.041,), 4.2)
    phone_b = make_device("Robot", "G-20", px(0.85, 0.75), 27.2, (0.028, -0.011), 5.4)
    phone_old = make_device("Robot", "G-3", px(0.64, 0.75), 30.5, (-0.034,), 3.7)
    chat = make_device("", "", px(0.8, 0.5625), 27.5, (0.03,), 4.5)
    compact = make_device("Lumen", "Z10", px(1.0, 0.6667), 28.0, (-0.06, 0.02), 8.8)
    system = make_device("Lumen", "System 4", px(1.0, 0.6667), 34.5, (-0.024,), 23.0)
    poor = SensorOptions(blur_px=0.95, read_noise=2.2, shot_noise=4.5, exposure_sigma_ev=0.35)
    return (
        Person(name="anna", ground=phone_a, upright="tagged", weight=1.3),
        Person(name="bert", drone=big, weight=1.5, heights_m=(45, 110), skill=0.9),
        Person(
            name="carla",
            drone=mini,
            ground=phone_b,
            drone_share=0.7,
            weight=1.4,
            heights_m=(15, 60),
            skill=0.8,
        ),
        Person(
            name="dmitri",
            ground=compact,
            zoom=2.2,
            exif="no_gps",
            by_hand=True,
            licence="CC-BY-SA-2.0",
            skill=0.8,
        ),
        Person(name="elif", drone=mini_too, weight=1.1, heights_m=(20, 70), exif="none", by_hand=True),
        Person(name="farid", ground=phone_old, weight=0.7, skill=0.35, quality=74, sensor=poor),
        Person(name="greta", drone=wide, weight=0.8, heights_m=(15, 50), skill=0.6),
        Person(
            name="hugo",
            ground=chat,
            upright="stored",
            weight=0.7,
            exif="none",
            tags=0.5,
            by_hand=True,
            quality=72,
            skill=0.5,
        ),
        Person(
            name="ines",
            drone=big_too,
            ground=system,
            drone_share=0.6,
            heights_m=(30, 100),
            skill=0.95,
            licence="CC-BY-NC-4.0",
            edits=(
                Edit(kind="watermarked", amount=0.35, text="ines photo"),
                Edit(kind="bordered", amount=0.02),
            ),
        ),
        Person(
            name="jonas",
            drone=mini,
            ground=phone_a,
            drone_share=0.85,
            weight=1.6,
            heights_m=(15, 45),
            skill=0.9,
        ),
        Person(name="kiri", ground=phone_b, crop_share=0.3, exif="no_gps", licence="CC0-1.0", skill=0.6),
        Person(name="lena", drone=air, ground=compact, drone_share=0.75, heights_m=(18, 90), tags=0.0),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class GeotagOptions:
    """How wrong geotags are.

    Attributes:
        sigma_m: standard deviation per horizontal axis of an ordinary geotag; half of the variance is
            common to the photos of a visit. So the distance from the truth is sigma times root 2, rms.
        far_share: of the tagged photos, those that are wrong by 1 to 12 km; half of them as whole visits.
    """

    sigma_m: float = 30.0
    far_share: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tagging:
    """One photo that may get a geotag: where it was taken (3,) local, its visit, whether, and how."""

    center: FloatArray
    visit: int
    tagged: bool
    by_hand: bool


def give_geotags(
    scene: Scene, photos: Sequence[Tagging], options: GeotagOptions, rng: np.random.Generator
) -> list[Geotag | None]:
    """A geotag for each photo; those of the far kind claim the same accuracy as others."""
    far = _far_ones(photos, options.far_share, rng)
    share = np.sqrt(0.5) * options.sigma_m
    shared: dict[int, FloatArray] = {}
    given: list[Geotag | None] = []
    for i, photo in enumerate(photos):
        common = shared.setdefault(photo.visit, rng.normal(0, share, 2))
        error = rng.normal(0, share, 2) + common
        height_error = float(rng.normal(0, _HEIGHT_SIGMA_M))
        claimed = float(np.clip(np.round(options.sigma_m * rng.lognormal(0.0, 0.4)), 3, 200))
        says = rng.random() < ACCURACY_SHARE
        height = None if photo.by_hand else height_error
        center = photo.center + np.append(far.get(i, error), 0.0)
        tag = geotag_at(scene, center, height, claimed if says else None)
        given.append(tag if photo.tagged else None)
    return given


def geotag_at(
    scene: Scene, point: FloatArray, height_error_m: float | None, accuracy_m: float | None
) -> Geotag:
    """The geotag of a point (3,) in the scene's local frame; without height where the error is None."""
    latitude, longitude, height = scene.frame.geodetic_from_enu(point)
    return Geotag(
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        height_m=None if height_error_m is None else float(height) + height_error_m,
        accuracy_m=accuracy_m,
    )


def _far_ones(photos: Sequence[Tagging], share: float, rng: np.random.Generator) -> dict[int, FloatArray]:
    """Errors (2,) of the photos that are wrong by kilometres: whole visits first, then single ones."""
    tagged = [i for i, photo in enumerate(photos) if photo.tagged]
    wanted = round(share * len(tagged))
    far: dict[int, FloatArray] = {}
    visits = sorted({photos[i].visit for i in tagged})
    for visit in rng.permutation(visits):
        mine = [i for i in tagged if photos[i].visit == visit]
        if len(far) + len(mine) <= wanted // 2:
            error = _far_error(rng)
            far |= {i: error + rng.normal(0, 10.0, 2) for i in mine}
    for i in rng.permutation([i for i in tagged if i not in far])[: wanted - len(far)]:
        far[int(i)] = _far_error(rng)
    return far


def _far_error(rng: np.random.Generator) -> FloatArray:
    distance = _FAR_M[0] * (_FAR_M[1] / _FAR_M[0]) ** rng.random()
    angle = rng.uniform(0, 2 * np.pi)
    return np.asarray(distance * np.array([np.cos(angle), np.sin(angle)]), dtype=np.float64)
