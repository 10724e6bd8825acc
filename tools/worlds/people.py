"""Twelve people with cameras: what they own, how well they use it, and what they leave in their files."""

from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.simworld.camera.photograph import Device, SensorOptions, Shot
from tools.worlds.album import AlbumFact, ExifPolicy, PlannedPhoto
from tools.worlds.edits import Edit

Upright = Literal["never", "tagged", "stored"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """A contributor.

    Attributes:
        name, licence: attribution.
        drone, ground: cameras, None where there is none.
        drone_share: of the photos taken by drone.
        weight: how many photos, relative to the others.
        heights_m: of most drone photos over the ground.
        skill: 0 to 1; careless people tilt the camera, stand anywhere and blur their photos.
        upright: ground photos held upright: never, stored as landscape with an EXIF orientation, or
            stored upright.
        zoom: largest factor on the focal length of the ground camera.
        exif: what is left of it.
        tags: share of photos with a geotag.
        by_hand: geotags are set on the site's map, without height.
        quality: of the JPEG.
        edits: on every photo. crop_share: of the photos that are cropped as well.
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


def planned(
    person: Person, shot: Shot, scene: str, kind: str, *, exif: ExifPolicy = "full", **more: Any
) -> PlannedPhoto:
    """A photo by a person; `more`: fields of `PlannedPhoto`, and of its fact."""
    told = {field.name: more.pop(field.name) for field in fields(AlbumFact) if field.name in more}
    fact = {"owner": person.name, "photo_id": "", "licence": person.licence} | told
    return PlannedPhoto(
        shot=shot,
        scene=scene,
        fact=AlbumFact(name=shot.name, kind=kind, time=shot.time, **fact),
        exif=exif,
        quality=person.quality,
        sensor=person.sensor,
        **more,
    )


def make_device(
    make: str,
    model: str,
    size: tuple[int, int],
    focal_35mm: float,
    lens: tuple[float, ...],
    focal_mm: float = 5.0,
) -> Device:
    """A camera by its 35 mm equivalent (of the width) and its distortion.

    Args:
        lens: one number for SIMPLE_RADIAL, two for RADIAL, four for OPENCV.
    """
    w, h = size
    f = focal_35mm / 36.0 * w
    cx, cy = (0.5 + 0.001) * w, 0.5 * h - 0.0007 * w
    if len(lens) == 4:
        camera = Camera(model="OPENCV", width=w, height=h, params=(f, 1.0005 * f, cx, cy, *lens))
    else:
        name = "SIMPLE_RADIAL" if len(lens) == 1 else "RADIAL"
        camera = Camera(model=name, width=w, height=h, params=(f, cx, cy, *lens))
    return Device(make=make, model=model, camera=camera, focal_mm=focal_mm, focal_35mm=round(focal_35mm))


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
    f, cx, cy, *lens = camera.params
    if camera.model == "OPENCV":
        raise InvalidValueError("stored_upright: expected a camera with one focal length, found OPENCV")
    turned = replace(
        camera, width=camera.height, height=camera.width, params=(f, camera.height - cy, cx, *lens)
    )
    return replace(device, camera=turned)


def community(width: int = 1600) -> tuple[Person, ...]:
    """Twelve people; `width` is that of the widest camera, pixels."""

    def px(share: float, aspect: float) -> tuple[int, int]:
        w = round(share * width / 4) * 4
        return w, round(w * aspect / 4) * 4

    big = make_device(
        "Simworld", "SW-Drone 2 Pro", px(1.0, 0.75), 24.3, (-0.062, 0.024, 0.0005, -0.0004), 10.3
    )
    big_too = make_device(
        "Simworld", "SW-Drone 2 Pro", px(1.0, 0.75), 24.1, (-0.059, 0.022, -0.0003, 0.0002), 10.3
    )
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
        Person(name="anna", ground=phone_a, upright="tagged", weight=1.3, skill=0.7),
        Person(name="bert", drone=big, drone_share=1.0, weight=1.5, heights_m=(45, 110), skill=0.9),
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
            weight=1.0,
            exif="no_gps",
            by_hand=True,
            licence="CC-BY-SA-2.0",
            skill=0.8,
        ),
        Person(
            name="elif",
            drone=mini_too,
            drone_share=1.0,
            weight=1.1,
            heights_m=(20, 70),
            exif="none",
            by_hand=True,
        ),
        Person(name="farid", ground=phone_old, weight=0.7, skill=0.35, quality=74, sensor=poor),
        Person(name="greta", drone=wide, drone_share=1.0, weight=0.8, heights_m=(15, 50), skill=0.6),
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
            weight=1.0,
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
        Person(
            name="kiri",
            ground=phone_b,
            weight=1.0,
            crop_share=0.3,
            exif="no_gps",
            licence="CC0-1.0",
            skill=0.6,
        ),
        Person(
            name="lena",
            drone=air,
            ground=compact,
            drone_share=0.75,
            weight=1.0,
            heights_m=(18, 90),
            tags=0.0,
            skill=0.7,
        ),
    )
