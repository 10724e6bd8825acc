"""The frame of a map without a place: a size that people expect, and up where the photos show it."""

from collections.abc import Sequence

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import NOMINAL_DISTANCE, OwnFrame
from ingest.colmap_bridge import Model

# What gives a map without a place its place; for people.
WAYS_TO_A_PLACE = (
    "a scan and a person's hand: featuredb lidar add DB SCAN, then "
    "featuredb anchor DB MAP --photos FOLDER --page",
    "ground control points, three or more, each marked in two photos: featuredb register DB MAP --gcp FILE",
    "maps with a place that show the same: featuredb grow DB",
)
# A frame is called upright where the standard error of its vertical is below this about both horizontal axes.
_UPRIGHT_SIGMA_RAD = np.radians(2.0)
_ROBUST_ROUNDS = 5
_KEPT_SIGMAS = 3.0  # photos that were held askew do not tell the vertical


def own_frame_of(model: Model) -> tuple[Sim3, OwnFrame]:
    """The similarity own_from_sfm, and what the own frame is.

    The scale sets the median distance from a camera to its points to `NOMINAL_DISTANCE`, the origin is the
    points' median. People and gimbals hold cameras level: the direction across all photos' horizontal image
    axes is the vertical, if these axes point far enough apart; then z is up.
    """
    centers = model.centers()
    distances = np.linalg.norm(model.xyz[model.point_of] - centers[model.photo_of], axis=1)
    median = float(np.median(distances))
    scale = NOMINAL_DISTANCE / median if median > 0 else 1.0
    up = vertical_of(model.cam_from_sfm)
    rotation = np.eye(3) if up is None else _z_to(up)
    middle = np.median(model.xyz, axis=0)
    own_from_sfm = Sim3(scale=scale, rotation=rotation, translation=-scale * rotation @ middle)
    return own_from_sfm, OwnFrame(metric=False, upright=up is not None)


def vertical_of(poses: Sequence[Rigid3]) -> FloatArray | None:
    """The unit vector (3,) upwards in the poses' world, or None where the photos do not tell it.

    Photos whose image axis is off the level by more than three robust standard deviations do not count.
    """
    across = np.array([pose.rotation[0] for pose in poses]).reshape(-1, 3)
    kept = np.ones(len(across), dtype=np.bool_)
    for _ in range(_ROBUST_ROUNDS):
        if kept.sum() < 4:
            return None
        values, vectors = np.linalg.eigh(across[kept].T @ across[kept])
        up = vectors[:, 0]
        roll = across @ up
        sigma = max(1.4826 * float(np.median(np.abs(roll[kept]))), 1e-6)
        now = np.abs(roll) <= _KEPT_SIGMAS * sigma
        if (now == kept).all():
            break
        kept = now
    sigma_up = sigma / np.sqrt(max(values[1], 1e-12))  # about the axis that the photos' axes span least
    if kept.sum() < max(4, len(across) // 2) or sigma_up > _UPRIGHT_SIGMA_RAD:
        return None
    # Image rows point downwards in photos of fronts, the view does in photos from above.
    down = np.array([pose.rotation[1] + pose.rotation[2] for pose in poses])[kept]
    return np.asarray(up if float((down @ up).mean()) < 0 else -up)


def _z_to(up: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes the unit vector `up` to the z axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
