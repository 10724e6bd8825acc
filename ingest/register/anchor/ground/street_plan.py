"""What a map of street photos shows in plan: fronts with the side that is looked at, and open ground."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import rotation_to_up
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import UnplacedMap

_NEIGHBOURS = 12  # of which a plane is made
_THIN, _STEEP = 0.15, 0.25  # of a front: third over second spread, and its normal's rise
_PRIOR = 0.02  # of the vertical, against fronts: mean square of a normal's rise
_LEVEL, _LEVEL_ROUNDS = 0.2, 5  # rise of a photo's level side, at most
_ON_EDGE = 0.05  # what is held against a photo on edge, as a rise: most are not
_VOXEL_SHARE = 0.02  # of the median distance at which cameras see points: side of what counts as one
# Sine of a level view: maps of the simulated towns have 0.03 to 0.18 in the median, a drone that looks 15
# degrees down 0.26. Rise of the cameras, over their spread.
_STEEPEST, _MOST_RISE = 0.25, 0.25
_RAYS = 4000
_BEFORE = 0.9  # of a ray is open ground


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetPlan:
    """In a frame whose z is up, about the middle of the map's cameras; unit of the map.

    Attributes:
        upright_from_own: of the map's own frame.
        centers: (c, 3) of cameras. points: (n, 3), one of each voxel; rows: (n,) of the map's points.
        fronts: (f, 5): x, y, z and the direction out of the front. free: (r, 4): rays from x, y to x, y.
        distance: median of cameras from their points.
    """

    upright_from_own: Sim3
    centers: FloatArray
    points: FloatArray
    rows: NDArray[np.int64]
    fronts: FloatArray
    free: FloatArray
    distance: float


def street_plan(unplaced: UnplacedMap) -> StreetPlan | None:
    """The plan; None where the map shows no fronts."""
    level = _level(unplaced)
    xyz, observations = unplaced.points.xyz @ level.T, unplaced.observations
    centers = np.array([image.cam_from_local.center for image in unplaced.images]) @ level.T
    seen_from = centers[unplaced.image_rows(observations.image_id)]
    count = np.maximum(np.bincount(observations.point_index, minlength=len(xyz)), 1)
    eye = np.column_stack(
        [np.bincount(observations.point_index, seen_from[:, k], len(xyz)) / count for k in range(3)]
    )
    distance = float(np.median(np.linalg.norm(xyz[observations.point_index] - seen_from, axis=1)))
    voxels = np.floor(xyz / (_VOXEL_SHARE * distance)).astype(np.int64)
    first = np.unique(voxels, axis=0, return_index=True)[1]
    xyz, eye = xyz[first], eye[first]
    if len(xyz) < 10 * _NEIGHBOURS:
        return None
    normals, flat = _planes(xyz, eye)
    standing = flat & (np.abs(normals[:, 2]) < _STEEP)
    if np.count_nonzero(standing) < _NEIGHBOURS:
        return None
    n = normals[standing]
    lean = np.linalg.solve(
        n[:, :2].T @ n[:, :2] / len(n) + _PRIOR * np.eye(2), -(n[:, :2].T @ n[:, 2]) / len(n)
    )
    up = np.append(lean, 1.0)
    rotation = rotation_to_up(up / np.linalg.norm(up))
    middle = rotation @ np.median(centers, axis=0)
    upright = Sim3(scale=1.0, rotation=rotation, translation=-middle)
    points, turned = upright.act(xyz), normals @ rotation.T
    ends = np.random.default_rng(0).permutation(len(observations.point_index))[:_RAYS]
    eyes = upright.act(seen_from[ends])[:, :2]
    targets = upright.act(unplaced.points.xyz[observations.point_index[ends]] @ level.T)[:, :2]
    return StreetPlan(
        upright_from_own=upright @ Sim3(scale=1.0, rotation=level, translation=np.zeros(3)),
        centers=upright.act(centers),
        points=points,
        rows=first,
        fronts=np.column_stack([points[standing], turned[standing, :2]]),
        free=np.column_stack([eyes, eyes + _BEFORE * (targets - eyes)]),
        distance=distance,
    )


def _level(unplaced: UnplacedMap) -> FloatArray:
    """Rotation (3, 3) of the own frame until z is about up: people hold one side of a photo level."""
    if unplaced.frame.upright:
        return np.eye(3)
    axes = np.array([image.cam_from_local.rotation[:2] for image in unplaced.images])  # right and down
    ways = np.concatenate([-axes[:, 1], axes[:, 0], -axes[:, 0]])
    rises = np.abs(ways @ axes.transpose(0, 2, 1)) + np.array([0.0, _ON_EDGE])
    off = np.minimum(rises, _LEVEL).min(axis=2).sum(axis=0)
    up = ways[int(off.argmin())]
    for _ in range(_LEVEL_ROUNDS):
        lean = np.abs(axes @ up)
        level = axes[np.arange(len(axes)), lean.argmin(axis=1)][lean.min(axis=1) < _LEVEL]
        if len(level) < 2:
            break
        steady = np.linalg.eigh(level.T @ level + _PRIOR * (np.eye(3) - np.outer(up, up)) * len(level))[1][
            :, 0
        ]
        up = steady * np.sign(steady @ up)
    return rotation_to_up(up)


def _planes(xyz: FloatArray, eye: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Normals (n, 3) towards those who see the points (n, 3), and which lie on planes."""
    near = np.asarray(cKDTree(xyz).query(xyz, _NEIGHBOURS)[1])
    patch = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(patch, 1, 2) @ patch)
    normals = vectors[:, :, 0]
    towards = np.sign(np.einsum("ij,ij->i", normals, eye - xyz))
    return normals * np.where(towards == 0.0, 1.0, towards)[:, None], values[:, 0] < _THIN**2 * values[:, 1]


def looks_level(unplaced: UnplacedMap) -> bool:
    """Whether a map's photos look about horizontally, from about one height: nothing is seen from above."""
    up = _level(unplaced)[2]
    views = np.array([image.cam_from_local.rotation[2] for image in unplaced.images])
    centers = np.array([image.cam_from_local.center for image in unplaced.images])
    spread = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)[0]
    rise = float(np.linalg.norm((centers - centers.mean(axis=0)) @ up))
    return bool(np.median(np.abs(views @ up)) < _STEEPEST and rise < _MOST_RISE * spread)
