"""The frame of a map without a place: a size that people expect, and up where the photos show it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import CameraAngles, cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import rotation_to_up
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import NOMINAL_DISTANCE, OwnFrame
from ingest.colmap.bridge import Model
from ingest.positions.held import Held
from ingest.positions.receivers import receivers

# What gives a map without a place its place; for people.
WAYS_TO_A_PLACE = (
    "a scan: featuredb lidar add DB SCAN, then featuredb anchor DB MAP --photos FOLDER --near=LAT,LON, or "
    "--page to point at it by hand",
    "ground control points, three or more, each marked in two photos: featuredb register DB MAP --gcp FILE",
    "maps with a place that show the same: featuredb grow DB",
)
# A frame is called upright where the standard error of its vertical is below this about both horizontal axes.
_UPRIGHT_SIGMA_RAD = np.radians(2.0)
_BY_CHANCE = 0.01  # maps whose cameras seem to agree on their vertical because few of them happen to
_ROBUST_ROUNDS = 5
_ASKEW_RAD = np.radians(15.0)  # of one photo: then they are not held level
_COMMON_ROLL_RAD = np.radians(1.5)  # of all photos by one gimbal or hand
_COMMON_SHARE = 0.6  # of the variance of angles that photos tell: 1.5 of 2 degrees, squared; `brighton` again
_LEAST_TOLD = 3
_TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # stored lying on a side
_LOOKED_AT = {
    **dict.fromkeys((1, 2), np.eye(3)),
    **dict.fromkeys((3, 4), _TURNED @ _TURNED),
    **dict.fromkeys((5, 6), _TURNED),
    **dict.fromkeys((7, 8), _TURNED.T),
}
_KEPT_SIGMAS = 3.0  # photos that were held askew do not tell the vertical


def own_frame_of(model: Model, orientations: Sequence[int] = ()) -> tuple[Sim3, OwnFrame]:
    """The similarity own_from_sfm, and what the own frame is.

    The scale sets the median distance from a camera to its points to `NOMINAL_DISTANCE`, the origin is the
    points' median. People and gimbals hold cameras level: the direction across all photos' horizontal image
    axes is the vertical, if these axes point far enough apart; then z is up.

    Args:
        orientations: of the photos by EXIF, or none at all.
    """
    median = float(np.median(model.distances()))
    scale = NOMINAL_DISTANCE / median if median > 0 else 1.0
    up = vertical_of(as_looked_at(model.cam_from_sfm, orientations))
    rotation = np.eye(3) if up is None else rotation_to_up(up)
    middle = np.median(model.xyz, axis=0)
    own_from_sfm = Sim3(scale=scale, rotation=rotation, translation=-scale * rotation @ middle)
    return own_from_sfm, OwnFrame(metric=False, upright=up is not None)


def as_looked_at(poses: Sequence[Rigid3], orientations: Sequence[int]) -> list[Rigid3]:
    """Poses with x to the right and y down as photos are looked at, by EXIF's orientations, if there are any.

    Which way a mirrored photo's x points is not told; nothing here asks.
    """
    if not len(orientations):
        return list(poses)
    return [
        Rigid3(rotation=turn @ pose.rotation, translation=turn @ pose.translation)
        for pose, turn in zip(poses, (_LOOKED_AT[one] for one in orientations), strict=True)
    ]


def vertical_of(poses: Sequence[Rigid3]) -> FloatArray | None:
    """The unit vector (3,) upwards in the poses' world, or None where the photos do not tell it.

    Photos whose image axis is off the level by more than three robust standard deviations do not count.
    """
    found = _held_level(poses)
    if found is None:
        return None
    kept, sigma, up, spread = found
    if sigma / np.sqrt(max(spread, 1e-12)) > _UPRIGHT_SIGMA_RAD:  # about the axis that they span least
        return None
    return np.asarray(up if float((_down(poses)[kept] @ up).mean()) < 0 else -up)


def held_of(
    poses: Sequence[Rigid3],
    angles: Sequence[CameraAngles | None] = (),
    camera_of: NDArray[np.int64] | None = None,
    orientations: Sequence[int] = (),
) -> Held | None:
    """How photos are held, for a placement; None where nothing tells.

    Tilts that photos tell come first; where less than three do, photos are taken to be held level, unless
    most of them are not. What the photos by one camera have in common does not average out, wherever they
    look: a gimbal that is off stays off, and leans with the wind as the aircraft turns. Many people's do.

    Args:
        angles: of each photo, or none at all.
        camera_of: (n,) which camera, or whose, took each photo; None: one took all.
        orientations: of the photos by EXIF, or none at all.
    """
    camera_of = np.zeros(len(poses), dtype=np.int64) if camera_of is None else camera_of
    told = [(pose.rotation, one) for pose, one in zip(poses, angles, strict=False) if one is not None]
    tilted = [(turn, one) for turn, one in told if one.pitch_deg is not None]
    parts = [
        part
        for part in (_by_yaw(told), _by_tilt(tilted) or _level(as_looked_at(poses, orientations), camera_of))
        if part is not None
    ]
    if not parts:
        return None
    rows = ("directions", "across", "along", "sigma_rad", "joint_rad")
    joined: dict[str, Any] = {n: np.concatenate([getattr(part, n) for part in parts]) for n in rows}
    return replace(parts[-1], **joined)


def _by_tilt(photos: Sequence[tuple[FloatArray, CameraAngles]]) -> Held | None:
    """Where photos say that up is."""
    if len(photos) < _LEAST_TOLD:
        return None
    up = np.array(
        [turn.T @ cam_from_enu(0.0, told.pitch_deg or 0.0, told.roll_deg)[:, 2] for turn, told in photos]
    )
    sigma = np.radians([told.sigma_tilt_deg for _, told in photos])
    return Held(
        directions=np.repeat(up, 2, axis=0),
        across=np.tile(np.eye(3)[:2], (len(up), 1)),
        along=np.tile(np.eye(3)[2], (2 * len(up), 1)),
        sigma_rad=np.repeat(sigma, 2),
        joint_rad=np.repeat(_joint(sigma), 2),
        down=-up.mean(axis=0),
        told=True,
        checked=True,
    )


def _by_yaw(photos: Sequence[tuple[FloatArray, CameraAngles]]) -> Held | None:
    """Where photos say that north is; by the optical axis, where only that one's is told."""
    directions, across, along, sigma = [], [], [], []
    for turn, told in photos:
        if told.yaw_deg is None:
            continue
        if told.pitch_deg is None:
            yaw = np.radians(told.yaw_deg)
            directions.append(turn[2])
            along.append([np.sin(yaw), np.cos(yaw), 0.0])
            across.append([np.cos(yaw), -np.sin(yaw), 0.0])
        else:
            directions.append(turn.T @ cam_from_enu(told.yaw_deg, told.pitch_deg, told.roll_deg)[:, 1])
            along.append([0.0, 1.0, 0.0])
            across.append([1.0, 0.0, 0.0])
        sigma.append(np.radians(told.sigma_yaw_deg))
    if len(sigma) < _LEAST_TOLD:
        return None
    return Held(
        directions=np.array(directions),
        across=np.array(across),
        along=np.array(along),
        sigma_rad=np.array(sigma),
        joint_rad=_joint(np.array(sigma)),
        down=np.zeros(3),
        told=True,
        checked=True,
    )


