"""Focal lengths of cameras that do not tell theirs, from the fundamental matrices of their pairs.

Without EXIF a photo starts with the focal length of a usual lens. That is good enough for most lenses and
wrong by a factor of two and more for a long one: then no pair of photos makes a start, or every third photo
stays outside. The fundamental matrices of all pairs together know better (Sweeney et al., "Optimizing the
Viewing Graph for Structure-from-Motion", ICCV 2015; COLMAP's view graph calibration). They know nothing where
all pairs are planes, and little where a camera has few pairs.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path

import pycolmap

from ingest.colmap.bridge import quiet

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
    opened = pycolmap.Database.open(str(database))
    try:
        for camera in opened.read_all_cameras():
            if camera.camera_id in focal_px:
                params = camera.params
                params[camera.focal_length_idxs()] = focal_px[camera.camera_id]
                camera.params = params
                opened.update_camera(camera)
    finally:
        opened.close()


def _cameras(database: Path) -> list[pycolmap.Camera]:
    opened = pycolmap.Database.open(str(database))
    try:
        return list(opened.read_all_cameras())
    finally:
        opened.close()
