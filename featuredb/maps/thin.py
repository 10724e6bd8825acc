"""Fewer descriptors for the same answers: every image keeps seeing enough points, well spread over it.

A K-cover (Li, Snavely and Huttenlocher, ECCV 2010): points are chosen one after the other, each time the one
that most images still lack, until every image sees K chosen points, or all that it has. A gain counts less
in a part of an image that has points already, and for a point that is badly known. Gains only shrink as more
is chosen, so a heap of old gains finds the greatest one without computing the others anew.

A point that is not chosen loses its descriptors and stays as geometry. Answers read described points only,
so the index, its memory and a query's time shrink as if the point were gone; what stays serves what works on
tracks (placing a map on a scan, adjusting its lens, exports) and leaves the numbers of all points as they
were.
"""

import heapq
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.unplaced_map import AnyMap, MapKind

# Localisation believes a pose from 15 inliers on, and a photo finds only a part of what is there.
_LEAST_COVER = 15
# Described observations that a chosen point keeps; more only repeat what the mean descriptor says already.
_MAX_VIEWS = 8
# The grid on which acceptance counts how much of a photo holds inliers.
_GRID = 10
_THINNED = "thinned"


def thin_map(feature_map: MapKind, cover: int) -> MapKind:
    """The map with as few described points and observations as the cover asks for.

    Every image sees at least `cover` described points, or as many as before. Poses, placement, parents and
    status stay. A map that was thinned in this very way comes back as it is.

    Raises:
        InvalidValueError: a cover of less than 15.
    """
    if cover < _LEAST_COVER:
        raise InvalidValueError(f"cover: expected at least {_LEAST_COVER} points, found {cover}")
    earlier = feature_map.provenance.get(_THINNED)
    if earlier is not None and earlier["options"]["cover"] == cover:
        return feature_map
    points = k_cover(feature_map, cover)
    seen = feature_map.observations
    kept = _thinned_views(feature_map, points, cover)
    note = {
        "options": {"cover": cover},
        "points_before": len(np.unique(seen.point_index[seen.has_descriptor])),
        "points": int(points.sum()),
    }
    descriptors = np.where(kept[:, None], seen.descriptors, np.uint8(0))
    return replace(
        feature_map,
        observations=replace(seen, has_descriptor=kept, descriptors=descriptors),
        provenance=feature_map.provenance | {_THINNED: note},
    )


def k_cover(feature_map: AnyMap, cover: int) -> NDArray[np.bool_]:
    """Chosen points (n,): every image sees `cover` of them, or all of its described points.

    Args:
        cover: K, at least 1.
    """
    point, image, cell = _sightings(feature_map)
    weight = _precision(feature_map)
    need = np.minimum(np.bincount(image, minlength=len(feature_map.images)), cover).tolist()
    taken = [0] * len(need)
    in_cell: dict[int, int] = {}
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(len(feature_map.points) + 1))
    images, cells = image[order].tolist(), (image * _GRID**2 + cell)[order].tolist()
    bounds, weights = starts.tolist(), weight.tolist()

    def gain(row: int) -> float:
        return float(weights[row]) * sum(
            1.0 / (1 + in_cell.get(cells[k], 0))
            for k in range(bounds[row], bounds[row + 1])
            if taken[images[k]] < need[images[k]]
        )

    heap = [(-gain(row), row) for row in np.unique(point).tolist()]
    heapq.heapify(heap)
    chosen = np.zeros(len(feature_map.points), dtype=np.bool_)
    while heap:
        stale, row = heapq.heappop(heap)
        now = gain(row)
        if now <= 0.0:
            continue
        if -stale > now:
            heapq.heappush(heap, (-now, row))
            continue
        chosen[row] = True
        for k in range(bounds[row], bounds[row + 1]):
            taken[images[k]] += 1
            in_cell[cells[k]] = in_cell.get(cells[k], 0) + 1
    return chosen


def described_points_of_images(feature_map: AnyMap) -> NDArray[np.int64]:
    """How many described points each image (i,) sees."""
    _, image, _ = _sightings(feature_map)
    return np.bincount(image, minlength=len(feature_map.images)).astype(np.int64)


