"""What a map of street photos shows in plan: fronts with the side that is looked at, open ground; its parts.

Where fronts look alike, maps are joined wrongly: their parts hang together by little there.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import rotation_to_up
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import UnplacedMap
from ingest.sfm.links import seen_by_both, shares_of

_NEIGHBOURS = 12  # of which a plane is made
_THIN, _STEEP = 0.15, 0.25  # of a front: third over second spread, and its normal's rise
_PRIOR = 0.02  # of the vertical, against fronts: mean square of a normal's rise
_LEVEL, _LEVEL_ROUNDS = 0.2, 5  # rise of a photo's level side, at most
_ON_EDGE = 0.05  # what is held against a photo on edge, as a rise: most are not
_VOXEL_SHARE = 0.02  # of the median distance at which cameras see points: side of what counts as one
# Sine of a level view: a drone that looks 15 degrees down has 0.26. Rise of the cameras, over their spread.
_STEEPEST, _MOST_RISE = 0.25, 0.25
_RAYS = 4000
_BEFORE = 0.9  # of a ray is open ground
_FIRM = 0.5  # normalised weight of a cut from which on a map hangs together
_LEAST_TIE = 1e-6  # of photos that share no point: each is on a side, too


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
    point_of = observations.point_index
    count = np.maximum(np.bincount(point_of, minlength=len(xyz)), 1)
    eye = np.column_stack([np.bincount(point_of, seen_from[:, k], len(xyz)) / count for k in range(3)])
    distance = float(np.median(np.linalg.norm(xyz[point_of] - seen_from, axis=1)))
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
    held = n[:, :2].T @ n[:, :2] / len(n) + _PRIOR * np.eye(2)
    up = np.append(np.linalg.solve(held, -(n[:, :2].T @ n[:, 2]) / len(n)), 1.0)
    rotation = rotation_to_up(up / np.linalg.norm(up))
    middle = rotation @ np.median(centers, axis=0)
    upright = Sim3(scale=1.0, rotation=rotation, translation=-middle)
    points, turned = upright.act(xyz), normals @ rotation.T
    ends = np.random.default_rng(0).permutation(len(point_of))[:_RAYS]
    eyes = upright.act(seen_from[ends])[:, :2]
    targets = upright.act(unplaced.points.xyz[point_of[ends]] @ level.T)[:, :2]
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
    """Rotation (3, 3) of the own frame until z is about up: people hold one side of a photo level.

    And most hold it upright, which tells up from down.
    """
    if unplaced.frame.upright:
        return np.eye(3)
    axes = np.array([image.cam_from_local.rotation[:2] for image in unplaced.images])  # right and down
    ways = np.concatenate([axes[:, 1], axes[:, 0]])
    rises = np.abs(ways @ axes.transpose(0, 2, 1)) + np.array([0.0, _ON_EDGE])
    off = np.minimum(rises, _LEVEL).min(axis=2).sum(axis=0)
    up = ways[int(off.argmin())]
    for _ in range(_LEVEL_ROUNDS):
        lean = np.abs(axes @ up)
        level = axes[np.arange(len(axes)), lean.argmin(axis=1)][lean.min(axis=1) < _LEVEL]
        if len(level) < 2:
            break
        against = _PRIOR * (np.eye(3) - np.outer(up, up)) * len(level)
        steady = np.linalg.eigh(level.T @ level + against)[1][:, 0]
        up = steady
    return rotation_to_up(-up if float((axes[:, 1] @ up).sum()) > 0 else up)


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


def parts(unplaced: UnplacedMap, least: int) -> Iterator[UnplacedMap]:
    """The map, then its parts of `least` photos and more, each before its own parts."""
    yield unplaced
    for half in halves(unplaced) if len(unplaced.images) > least else ():
        if len(half.images) >= least:
            yield from parts(half, least)


def halves(unplaced: UnplacedMap) -> tuple[UnplacedMap, ...]:
    """The two parts of a map, of two photos and more, between which its photos share least; none if much.

    The cut of the least normalised weight among those along the second eigenvector (Shi and Malik 2000);
    photos are tied by the points that both see, as a share of those of the one that sees fewer.
    """
    first, weight = weakest_cut(unplaced)
    if weight > _FIRM:
        return ()
    ids = np.array([image.image_id for image in unplaced.images])
    return only_images(unplaced, ids[first].tolist()), only_images(unplaced, ids[~first].tolist())


def weakest_cut(unplaced: UnplacedMap) -> tuple[NDArray[np.bool_], float]:
    """(i,) whether an image is on one side of it, and its normalised weight, 0 to 2."""
    count, observations = len(unplaced.images), unplaced.observations
    rows = unplaced.image_rows(observations.image_id)
    shares = shares_of(seen_by_both(rows, observations.point_index, count, len(unplaced.points)))
    ties = np.maximum(shares, _LEAST_TIE)
    np.fill_diagonal(ties, 0.0)
    degree = ties.sum(axis=1)
    root = np.sqrt(degree)
    vector = np.linalg.eigh(np.eye(count) - ties / np.outer(root, root))[1][:, 1] / root
    order = np.argsort(vector, kind="stable")
    ahead = degree[order].cumsum()[:-1]
    behind = degree[order][::-1].cumsum()[::-1][1:]
    among = np.diagonal(ties[np.ix_(order, order)].cumsum(axis=0).cumsum(axis=1))[:-1]
    across = np.maximum(ahead - among, 0.0)
    weight = across / ahead + across / behind
    first = np.zeros(count, dtype=bool)
    first[order[: int(weight.argmin()) + 1]] = True
    return first, float(weight.min())
