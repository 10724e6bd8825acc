"""A set of photos with laser truth, in Strecha's format: its cameras, and copies of its photos with EXIF.

FOLDER has images/ and cameras/, a `NAME.camera` for each photo: calibration, distortion, camera-to-world
rotation, centre in metres, size of the full picture. The centre of the top-left pixel is (0, 0) there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from featuredb.features.exif.write import EXIF_PREFIX, gps_directory, with_app1
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation

FRAME = LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=150.0)  # somewhere on Earth
SIGMA_M = 0.02  # that positions claim
_ROTATION_LINES, _CENTER_LINE, _SIZE_LINE = slice(4, 7), 7, 8
_FIRST_ASKED, _EVERY = 2, 5


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserSet:
    """The set with its world turned upright: up is the mean of the photos' own.

    Attributes:
        photos: folder of the pictures. poses: cam_from_local in `FRAME` by file name.
        camera: the true lens of all, of the pictures' size.
    """

    photos: Path
    poses: dict[str, Rigid3]
    camera: Camera

    @property
    def asked(self) -> tuple[str, ...]:
        """Every fifth photo from the third on."""
        return tuple(sorted(self.poses)[_FIRST_ASKED::_EVERY])

    @property
    def mapped(self) -> tuple[str, ...]:
        """The others."""
        return tuple(sorted(set(self.poses) - set(self.asked)))


def read_laser_set(folder: Path) -> LaserSet:
    """The set in a folder."""
    photos = folder / "images" if (folder / "images").is_dir() else folder
    names = sorted(p.name for p in photos.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))
    if not names:
        raise SystemExit(f"{photos}: expected JPEG files, found none")
    files = {name: camera_file(folder / "cameras", name) for name in names}
    with Image.open(photos / names[0]) as picture:
        size = picture.size
    return LaserSet(
        photos=photos,
        poses=upright({name: true_pose(file) for name, file in files.items()}),
        camera=true_camera(files[names[0]], *size),
    )


def upright(poses: dict[str, Rigid3]) -> dict[str, Rigid3]:
    """The poses in a world whose z axis is the mean of the cameras' up, around their mean centre."""
    up = -np.sum([pose.rotation[1] for pose in poses.values()], axis=0)
    east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    local_from_world = nearest_rotation(
        np.stack([v / np.linalg.norm(v) for v in (east, np.cross(up, east), up)])
    )
    middle = np.mean([pose.center for pose in poses.values()], axis=0)
    local = {}
    for name, pose in poses.items():
        rotation = pose.rotation @ local_from_world.T
        local[name] = Rigid3(
            rotation=rotation, translation=-rotation @ local_from_world @ (pose.center - middle)
        )
    return local


def with_exif(truth: LaserSet, names: Sequence[str], folder: Path, *, positions: bool) -> Path:
    """Copies of photos with EXIF of one camera: focal length in whole millimetres of 35 mm film, position."""
    folder.mkdir(parents=True, exist_ok=True)
    focal_35_mm = round(36.0 * truth.camera.focal_px / max(truth.camera.width, truth.camera.height))
    for name in names:
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Strecha", "laser truth"
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35_mm
        if positions:
            lat, lon, height = FRAME.geodetic_from_enu(truth.poses[name].center)
            gps = gps_directory((float(lat), float(lon), float(height)))
            exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
            exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSHPositioningError] = SIGMA_M
        content = exif.tobytes().removeprefix(EXIF_PREFIX)
        (folder / name).write_bytes(with_app1((truth.photos / name).read_bytes(), content, b""))
    return folder


def camera_file(folder: Path, photo: str) -> Path:
    """Its camera: `0000.camera` or `0000.png.camera`."""
    found = [p for p in (folder / f"{Path(photo).stem}.camera", folder / f"{photo}.camera") if p.is_file()]
    if not found:
        raise SystemExit(f"{folder}: no camera of photo {photo}")
    return found[0]


def true_pose(path: Path) -> Rigid3:
    """The pose in a file of Strecha's: cam_from_world."""
    rows = _rows(path)
    world_from_cam, center = nearest_rotation(rows[_ROTATION_LINES]), np.array(rows[_CENTER_LINE])
    return Rigid3(rotation=world_from_cam.T, translation=-world_from_cam.T @ center)


def true_camera(path: Path, width: int, height: int) -> Camera:
    """The lens in a file of Strecha's, for pictures of another size of the same view."""
    rows = _rows(path)
    full_width, full_height = rows[_SIZE_LINE]
    sx, sy = width / full_width, height / full_height
    params = (sx * rows[0][0], sy * rows[1][1], sx * (rows[0][2] + 0.5), sy * (rows[1][2] + 0.5))
    return Camera(model="PINHOLE", width=width, height=height, params=params)


def centers(poses: Sequence[Rigid3]) -> FloatArray:
    """(n, 3)."""
    return np.array([pose.center for pose in poses]).reshape(-1, 3)


def _rows(path: Path) -> list[list[float]]:
    return [[float(word) for word in line.split()] for line in path.read_text(encoding="utf-8").splitlines()]
