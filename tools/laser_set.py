"""A set of photos with laser truth, in Strecha's format: its cameras, and copies of its photos with EXIF.

FOLDER has images/, and cameras/ with a `0000.camera` for each photo `0000.jpg`: calibration, distortion,
camera-to-world rotation, centre in metres, size of the full picture; the first pixel's centre is (0, 0).
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from PIL import ExifTags, Image

from featuredb.features.exif.write import EXIF_PREFIX, with_app1
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation
from featuredb.geometry.sim3 import Sim3
from tools.photo_files import photo_names, with_place

FRAME = LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=150.0)  # somewhere on Earth
SIGMA_M = 0.02  # that positions claim
_ROTATION_LINES, _CENTER_LINE, _SIZE_LINE = slice(4, 7), 7, 8
_FIRST_ASKED, _EVERY = 2, 5
_RATIO, _TOLERANCE_PX = 0.8, 4.0
_SIMILARITY_M = 0.1  # of RANSAC; centres that are further off do not fit


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
    photos = folder / "images"
    files = {name: folder / "cameras" / f"{Path(name).stem}.camera" for name in photo_names(photos)}
    first, *_ = files
    with Image.open(photos / first) as picture:
        camera = true_camera(files[first], *picture.size)
    poses = upright({name: true_pose(file) for name, file in files.items()})
    return LaserSet(photos=photos, poses=poses, camera=camera)


def upright(poses: dict[str, Rigid3]) -> dict[str, Rigid3]:
    """The poses in a world whose z axis is the mean of the cameras' up, around their mean centre."""
    up = -np.sum([pose.rotation[1] for pose in poses.values()], axis=0)
    east = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    turn = nearest_rotation(np.stack([v / np.linalg.norm(v) for v in (east, np.cross(up, east), up)]))
    middle = np.mean([pose.center for pose in poses.values()], axis=0)
    upright_from_world = Sim3(scale=1.0, rotation=turn, translation=-turn @ middle)
    return {name: upright_from_world.act_on_pose(pose) for name, pose in poses.items()}


def with_exif(truth: LaserSet, names: Sequence[str], folder: Path, *, positions: bool) -> Path:
    """Copies of photos with EXIF of one camera: focal length in whole millimetres of 35 mm film, position."""
    folder.mkdir(parents=True, exist_ok=True)
    focal_35_mm = round(36.0 * truth.camera.focal_px / max(truth.camera.width, truth.camera.height))
    for name in names:
        exif, picture = Image.Exif(), (truth.photos / name).read_bytes()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Strecha", "laser truth"
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35_mm
        told = with_app1(picture, exif.tobytes().removeprefix(EXIF_PREFIX), b"")
        if positions:
            told = with_place(told, FRAME, truth.poses[name].center, SIGMA_M)
        (folder / name).write_bytes(told)
    return folder


def true_pose(path: Path) -> Rigid3:
    """The pose in a file of Strecha's: cam_from_world."""
    rows = _rows(path)
    return Rigid3.from_center(nearest_rotation(rows[_ROTATION_LINES]).T, np.array(rows[_CENTER_LINE]))


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


