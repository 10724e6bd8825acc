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
    independent,
    parallax,
    source_of,
)


def confirmed_points(
    feature_map: FeatureMap, options: ConfirmationOptions, corroborating: Sequence[CorroboratingImage] = ()
) -> NDArray[np.bool_]:
    """Which points (n,) photos of two independent sources see, the map's or from outside, or trusted ones."""
    sources = [source_of(image, feature_map.camera_keys) for image in feature_map.images]
    sources += [w.source for w in corroborating]
    row = {image.image_id: i for i, image in enumerate(feature_map.images)}
    seen = feature_map.observations
    images = [np.array([row[int(i)] for i in seen.image_id], dtype=np.int64)]
    points = [seen.point_index]
    for k, outside in enumerate(corroborating, start=len(row)):
        images.append(np.full(len(outside.points), k, dtype=np.int64))
        points.append(outside.points)
    shape = (len(sources), max(len(feature_map.points), 1))
    entries = (np.concatenate(images), np.concatenate(points))
    sees = sparse.csr_array((np.ones(len(entries[0])), entries), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1.0
    apart = parallax(feature_map, corroborating) >= options.min_parallax
    pairs = np.array(
        [[apart[i, j] and independent(a, b, options.independent_by) for j, b in enumerate(sources)]
         for i, a in enumerate(sources)],
        dtype=np.float64,
    )  # fmt: skip
    others = sparse.csr_array(pairs) @ sees  # for each photo, how many independent ones see the point
    both = np.asarray(sees.multiply(others).sum(axis=0)).ravel() > 0
    trusted = np.array([bool(s.owner) and s.owner in options.trusted_owners for s in sources], dtype=bool)
    by_trusted = np.asarray(sees[np.flatnonzero(trusted)].sum(axis=0)).ravel() > 0
    return np.asarray((both | by_trusted)[: len(feature_map.points)], dtype=np.bool_)


def answering_with(feature_map: FeatureMap, points: NDArray[np.bool_]) -> FeatureMap:
    """The map with descriptors for the given points only; the same map where all that had some keep them."""
    seen = feature_map.observations
    keep = seen.has_descriptor & points[seen.point_index]
    if np.array_equal(keep, seen.has_descriptor):
        return feature_map
    descriptors = np.where(keep[:, None], seen.descriptors, np.uint8(0))
    return replace(feature_map, observations=replace(seen, has_descriptor=keep, descriptors=descriptors))
