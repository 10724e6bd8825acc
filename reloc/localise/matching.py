"""2D-3D matches: by descriptors inside a covisibility cluster, then guided by a pose."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.view_cones import ViewCones, in_view
from featuredb.index.area import Area
from featuredb.index.descriptor_index import DescriptorIndex, squared_distances
from reloc.localise.candidates import Cluster
from reloc.localise.options import PointMatchOptions

# Beyond the map's own views SIFT finds most of what there is to 30 degrees, some of it to 60, on flat walls
# and from descents: up to the first a point is missed where it is not found, up to the
# second a match may be one. More is a scene seen from behind, or from under the ground.
EXPECTED_DEG, POSSIBLE_DEG = 30.0, 60.0
# Points that codes propose for a feature. Twenty hold the nearest of 98 % of features in 6,400 points, 96 %
# in 25,000, and of all that pass the ratio test in both (`brighton`, copies of it).
_PROPOSED = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Pairs of a query feature and a map point; no feature and no point of one map twice.

    Attributes:
        feature: (m,) rows of the query's features.
        point: (m,) rows of the area's points.
    """

    feature: NDArray[np.int64]
    point: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.feature)


class ClusterMatcher:
    """Matches of a photo's features with a cluster of map images: the first of the features, then more.

    The neighbours of a feature are looked for once, however often more features are asked for.
    """

    def __init__(self, features: Features, cluster: Cluster, options: PointMatchOptions) -> None:
        self.cluster = cluster
        self._features, self._options = features, options
        area = cluster.area
        of_map = area.map_of(cluster.points)
        self._maps = [
            _MapNeighbours(features, area, cluster.points[of_map == row].astype(np.int64))
            for row in np.unique(of_map)
        ]

    def matches(self, count: int) -> Matches:
        """Best point of each of the first `count` features, if the second-best place is clearly worse.

        Each map by itself: within one map every place has one point, so the ratio test asks whether a feature
        is unique there. Another map of the same place has the same point again; it must not compete.
        """
        xy = self._features.xy[:count]
        return _concatenate([m.matches(xy, self.cluster.area, self._options) for m in self._maps])


class _MapNeighbours:
    """The nearest points of one map, for as many features as were asked for so far."""

    def __init__(self, features: Features, area: Area, points: NDArray[np.int64]) -> None:
        self._features, self._points = features, points
        self._index = DescriptorIndex.exhaustive(area.codes(points))
        self._squared, self._row = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)

    def matches(self, xy: NDArray[np.float32], area: Area, options: PointMatchOptions) -> Matches:
        count, points = len(xy), self._points
        if count > len(self._row):
            more = self._features.descriptors[len(self._row) : count]
            squared, row = self._nearest(area, more)
            self._squared = np.concatenate([self._squared, squared])
            self._row = np.concatenate([self._row, row])
        row = self._row[:count]
        distance = np.sqrt(np.maximum(self._squared[:count], 0.0))
        position = area.points[points[np.maximum(row, 0)]]
        same_m = options.same_place * area.view_distance[points[np.maximum(row[:, 0], 0)]]
        second_is_same = np.linalg.norm(position[:, 1] - position[:, 0], axis=1) < same_m
        rival = np.where(second_is_same, distance[:, 2], distance[:, 1])
        good = np.flatnonzero((row[:, 0] >= 0) & (distance[:, 0] < options.ratio * rival))
        return _one_to_one(xy, good, points[row[good, 0]], distance[good, 0])

    def _nearest(self, area: Area, asked: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Squared distances, rows (n, 3) of the nearest points to descriptors (n, 128); infinity, -1: fewer.

        Codes propose them, descriptors decide.
        """
        row = self._index.search(asked, _PROPOSED)
        squared = np.full(row.shape, np.inf, np.float32)
        at = np.nonzero(row >= 0)
        squared[at] = squared_distances(asked, at[0], area.descriptors, self._points[row[at]])
        best = np.argsort(squared, axis=1, kind="stable")[:, :3]
        return np.take_along_axis(squared, best, axis=1), np.take_along_axis(row, best, axis=1)


def guided_matches(
    features: Features,
    area: Area,
    points: NDArray[np.int32],
    camera: Camera,
    cam_from_local: Rigid3,
    options: PointMatchOptions,
) -> Matches:
    """Matches of the points that the pose makes visible, looked for where they project.

    Args:
        points: rows of the area's points to project.
    """
    rows = visible_points(area, points.astype(np.int64), camera, cam_from_local, POSSIBLE_DEG)
    if len(rows) == 0 or len(features) == 0:
        return _concatenate([])
    pixels = camera.project(cam_from_local.act(area.points[rows]))
    radius = options.guided_radius_rel * max(camera.width, camera.height)
    tree = cKDTree(features.xy)
    pairs = tree.sparse_distance_matrix(cKDTree(pixels), radius, output_type="coo_matrix")
    feature, point = pairs.row.astype(np.int64), rows[pairs.col]
    distance = np.sqrt(squared_distances(features.descriptors, feature, area.descriptors, point))
    close = distance < options.guided_max_distance
    return _one_to_one(features.xy, feature[close], point[close], distance[close])


def visible_points(
    area: Area,
    points: NDArray[np.int64],
    camera: Camera,
    cam_from_local: Rigid3,
    beyond_views_deg: float = EXPECTED_DEG,
) -> NDArray[np.int64]:
    """Those of the points that project into the image and are seen from a side that the map knows.

    A point counts as seen from a known side when the ray to the new camera lies within the cone of the
    map's own views, widened by `beyond_views_deg`.
    """
    cones = ViewCones(direction=area.view_direction[points], spread=area.view_spread[points])
    seen = in_view(area.points[points], cones, camera, cam_from_local, beyond_views_deg)
    return np.asarray(points[seen], dtype=np.int64)


def _one_to_one(
    xy: NDArray[np.float32],
    feature: NDArray[np.int64],
    point: NDArray[np.int64],
    distance: NDArray[np.float32],
) -> Matches:
    """Keep the closest match of each feature's place and of each point.

    SIFT gives a place several keypoints when its orientation is not clear; they are one measurement.
    """
    order = np.argsort(distance, kind="stable")
    feature, point = feature[order], point[order]
    _, first = np.unique(point, return_index=True)
    first.sort()
    feature, point = feature[first], point[first]
    half = np.round(xy[feature] * 2.0).astype(np.int64)
    _, first = np.unique((half[:, 1] << 32) + half[:, 0], return_index=True)
    first.sort()
    return Matches(feature=feature[first], point=point[first])


def _concatenate(parts: list[Matches]) -> Matches:
    if not parts:
        return Matches(feature=np.zeros(0, np.int64), point=np.zeros(0, np.int64))
    return Matches(
        feature=np.concatenate([p.feature for p in parts]),
        point=np.concatenate([p.point for p in parts]),
    )
