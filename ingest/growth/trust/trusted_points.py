"""The points of a map that answer queries: those that independent sources have seen.

A photo can be true in most of its parts and altered in one: it then fits its neighbours, and the altered part
makes points that only its owner has seen. Such points stay in the map, without descriptors.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.maps.feature_map import FeatureMap
from ingest.growth.trust.confirmation import (
    ConfirmationOptions,
    CorroboratingImage,
    Sources,
    independent_pairs,
    parallax,
)


def confirmed_points(
    feature_map: FeatureMap,
    sources: Sources,
    options: ConfirmationOptions,
    corroborating: Sequence[CorroboratingImage] = (),
) -> NDArray[np.bool_]:
    """Which points (n,) two independent photos see, the map's or from outside, or a proven one of the map."""
    own = sources.of_map(feature_map)
    everyone = [*own, *(w.source for w in corroborating)]
    row = {image.image_id: i for i, image in enumerate(feature_map.images)}
    seen = feature_map.observations
    images = [np.array([row[int(i)] for i in seen.image_id], dtype=np.int64)]
    points = [seen.point_index]
    for k, outside in enumerate(corroborating, start=len(row)):
        images.append(np.full(len(outside.points), k, dtype=np.int64))
        points.append(outside.points)
    shape = (len(everyone), max(len(feature_map.points), 1))
    entries = (np.concatenate(images), np.concatenate(points))
    sees = sparse.csr_array((np.ones(len(entries[0])), entries), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1.0
    apart = parallax(feature_map, corroborating) >= options.min_parallax
    pairs = (apart & independent_pairs(everyone)).astype(np.float64)
    others = sparse.csr_array(pairs) @ sees  # for each photo, how many independent ones see the point
    both = np.asarray(sees.multiply(others).sum(axis=0)).ravel() > 0
    proven = np.asarray(sees[[k for k, s in enumerate(own) if s.proven]].sum(axis=0)).ravel() > 0
    return np.asarray((both | proven)[: len(feature_map.points)], dtype=np.bool_)


def answering_with(feature_map: FeatureMap, points: NDArray[np.bool_]) -> FeatureMap:
    """The map with descriptors for the given points only; the same map where all that had some keep them."""
    seen = feature_map.observations
    keep = seen.has_descriptor & points[seen.point_index]
    if np.array_equal(keep, seen.has_descriptor):
        return feature_map
    descriptors = np.where(keep[:, None], seen.descriptors, np.uint8(0))
    return replace(feature_map, observations=replace(seen, has_descriptor=keep, descriptors=descriptors))
