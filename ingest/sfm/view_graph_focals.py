"""Focal lengths of cameras that do not tell theirs, from the fundamental matrices of their pairs.

Without EXIF a photo starts with the focal length of a usual lens. That is good enough for most lenses and
wrong by a factor of two and more for a long one: then no pair of photos makes a start, or every third photo
stays outside. The fundamental matrices of all pairs together know better (Sweeney et al., "Optimizing the
Viewing Graph for Structure-from-Motion", ICCV 2015; COLMAP's view graph calibration). They know nothing where
all pairs are planes, and little where a camera has few pairs.
"""

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import quiet, read_models

# A tenth of the side is the least that COLMAP's own mapping takes for a lens. What is longer than five sides
# (11 degrees of view) comes from pairs that nearly fit a plane.
_FOCAL_OVER_SIDE = (0.1, 5.0)


def calibrate_focals(database: Path, scratch: Path, *, seed: int) -> dict[int, float]:
    """Focal lengths (px) by camera id of cameras without a known one, where the pairs tell it.

    Args:
        database: COLMAP's, of verified pairs; stays as it is.
        scratch: folder for a copy.
    """
    unknown = {c.camera_id: c for c in _cameras(database) if not c.has_prior_focal_length}
    if not unknown:
        return {}
    copy = scratch / "view_graph.db"
    shutil.copyfile(database, copy)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = seed
    options.reestimate_relative_pose = False
    with quiet():
        if not pycolmap.calibrate_view_graph(str(copy), options):
            return {}
    found: dict[int, float] = {}
    low, high = _FOCAL_OVER_SIDE
    for camera in _cameras(copy):
        before = unknown.get(camera.camera_id)
        if before is None or camera.mean_focal_length() == before.mean_focal_length():
            continue  # COLMAP leaves what it rejects as it was
        if low <= camera.mean_focal_length() / max(camera.width, camera.height) <= high:
            found[camera.camera_id] = camera.mean_focal_length()
    return found


def start_from(database: Path, focal_px: Mapping[int, float]) -> None:
    """Write focal lengths into a database as where mapping starts; they do not count as known."""
    with pycolmap.Database.open(str(database)) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focal_px:
                params = camera.params
                params[camera.focal_length_idxs()] = focal_px[camera.camera_id]
                camera.params = params
                opened.update_camera(camera)


def _cameras(database: Path) -> list[pycolmap.Camera]:
    with pycolmap.Database.open(str(database)) as opened:
        return list(opened.read_all_cameras())


# Films straight ahead: a reconstruction that begins with all photos at once, not with two of them.
#
# Incremental mapping begins with two photos. In a flight straight ahead no pair tells the focal length, and
# COLMAP does not begin with a pair that moves along its own view; it begins with two frames between which the
# camera turns. With a wrong focal length a turn passes for structure: every later photo fits what came of it,
# and the lens runs away, to 136 degrees of view and more. Rotations of all pairs together, then all positions
# at once, need no such start (Pan et al., "Global Structure-from-Motion Revisited", ECCV 2024).

# 110 to 11 degrees of view along the longer side: what people film with, once COLMAP's lenses can follow it.
# Outside it another start is tried; nothing is refused by it.
_USUAL_FOCAL_OVER_SIDE = (0.35, 5.0)


def is_usual(camera: Camera) -> bool:
    """Whether people have lenses of that field of view."""
    low, high = _USUAL_FOCAL_OVER_SIDE
    return bool(low <= camera.focal_px / max(camera.width, camera.height) <= high)


def registered_with_usual_lens(models: Path, rows: Iterable[int]) -> int:
    """Photos of the model folders under `models` whose lens is usual, or was known beforehand.

    Args:
        rows: of the photos with a known lens.
    """
    known, good = set(rows), set[int]()
    for model in read_models(models):
        usual = np.array([is_usual(camera) for camera in model.cameras])
        good |= {row for row, c in zip(model.rows.tolist(), model.camera_of, strict=True) if usual[c]}
        good |= known & set(model.rows.tolist())
    return len(good)


def map_globally(
    database: Path, scratch: Path, output: Path, *, min_photos: int, min_inliers: int, seed: int
) -> None:
    """COLMAP's global mapping; models land in numbered folders of `output`, smaller ones do not.

    Args:
        database: COLMAP's, of verified pairs; stays as it is, while the mapping writes into a copy.
        min_inliers: verified matches of a pair that mapping may use.
    """
    copy = scratch / "global.db"
    shutil.copyfile(database, copy)
    options = pycolmap.GlobalPipelineOptions()
    options.min_model_size = min_photos
    options.min_num_matches = min_inliers
    for part in (options, options.mapper):
        part.num_threads = 1
        part.random_seed = seed
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.global_positioning.use_gpu = False
    with quiet():
        pycolmap.global_mapping(str(copy), str(scratch), str(output), options)