def _sightings(feature_map: AnyMap) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Point row, image row and cell of the image's grid, once for each image that sees a described point."""
    seen = feature_map.observations
    rows = np.flatnonzero(seen.has_descriptor)
    image = feature_map.image_rows(seen.image_id[rows])
    _, first = np.unique(seen.point_index[rows] * len(feature_map.images) + image, return_index=True)
    rows, image = rows[first], image[first]
    cells = seen.xy[rows] * (_GRID / feature_map.image_sizes()[image])
    place = np.clip(cells.astype(np.int64), 0, _GRID - 1)
    return seen.point_index[rows], image, place[:, 1] * _GRID + place[:, 0]


def _precision(feature_map: AnyMap) -> FloatArray:
    """Weight (n,) in (0, 1) of each point: a half at the median of sigma over viewing distance.

    A pose feels a point's error as an angle. Within a factor of two of the median the weight changes less
    than a view more or less does, so that it decides among points seen equally well.
    """
    n = len(feature_map.points)
    _, distance = _views(feature_map)
    nearest = np.full(n, np.inf)
    np.minimum.at(nearest, feature_map.observations.point_index, distance)
    variance = feature_map.points.covariance[:, [0, 3, 5]].astype(np.float64).sum(axis=1)
    angle = np.sqrt(np.maximum(variance, 0.0)) / nearest
    known = angle > 0
    middle = float(np.median(angle[known])) if known.any() else 1.0
    return np.asarray(1.0 / (1.0 + angle / middle), dtype=np.float64)


def _views(feature_map: AnyMap) -> tuple[FloatArray, FloatArray]:
    """Unit vector (m, 3) from the point to the camera and distance (m,) of each observation, local metres."""
    seen = feature_map.observations
    centers = np.array([i.cam_from_local.center for i in feature_map.images]).reshape(-1, 3)
    toward = centers[feature_map.image_rows(seen.image_id)] - feature_map.points_local()[seen.point_index]
    distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    return toward / distance[:, None], distance


def _thinned_views(feature_map: AnyMap, points: NDArray[np.bool_], cover: int) -> NDArray[np.bool_]:
    """Observations (m,) of the chosen points that keep their descriptor.

    A point with too many views keeps those that are farthest apart, and those of images that would fall below
    the cover without it.
    """
    seen = feature_map.observations
    kept = seen.has_descriptor & points[seen.point_index]
    image = feature_map.image_rows(seen.image_id)
    # An image may see a point twice, which counts once.
    pairs = np.unique(np.stack([image[kept], seen.point_index[kept]]), axis=1)
    spare = np.bincount(pairs[0], minlength=len(feature_map.images)) - cover
    direction, distance = _views(feature_map)
    # A factor of two in distance changes a descriptor about as much as half a radian in direction.
    place = np.hstack([direction, 0.5 * np.log2(distance)[:, None]])
    rows = np.flatnonzero(kept)
    rows = rows[np.argsort(seen.point_index[rows], kind="stable")]
    starts = np.flatnonzero(np.diff(seen.point_index[rows], prepend=-1))
    for group in np.split(rows, starts[1:]):
        if len(group) <= _MAX_VIEWS:
            continue
        for row in reversed(group[_farthest_first(place[group])][_MAX_VIEWS:]):
            if spare[image[row]] > 0:
                spare[image[row]] -= 1
                kept[row] = False
    return kept


def _farthest_first(place: FloatArray) -> NDArray[np.intp]:
    """Order (v,) in which each next row of `place` (v, d) is the farthest from all before it.

    The first is the one nearest to the middle, whose descriptor is the most usual one.
    """
    first = int(np.argmin(np.linalg.norm(place - place.mean(axis=0), axis=1)))
    order = [first]
    gap = np.linalg.norm(place - place[first], axis=1)
    gap[first] = -1.0
    while len(order) < len(place):
        order.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(place - place[order[-1]], axis=1))
        gap[order] = -1.0
    return np.array(order)
