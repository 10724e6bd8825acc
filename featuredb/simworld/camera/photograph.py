"""One photo of a scene, from its plan to the file: who looks from where, what moves, lens, noise, EXIF."""

import io
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import ExifTags, Image

from featuredb.features.exif.write import gps_directory, rational
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.raster import Rendered, render
from featuredb.simworld.camera.shading import Look
from featuredb.simworld.town.blocks import car
from featuredb.simworld.town.ground import paint_ground
from featuredb.simworld.town.materials import town_textures, water_texture
from featuredb.simworld.town.scene import TEXTURES, Faces, GroundPlan, Scene
from featuredb.simworld.town.texture import Image8, Texture, to_image


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """What a small camera does to the light.

    Attributes:
        blur_px: standard deviation of lens and motion blur.
        vignetting: share of light lost in the corner.
        exposure_sigma_ev: spread of the exposure between photos, stops.
        white_balance_sigma: spread of the red and blue gains between photos.
        read_noise: standard deviation in grey levels, independent of the light.
        shot_noise: standard deviation in grey levels at mid grey (128), growing with the root of the light.
    """

    blur_px: float = 0.55  # a sharp lens over a Bayer pattern
    vignetting: float = 0.22
    exposure_sigma_ev: float = 0.16
    white_balance_sigma: float = 0.03
    read_noise: float = 1.0
    shot_noise: float = 2.2


def expose(rgb: Image8, rng: np.random.Generator, options: SensorOptions) -> Image8:
    """The photo (h, w, 3) uint8 that a sensor makes of the light `rgb` (h, w, 3) uint8."""
    light = cv2.GaussianBlur(rgb, (0, 0), options.blur_px) if options.blur_px > 0 else rgb
    exposure = 2.0 ** rng.normal(0.0, options.exposure_sigma_ev)
    balance = 1.0 + np.array([1.0, 0.0, 1.0]) * rng.normal(0.0, options.white_balance_sigma, 3)
    gains = (exposure * balance).astype(np.float32)
    photo: NDArray[np.float32] = np.asarray(light, dtype=np.float32) * gains
    photo *= _vignette(rgb.shape[0], rgb.shape[1], options.vignetting)[..., None]
    variance = photo * np.float32(options.shot_noise**2 / 128.0) + np.float32(options.read_noise**2)
    photo += np.sqrt(variance) * rng.standard_normal(photo.shape, dtype=np.float32)
    return to_image(photo)


@lru_cache(maxsize=8)
def _vignette(height: int, width: int, loss: float) -> NDArray[np.float32]:
    """Gain (height, width), 1 in the centre, 1 - loss in the corner, falling with r^2."""
    y = (np.arange(height, dtype=np.float32) + 0.5 - 0.5 * height)[:, None]
    x = (np.arange(width, dtype=np.float32) + 0.5 - 0.5 * width)[None]
    r2 = (x * x + y * y) / (0.25 * (height**2 + width**2))
    return np.asarray(1.0 - loss * r2, dtype=np.float32)


def jpeg_bytes(photo: Image8, exif: Image.Exif | None = None, quality: int = 90) -> bytes:
    """The photo as JPEG, 4:2:0, with the EXIF block if given."""
    buffer = io.BytesIO()
    extra = {"exif": exif} if exif is not None else {}
    Image.fromarray(photo).save(buffer, format="JPEG", quality=quality, **extra)
    return buffer.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """A camera that people buy.

    Attributes:
        camera: true intrinsics, for the picture as stored.
        focal_mm, focal_35mm: as in EXIF; 35 mm equivalents are whole numbers there and so a little wrong.
    """

    make: str
    model: str
    camera: Camera
    focal_mm: float
    focal_35mm: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """One photo to be taken.

    Attributes:
        name: path within the world's folder, with forward slashes.
        time: timezone-aware.
        seed: of everything that differs from photo to photo: moving cars, waves, noise, exposure.
        gps_enu: (3,) metres, what the receiver believes in the local frame, or None without GPS.
    """

    name: str
    device: Device
    cam_from_local: Rigid3
    time: datetime
    seed: int
    gps_enu: FloatArray | None = None


def look_pose(center: ArrayLike, heading_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Rigid3:
    """Pose of a camera at `center` (3,) in the local frame.

    Args:
        heading_deg: of the view, clockwise from north; for a view straight down, of the picture's top.
        pitch_deg: elevation of the view, -90 is straight down.
        roll_deg: clockwise turn of the camera about its view, 90 for a portrait photo.
    """
    h, p, r = np.radians([heading_deg, pitch_deg, roll_deg])
    view = np.array([np.sin(h) * np.cos(p), np.cos(h) * np.cos(p), np.sin(p)])
    right = np.array([np.cos(h), -np.sin(h), 0.0])
    down = np.cross(view, right)
    rotation = np.stack([np.cos(r) * right + np.sin(r) * down, np.cos(r) * down - np.sin(r) * right, view])
    return Rigid3(rotation=rotation, translation=-rotation @ np.asarray(center, dtype=np.float64))


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
