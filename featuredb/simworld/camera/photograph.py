"""Takes one planned photo of a scene: moving things, light, lens, file."""

from functools import lru_cache

import numpy as np
from PIL import ExifTags, Image

from featuredb.features.exif.write import gps_directory, rational
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.raster import Rendered, render
from featuredb.simworld.camera.sensor import SensorOptions, expose, jpeg_bytes
from featuredb.simworld.camera.shading import Look
from featuredb.simworld.camera.shot import Shot
from featuredb.simworld.town.ground import paint_ground
from featuredb.simworld.town.materials import town_textures, water_texture
from featuredb.simworld.town.scene import TEXTURES, Faces, GroundPlan, Scene
from featuredb.simworld.town.solids import car
from featuredb.simworld.town.texture import Image8, Texture

_SUPERSAMPLE = 2  # rays per pixel and direction; with one, thin things flicker and edges are jagged
_CAR_SPACING_M = 70.0  # moving cars along a lane, on average
_CAR_M_S = 9.0
_MOVING_ID = 30_000


def take_photo(scene: Scene, shot: Shot, sensor: SensorOptions) -> Image8:
    """The picture (h, w, 3) uint8 RGB of a shot, with that moment's cars and waves."""
    rng = np.random.default_rng((shot.seed, 5))
    picture = render_view(scene, shot.device.camera, shot.cam_from_local, moment=shot.seed)
    return expose(picture, rng, sensor)


def render_view(scene: Scene, camera: Camera, cam_from_local: Rigid3, *, moment: int) -> Image8:
    """The light (h, w, 3) uint8 that reaches a camera at a moment, before the sensor."""
    faces = Faces.concatenate([scene.faces, moving_cars(scene, moment)])
    look = scene_look(scene, water_seed=moment)
    rendered = render(faces, scene.ellipsoids, camera, cam_from_local, look=look, supersample=_SUPERSAMPLE)
    assert rendered.rgb is not None
    return rendered.rgb


def render_depth(scene: Scene, camera: Camera, cam_from_local: Rigid3) -> Rendered:
    """Exact depth (h, w) float32 and object ids of what stands still, at the pixels' centres; no colour."""
    return render(scene.faces, scene.ellipsoids, camera, cam_from_local)


def moving_cars(scene: Scene, moment: int, time_s: float = 0.0) -> Faces:
    """Cars on the lanes at a moment, in the local frame.

    Args:
        time_s: after that moment; they drive on, and come in again where their street begins.
    """
    rng = np.random.default_rng((scene.seed, moment, 6))
    places = []
    for s in scene.plan.streets:
        for lane, heading in ((-0.25 * s.width, 0.0), (0.25 * s.width, 180.0)):
            for _ in range(rng.poisson((s.end - s.start) / _CAR_SPACING_M)):
                a = float(rng.uniform(s.start + 4, s.end - 4))
                if time_s:
                    ahead = _CAR_M_S * time_s * (1.0 if heading == 0.0 else -1.0)
                    a = s.start + 4 + (a - s.start - 4 + ahead) % (s.end - s.start - 8)
                x, y = (a, s.at + lane) if s.along == "x" else (s.at - lane, a)
                over_water = scene.plan.river[0] - 3 < y < scene.plan.river[1] + 3
                base = 0.03 if over_water else float(scene.plan.height(y))
                places.append((x, y, base, heading + (0.0 if s.along == "x" else 90.0)))
    n = len(places)
    tints = rng.uniform(0.15, 1.0, (n, 1)) * rng.uniform(0.6, 1.0, (n, 3))
    cars = Faces.concatenate(
        [car(*place, tint.tolist(), _MOVING_ID) for place, tint in zip(places, tints, strict=True)]
    )
    return cars.shaded(scene.plan.to_sun).moved(scene.enu_from_town, np.zeros(3))


def photo_bytes(scene: Scene, shot: Shot, sensor: SensorOptions) -> bytes:
    """The JPEG file of a shot."""
    believed: tuple[float, float, float] | None = None
    if shot.gps_enu is not None:
        latitude, longitude, height = scene.frame.geodetic_from_enu(shot.gps_enu).tolist()
        believed = latitude, longitude, height
    return jpeg_bytes(take_photo(scene, shot, sensor), exif_of(shot, believed))


def exif_of(shot: Shot, lat_lon_h: tuple[float, float, float] | None) -> Image.Exif:
    """The EXIF block of a shot; GPS only where `lat_lon_h` (degrees, degrees, metres) is given.

    The altitude is written with reference 0 or 1 as is; this world's receivers count from the ellipsoid.
    """
    exif = Image.Exif()
    base, time = ExifTags.Base, shot.time
    stamp = time.strftime("%Y:%m:%d %H:%M:%S")
    offset = time.strftime("%z")
    exif[base.Make.value], exif[base.Model.value] = shot.device.make, shot.device.model
    exif[base.Orientation.value] = 1
    exif[base.Software.value] = "featuredb simworld"
    exif[base.DateTime.value] = stamp
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[base.DateTimeOriginal.value] = stamp
    details[base.OffsetTimeOriginal.value] = f"{offset[:3]}:{offset[3:]}"
    details[base.SubsecTimeOriginal.value] = f"{time.microsecond // 1000:03d}"
    details[base.FocalLength.value] = rational(shot.device.focal_mm, 100)
    details[base.FocalLengthIn35mmFilm.value] = shot.device.focal_35mm
    details[base.ExifImageWidth.value] = shot.device.camera.width
    details[base.ExifImageHeight.value] = shot.device.camera.height
    if lat_lon_h is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps_directory(lat_lon_h))
    return exif


def scene_look(scene: Scene, water_seed: int = 0) -> Look:
    """Textures and light of a scene; the water is that of the moment `water_seed`."""
    still = _materials(scene.seed, scene.pieces)
    painted = {"water": water_texture(water_seed), "ground": _ground(scene.plan, scene.texel_m)}
    textures = tuple(painted.get(name) or still[name] for name in TEXTURES)
    to_sun = scene.enu_from_town @ np.asarray(scene.plan.to_sun)
    return Look(textures=textures, detail=still["detail"], to_sun=to_sun)


@lru_cache(maxsize=4)
def _materials(seed: int, pieces: int) -> dict[str, Texture]:
    return town_textures(seed, pieces)


@lru_cache(maxsize=2)
def _ground(plan: GroundPlan, texel_m: float) -> Texture:
    return paint_ground(plan, texel_m)
