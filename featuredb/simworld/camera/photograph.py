"""Takes one planned photo of a scene: moving things, light, lens, file."""

import numpy as np
from PIL import Image

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.exif import exif_of
from featuredb.simworld.camera.look import scene_look
from featuredb.simworld.camera.raster import Rendered, render
from featuredb.simworld.camera.sensor import SensorOptions, expose, jpeg_bytes
from featuredb.simworld.camera.shot import Shot
from featuredb.simworld.town.scene import Faces, Scene
from featuredb.simworld.town.solids import car
from featuredb.simworld.town.texture import Image8

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
    exif: Image.Exif | None = exif_of(shot, gps_geodetic(scene, shot))
    return jpeg_bytes(take_photo(scene, shot, sensor), sensor.jpeg_quality, exif)


def gps_geodetic(scene: Scene, shot: Shot) -> tuple[float, float, float] | None:
    """Latitude, longitude (degrees) and ellipsoidal height (m) that the shot's receiver believes."""
    if shot.gps_enu is None:
        return None
    latitude, longitude, height = scene.frame.geodetic_from_enu(shot.gps_enu)
    return float(latitude), float(longitude), float(height)
