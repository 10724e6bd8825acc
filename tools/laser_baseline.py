"""Plain COLMAP, given the true lens, on a set with laser truth: what maps and answers are compared with.

SIFT, exhaustive matching and incremental mapping with the lens held; the model is moved onto the true centres
by a robust similarity. Asked photos: nearest RootSIFT descriptor of the model by brute force, ratio test,
poselib's absolute pose.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from tools.laser_set import LaserSet, centers

_RATIO, _TOLERANCE_PX = 0.8, 4.0
_SIMILARITY_M = 0.1  # of RANSAC; centres that are further off do not fit


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Poses cam_from_local in the set's frame: of the model's photos and of those that were asked."""

    mapped: dict[str, Rigid3]
    asked: dict[str, Rigid3]


def colmap_given_the_lens(truth: LaserSet) -> Baseline:
    """See the module."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        database = _extracted(truth, truth.mapped, work / "mapped.db")
        pycolmap.match_exhaustive(str(database))
        settings = pycolmap.IncrementalPipelineOptions()
        settings.ba_refine_focal_length = settings.ba_refine_extra_params = False
        settings.ba_refine_principal_point = False
        output = work / "models"
        output.mkdir()
        found = pycolmap.incremental_mapping(str(database), str(truth.photos), str(output), settings)
        if not found:
            raise SystemExit("COLMAP makes no model of the photos, even with the true lens")
        model = max(found.values(), key=lambda one: one.num_reg_images())
        poses = {model.image(i).name: _pose(model.image(i)) for i in model.reg_image_ids()}
        move = robust_similarity(
            centers(list(poses.values())), centers([truth.poses[name] for name in poses])
        )
        known = _described_points(model, database)
        asked = {}
        queries = _extracted(truth, truth.asked, work / "asked.db")
        with pycolmap.Database.open(str(queries)) as read:
            for image in read.read_all_images():
                pose = _localised(
                    read.read_keypoints(image.image_id)[:, :2],
                    read.read_descriptors(image.image_id).data,
                    known,
                    truth,
                )
                if pose is not None:
                    asked[image.name] = move.act_on_pose(pose)
    return Baseline(mapped={name: move.act_on_pose(pose) for name, pose in poses.items()}, asked=asked)


def robust_similarity(source: FloatArray, target: FloatArray) -> Sim3:
    """The similarity that takes points (n, 3) onto others, by RANSAC and those that fit."""
    options = pycolmap.RANSACOptions()
    options.max_error = _SIMILARITY_M
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None:
        raise SystemExit("the cameras lie on a line or a point; no similarity can be told")
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    best = pycolmap.estimate_sim3d(source[inliers], target[inliers]) or found["tgt_from_src"]
    return Sim3(
        scale=float(best.scale),
        rotation=np.array(best.rotation.matrix()),
        translation=np.array(best.translation),
    )


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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Known:
    """Every observation of a model: its point's place (m, 3) and id (m,), its RootSIFT (m, 128) float32."""

    xyz: FloatArray
    point: NDArray[np.int64]
    descriptors: NDArray[np.float32]


def _described_points(model: pycolmap.Reconstruction, database: Path) -> _Known:
    point, descriptors = [], []
    with pycolmap.Database.open(str(database)) as read:
        for image_id in model.reg_image_ids():
            seen = [
                (k, p.point3D_id) for k, p in enumerate(model.image(image_id).points2D) if p.has_point3D()
            ]
            descriptors.append(read.read_descriptors(image_id).data[[k for k, _ in seen]])
            point += [p for _, p in seen]
    return _Known(
        xyz=np.array([model.point3D(p).xyz for p in point]),
        point=np.array(point),
        descriptors=np.concatenate(descriptors).astype(np.float32),
    )


def _localised(pixels: FloatArray, asked: NDArray[np.uint8], known: _Known, truth: LaserSet) -> Rigid3 | None:
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
    lens = truth.camera
    camera = {"model": lens.model, "width": lens.width, "height": lens.height, "params": list(lens.params)}
    pose, info = poselib.estimate_absolute_pose(
        pixels[rows].astype(np.float64), known.xyz[seen], camera, {"max_reproj_error": _TOLERANCE_PX}, {}
    )
    if info["num_inliers"] < 12:
        return None
    w, x, y, z = pose.q
    return Rigid3.from_quaternion([x, y, z, w], pose.t)


def _pose(image: pycolmap.Image) -> Rigid3:
    return Rigid3.from_matrix(image.cam_from_world().matrix())
