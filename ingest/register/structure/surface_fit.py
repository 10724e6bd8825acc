"""The scan's surface as planes, and how a placed map lies on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud

_MARGIN_M = 5.0  # of the scan around the map's points
_NEIGHBOURS = 8  # of which a plane is made
_REACH_SPACINGS = 4.0  # a map point further from the scan than this many spacings has no scan there
MIN_REACH_M = 2.0  # but never less: a map that is off by so much is still compared
# Coarser levels of detail are taken until the scan under a map has no more points; bounds the time.
_MAX_SURFACE_POINTS = 60_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """A thinned scan with planes.

    Attributes:
        middle: (3,) of the points, local frame of the cloud, metres; about it angles and shifts part.
        points: (k, 3) float64, less `middle`.
        normals: (k, 3) unit.
        spacing_m: typical distance of neighbours.
        tree: of `points`.
    """

    middle: FloatArray
    points: FloatArray
    normals: FloatArray
    spacing_m: float
    tree: cKDTree


def surface_near(cloud: PointCloud, points: FloatArray, most: int = _MAX_SURFACE_POINTS) -> Surface | None:
    """The scan around points (n, 3), thinned by its levels of detail; None where there is none."""
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    rows = _rows_inside(cloud, low, high, most)
    if len(rows) < _NEIGHBOURS:
        return None
    xyz = cloud.xyz[rows].astype(np.float64)
    middle = xyz.mean(axis=0)
    xyz -= middle
    tree = cKDTree(xyz)
    distance, near = (np.asarray(found) for found in tree.query(xyz, _NEIGHBOURS))
    patch = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    return Surface(
        middle=middle,
        points=xyz,
        normals=np.linalg.eigh(np.swapaxes(patch, 1, 2) @ patch)[1][:, :, 0],
        spacing_m=float(np.median(distance[:, 1])),
        tree=tree,
    )


def _rows_inside(cloud: PointCloud, low: FloatArray, high: FloatArray, limit: int) -> NDArray[np.int64]:
    """Rows of the cloud's points inside a horizontal box, by as many levels as fit under the limit."""
    nodes = cloud.nodes
    touching = (nodes.box_max[:, :2] >= low[:2]).all(axis=1) & (nodes.box_min[:, :2] <= high[:2]).all(axis=1)
    taken: list[NDArray[np.int64]] = []
    total = 0
    for level in np.unique(nodes.level[touching]):
        runs = np.flatnonzero(touching & (nodes.level == level))
        rows = np.concatenate(
            [np.arange(nodes.start[r], nodes.start[r] + nodes.count[r], dtype=np.int64) for r in runs]
        )
        xy = cloud.xyz[rows, :2]
        rows = rows[((xy >= low[:2]) & (xy <= high[:2])).all(axis=1)]
        if total + len(rows) > limit:
            # A random part of the next level: better than to leave the surface half as dense as it may be.
            part = max(limit - total, 0)
            taken.append(np.random.default_rng(0).choice(rows, part, replace=False))
            break
        taken.append(rows)
        total += len(rows)
    return np.concatenate(taken) if taken else np.zeros(0, np.int64)


def nearest_planes(surface: Surface, points: FloatArray, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """Planes of the scan points next to points (n, 3): signed distances (n,) from them, and normals (n, 3).

    Distances are NaN where the scan point is further than the reach.
    """
    centred = points - surface.middle
    away, index = surface.tree.query(centred)
    normals = surface.normals[index]
    distance = np.einsum("ij,ij->i", normals, centred - surface.points[index])
    return np.where(away <= reach_m, distance, np.nan), normals


def reach_of(surface: Surface) -> float:
    """How far from the scan a point may be to be compared with it, metres."""
    return max(MIN_REACH_M, _REACH_SPACINGS * surface.spacing_m)