def _joint(sigma: FloatArray) -> FloatArray:
    """So wide that the mean of all is no better than what they share."""
    own = sigma**2 * (1.0 - _COMMON_SHARE)
    return np.asarray(np.sqrt(own + len(sigma) * _COMMON_SHARE * sigma**2))


def _level(poses: Sequence[Rigid3], camera_of: NDArray[np.int64]) -> Held | None:
    found = _held_level(poses)
    if found is None or found[1] > _ASKEW_RAD:
        return None
    kept, sigma, _, _ = found
    across = np.array([pose.rotation[0] for pose in poses])[kept]
    by = receivers(camera_of[kept], len(across))
    by_one = len(across) / by  # photos that have a roll in common
    return Held(
        directions=across,
        across=np.tile(np.eye(3)[2], (len(across), 1)),
        along=np.zeros((len(across), 3)),
        sigma_rad=np.full(len(across), np.hypot(sigma, _COMMON_ROLL_RAD)),
        joint_rad=np.full(len(across), np.sqrt(sigma**2 + by_one * _COMMON_ROLL_RAD**2)),
        down=_down(poses)[kept].mean(axis=0),
        told=False,
        checked=by > 1.0 and _agree(across, by),
    )


def _agree(across: FloatArray, cameras: float) -> bool:
    """Whether so many cameras look so many ways that the vertical is theirs, and hardly by chance.

    By the standard error of a principal axis (Anderson 1963), as large as the cameras allow it to be.

    Args:
        across: (n, 3) horizontal image axes. cameras: how many of them are independent.
    """
    least, second = np.linalg.eigvalsh(across.T @ across)[:2].tolist()
    most = max(least, 0.0) / chdtri(cameras - 2, 1.0 - _BY_CHANCE)
    return bool(np.sqrt(most * second) <= _UPRIGHT_SIGMA_RAD * (second - least))


def _held_level(poses: Sequence[Rigid3]) -> tuple[NDArray[np.bool_], float, FloatArray, float] | None:
    """Photos held level, the deviation of one, the vertical (up to its sign), and how well it is spanned.

    None where less than half of them agree.
    """
    across = np.array([pose.rotation[0] for pose in poses]).reshape(-1, 3)
    kept = np.ones(len(across), dtype=np.bool_)
    for _ in range(_ROBUST_ROUNDS):
        if kept.sum() < 4:
            return None
        values, vectors = np.linalg.eigh(across[kept].T @ across[kept])
        roll = across @ vectors[:, 0]
        sigma = max(1.4826 * float(np.median(np.abs(roll[kept]))), 1e-6)
        now = np.abs(roll) <= _KEPT_SIGMAS * sigma
        if (now == kept).all():
            break
        kept = now
    if kept.sum() < max(4, len(across) // 2):
        return None
    return kept, sigma, vectors[:, 0], float(values[1])


def _down(poses: Sequence[Rigid3]) -> FloatArray:
    """(k, 3) about downwards: image rows point there in photos of fronts, the view in photos from above."""
    return np.array([pose.rotation[1] + pose.rotation[2] for pose in poses])
