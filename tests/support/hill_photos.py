"""A folder of small photos of textured hills, with GPS in EXIF and the truth beside it."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from tests.support.planar_map import field_texture, view

FRAME = LocalFrame(latitude_deg=48.99, longitude_deg=8.41, height_m=120.0)
CAMERA = Camera(model="PINHOLE", width=640, height=480, params=(600.0, 600.0, 320.0, 240.0))
_SIDE_M, _TEXEL_M = 120.0, 0.08  # of field_texture


@dataclass(frozen=True, slots=True, kw_only=True)
class HillPhoto:
    """One photo and where it was taken, in FRAME."""

    name: str
    cam_from_local: Rigid3


def hill_height(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres above FRAME's origin: slopes of at most 0.5."""
    return 3.0 * np.sin(east / 7.0 + 0.5) * np.cos(north / 9.0) + 1.5 * np.sin(north / 4.0)


def write_hill_photos(
    folder: Path,
    *,
    columns: int = 3,
    rows: int = 3,
    spacing_m: float = 9.0,
    texture_seed: int = 1,
    east_m: float = 0.0,
    gps_noise_m: float = 0.0,
    with_gps: bool = True,
    prefix: str = "photo",
) -> list[HillPhoto]:
    """Write a block of photos from some 45 m above the hills; GPS is exact but for the noise."""
    folder.mkdir(parents=True, exist_ok=True)
    texture = field_texture(texture_seed)
    rng = np.random.default_rng(texture_seed)
    photos = hill_photos(columns=columns, rows=rows, spacing_m=spacing_m, prefix=prefix)
    for k, photo in enumerate(photos):
        center = photo.cam_from_local.center + [east_m, 0, 0] + rng.normal(0, 1, 3) * gps_noise_m
        picture = Image.fromarray(_render(texture, photo.cam_from_local, seed=k))
        picture.save(folder / photo.name, quality=92, exif=_exif(center, k, with_gps=with_gps))
    return photos


def hill_photos(
    *, columns: int = 3, rows: int = 3, spacing_m: float = 9.0, prefix: str = "photo"
) -> list[HillPhoto]:
    """The truth of what `write_hill_photos` writes."""
    photos = []
    for k in range(columns * rows):
        column, row = k % columns, k // columns
        east = (column - (columns - 1) / 2) * spacing_m
        north = (row - (rows - 1) / 2) * spacing_m
        up = 45.0 + 3.0 * ((k * 7) % 3)
        pose = view(east, north, up, tilt_deg=float((k * 5) % 13), heading_deg=float((k * 37) % 50))
        photos.append(HillPhoto(name=f"{prefix}_{k:02d}.jpg", cam_from_local=pose))
    return photos


def _render(texture: NDArray[np.uint8], pose: Rigid3, seed: int) -> NDArray[np.uint8]:
    columns, rows = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = CAMERA.unproject(np.stack([columns.ravel(), rows.ravel()], axis=1))
    directions = pose.rotation.T @ np.vstack([rays.T, np.ones(len(rays))])
    slope = (directions[:2] / directions[2]).reshape(2, CAMERA.height, CAMERA.width)
    # Every eighth pixel from scratch; what lies between starts from them, a few millimetres off.
    coarse = _heights_where_rays_meet(slope[:, ::8, ::8], pose.center, np.zeros((1, 1)), rounds=8)
    at = [((centres - 0.5) / 8).astype(np.float32) for centres in (columns, rows)]
    start = cv2.remap(coarse, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    up = _heights_where_rays_meet(slope, pose.center, start, rounds=2) - pose.center[2]
    u = (pose.center[0] + slope[0] * up + _SIDE_M / 2) / _TEXEL_M - 0.5
    v = (_SIDE_M / 2 - pose.center[1] - slope[1] * up) / _TEXEL_M - 0.5
    image = cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _heights_where_rays_meet(
    slope: NDArray[np.float64], center: NDArray[np.float64], height: NDArray[np.float64], rounds: int
) -> NDArray[np.float64]:
    """Newton's method on the height, from `height`, for rays from `center`.

    Args:
        slope: (2, h, w), how far east and north each ray goes on a metre of height.
    """
    for _ in range(rounds):
        up = height - center[2]
        east, north = center[0] + slope[0] * up, center[1] + slope[1] * up
        # The derivatives of hill_height.
        along_east = 3.0 / 7.0 * np.cos(east / 7.0 + 0.5) * np.cos(north / 9.0)
        along_north = -3.0 / 9.0 * np.sin(east / 7.0 + 0.5) * np.sin(north / 9.0) + 1.5 / 4.0 * np.cos(
            north / 4.0
        )
        gradient = slope[0] * along_east + slope[1] * along_north - 1.0
        height = height - (hill_height(east, north) - height) / gradient
    return height


def _exif(enu: NDArray[np.float64], number: int, *, with_gps: bool) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make.value], exif[ExifTags.Base.Model.value] = "Test", "Hill 1"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    time = datetime(2026, 5, 1, 12) + timedelta(seconds=2 * number)
    details[ExifTags.Base.DateTimeOriginal.value] = time.strftime("%Y:%m:%d %H:%M:%S")
    # 600 px over the diagonal of 800 px, times the 43.27 mm diagonal of 35 mm film.
    details[ExifTags.Base.FocalLengthIn35mmFilm.value] = round(600 / 800 * 43.27)
    if with_gps:
        latitude, longitude, height = (float(v) for v in FRAME.geodetic_from_enu(enu))
        tags = ExifTags.GPS
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(
            {
                tags.GPSLatitudeRef.value: "N",
                tags.GPSLatitude.value: (IFDRational(round(latitude * 10**9), 10**9), 0, 0),
                tags.GPSLongitudeRef.value: "E",
                tags.GPSLongitude.value: (IFDRational(round(longitude * 10**9), 10**9), 0, 0),
                tags.GPSAltitudeRef.value: b"\x00",
                tags.GPSAltitude.value: IFDRational(round(height * 1000), 1000),
            }
        )
    return exif