def colmap_given_the_lens(truth: LaserSet) -> tuple[dict[str, Rigid3], dict[str, Rigid3]]:
    """What maps and answers are compared with: poses cam_from_local in the set's frame of the model's photos,
    and of those that were asked.

    SIFT, exhaustive matching and incremental mapping with the lens held; the model is moved onto the true
    centres by a robust similarity. Asked photos: nearest RootSIFT descriptor of the model by brute force,
    ratio test, poselib's absolute pose.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        database = _extracted(truth, truth.mapped, work / "mapped.db")
        pycolmap.match_exhaustive(str(database))
        settings = pycolmap.IncrementalPipelineOptions()
        settings.ba_refine_focal_length = settings.ba_refine_extra_params = False
        settings.ba_refine_principal_point = False
        found = pycolmap.incremental_mapping(str(database), str(truth.photos), str(work), settings)
        if not found:
            raise SystemExit("COLMAP makes no model of the photos, even with the true lens")
        model = max(found.values(), key=lambda one: one.num_reg_images())
        images = [model.image(i) for i in model.reg_image_ids()]
        poses = {one.name: Rigid3.from_matrix(one.cam_from_world().matrix()) for one in images}
        move = robust_similarity(centers(list(poses.values())), centers([truth.poses[n] for n in poses]))
        known, asked = _described_points(model, database), {}
        with pycolmap.Database.open(str(_extracted(truth, truth.asked, work / "asked.db"))) as read:
            for image in read.read_all_images():
                pixels = read.read_keypoints(image.image_id)[:, :2]
                pose = _localised(pixels, read.read_descriptors(image.image_id).data, known, truth.camera)
                if pose is not None:
                    asked[image.name] = pose
    mapped, answered = ({n: move.act_on_pose(pose) for n, pose in of.items()} for of in (poses, asked))
    return mapped, answered


def robust_similarity(source: FloatArray, target: FloatArray) -> Sim3:
    """The similarity that takes points (n, 3) onto others, by RANSAC and those that fit."""
    options = pycolmap.RANSACOptions()
    options.max_error = _SIMILARITY_M
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None:
        raise SystemExit("the cameras lie on a line or a point; no similarity can be told")
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    best = pycolmap.estimate_sim3d(source[inliers], target[inliers]) or found["tgt_from_src"]
    return Sim3(scale=best.scale, rotation=best.rotation.matrix(), translation=best.translation)


def _extracted(truth: LaserSet, names: Sequence[str], database: Path) -> Path:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = truth.camera.model
    reader.camera_params = ",".join(f"{p:.9g}" for p in truth.camera.params)
    pycolmap.extract_features(
        str(database),
        str(truth.photos),
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
    )
    return database


class _Known(NamedTuple):
    """Every observation of a model: its point's place (m, 3) and id (m,), its RootSIFT (m, 128) float32."""

    xyz: FloatArray
    point: NDArray[np.int64]
    descriptors: NDArray[np.float32]


def _described_points(model: pycolmap.Reconstruction, database: Path) -> _Known:
    point, descriptors = [], []
    with pycolmap.Database.open(str(database)) as read:
        for image_id in model.reg_image_ids():
            seen = {k: p.point3D_id for k, p in enumerate(model.image(image_id).points2D) if p.has_point3D()}
            descriptors.append(read.read_descriptors(image_id).data[list(seen)])
            point += seen.values()
    return _Known(
        xyz=np.array([model.point3D(p).xyz for p in point]),
        point=np.array(point),
        descriptors=np.concatenate(descriptors).astype(np.float32),
    )


def _localised(pixels: FloatArray, asked: NDArray[np.uint8], known: _Known, lens: Camera) -> Rigid3 | None:
    """cam_from_model; None where too few matches fit."""
    rows: list[int] = []
    seen: list[int] = []
    for start in range(0, len(asked), 500):
        likeness = asked[start : start + 500].astype(np.float32) @ known.descriptors.T
        best = np.argmax(likeness, axis=1)
        first = likeness[np.arange(len(best)), best]
        likeness[known.point == known.point[best][:, None]] = -np.inf
        norm = 2.0 * 512.0**2  # COLMAP's descriptors have this length
        good = (norm - 2 * first) < _RATIO**2 * (norm - 2 * likeness.max(axis=1))
        rows += (start + np.flatnonzero(good)).tolist()
        seen += best[good].tolist()
    camera = {"model": lens.model, "width": lens.width, "height": lens.height, "params": list(lens.params)}
    pose, info = poselib.estimate_absolute_pose(
        pixels[rows].astype(np.float64), known.xyz[seen], camera, {"max_reproj_error": _TOLERANCE_PX}, {}
    )
    if info["num_inliers"] < 12:
        return None
    w, x, y, z = pose.q
    return Rigid3.from_quaternion([x, y, z, w], pose.t)
