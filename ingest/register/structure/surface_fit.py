"""The scan's surface as planes, how a placed map lies on the scan, and how a map moves when placed anew."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_log
from featuredb.geometry.sim3 import place_covariance
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud

_MARGIN_M = 5.0  # of the scan around the map's points
_NEIGHBOURS = 8  # of which a plane is made
_REACH_SPACINGS = 4.0  # a map point further from the scan than this many spacings has no scan there
MIN_REACH_M = 2.0  # but never less: a map that is off by so much is still compared
# Coarser levels of detail are taken until the scan under a map has no more points; bounds the time.
_MAX_SURFACE_POINTS = 60_000
_MAX_POINTS = 20_000  # of a map; more say nothing new of it
_PLAN_REACH_M = 2.0  # a map point with no scan this near in plan lies over a hole or beyond the border


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


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMove:
    """The similarity between two placements of a map, about the middle of its points.

    Attributes:
        horizontal_m, up_m: of the middle.
        heading_deg, tilt_deg: turns about the vertical, and about a horizontal axis.
        scale: new metres per old metre.
        horizontal_sigmas, heading_sigmas, tilt_sigmas, scale_sigmas: in standard deviations of the old
            placement.
    """

    horizontal_m: float
    up_m: float
    heading_deg: float
    tilt_deg: float
    scale: float
    horizontal_sigmas: float
    heading_sigmas: float
    tilt_sigmas: float
    scale_sigmas: float


def map_move(old: FeatureMap, new: FeatureMap) -> MapMove:
    """From the placements of the same map in one local frame."""
    move = new.placement.local_from_sfm @ old.placement.local_from_sfm.inverse()
    turn, covariance = so3_log(move.rotation), old.placement.covariance
    middle = np.median(old.points_local(), axis=0)
    shift, spread = move.act(middle) - middle, place_covariance(covariance, middle)
    heading, tilt = float(abs(turn[2])), float(np.hypot(turn[0], turn[1]))
    return MapMove(
        horizontal_m=float(np.hypot(shift[0], shift[1])),
        up_m=float(shift[2]),
        heading_deg=float(np.degrees(turn[2])),
        tilt_deg=float(np.degrees(tilt)),
        scale=move.scale,
        horizontal_sigmas=float(np.hypot(*shift[:2]) / np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])),
        heading_sigmas=heading / float(np.sqrt(covariance[3, 3])),
        tilt_sigmas=tilt / float(np.sqrt(max(covariance[1, 1], covariance[2, 2]))),
        scale_sigmas=abs(float(np.log(move.scale))) / float(np.sqrt(covariance[0, 0])),
    )


def map_residuals(old: FeatureMap, new: FeatureMap, cloud: PointCloud) -> tuple[FloatArray, FloatArray]:
    """Distances (k,) of the same map points from the scan, before and after, metres.

    Compared are the points that have scan around them in plan at the new place: elsewhere the scan has a
    hole, and the distance to its rim says nothing.
    """
    step = max(1, len(old.points) // _MAX_POINTS)
    before = old.points_local(cloud.frame)[::step]
    after = new.points_local(cloud.frame)[::step]
    low = np.minimum(before.min(axis=0), after.min(axis=0))[:2] - _PLAN_REACH_M
    high = np.maximum(before.max(axis=0), after.max(axis=0))[:2] + _PLAN_REACH_M
    near = ((cloud.xyz[:, :2] >= low) & (cloud.xyz[:, :2] <= high)).all(axis=1)
    scan = cloud.xyz[near].astype(np.float64)
    in_plan, _ = cKDTree(scan[:, :2]).query(after[:, :2], distance_upper_bound=_PLAN_REACH_M)
    compared = np.isfinite(in_plan)
    tree = cKDTree(scan)
    first, second = (np.asarray(tree.query(points[compared])[0]) for points in (before, after))
    return first, second


def median_m(distances: FloatArray) -> float:
    """Of distances (k,); NaN where nothing could be compared."""
    return float(np.median(distances)) if len(distances) else float("nan")
