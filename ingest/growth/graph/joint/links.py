"""Which points of different maps are the same: images of each map are localised in the others.

What a map keeps of its images, observations with descriptors, is asked of the other maps as a query would be.
An image that the others have elsewhere than its own map is not heard: it shows a place that looks alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.maps.feature_map import FeatureMap
from ingest.growth.map_images import features_and_points
from ingest.growth.place.localised import in_frame
from ingest.growth.place.overlaps import indexed_area, localise_image

_LEAST_FEATURES = 30  # observations with descriptors that an image needs to be asked
# How far the others may have an image from where its own map has it, over its median viewing distance. Maps
# of six photos are off by some 3 %; a street further on is another place.
_MOST_SHIFT = 0.1
_LEAST_SHARE = 0.5  # of the votes on both points that name a pair


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Links:
    """Points of different maps that are the same.

    Attributes:
        map_a, point_a, map_b, point_b: (k,) indices of the maps, a below b, and rows of their points.
        heard: number of images that were localised in other maps where their own has them.
        elsewhere: names of those that were localised elsewhere. elsewhere_m: how far, their median.
    """

    map_a: NDArray[np.int64]
    point_a: NDArray[np.int64]
    map_b: NDArray[np.int64]
    point_b: NDArray[np.int64]
    heard: int
    elsewhere: tuple[str, ...]
    elsewhere_m: float = 0.0


def find_links(maps: Sequence[FeatureMap]) -> Links:
    """Links between any two of the maps; they have one extractor and one height datum."""
    found: list[NDArray[np.int64]] = []
    heard, elsewhere = 0, dict[str, float]()
    for a, feature_map in enumerate(maps):
        index = {m.map_id: b for b, m in enumerate(maps)}
        indexed = indexed_area(*(m for m in maps if m is not feature_map))
        for row, image in enumerate(feature_map.images):
            _, points = features_and_points(feature_map, image)
            if len(points) < _LEAST_FEATURES:
                continue
            photo = localise_image(feature_map, image, row, [indexed])
            if photo is None:
                continue
            center = image.cam_from_local.center
            there = in_frame(photo, feature_map.frame).cam_from_local.center
            reach = float(np.median(np.linalg.norm(feature_map.points_local()[points] - center, axis=1)))
            shift = float(np.linalg.norm(there - center))
            if shift > _MOST_SHIFT * max(reach, 1e-9):
                elsewhere[image.name] = shift
                continue
            heard += 1
            b = np.array([index[m] for m in photo.map_ids], dtype=np.int64)[photo.map_of]
            own = points[photo.feature_rows]
            quads = np.stack([np.full(len(b), a), own, b, photo.point_of], axis=1)
            swap = b < a
            quads[swap] = quads[swap][:, [2, 3, 0, 1]]
            found.append(quads)
    return _voted(np.concatenate([np.zeros((0, 4), np.int64), *found]), heard, elsewhere)


def _voted(quads: NDArray[np.int64], heard: int, elsewhere: Mapping[str, float]) -> Links:
    """The pairs that most of the images that have a say name, on both sides, most votes first."""
    pairs, votes = np.unique(quads, axis=0, return_counts=True)
    sure = np.ones(len(pairs), dtype=np.bool_)
    for one, other in (((0, 1), 2), ((2, 3), 0)):
        key = pairs[:, [*one, other]]
        _, number = np.unique(key, axis=0, return_inverse=True)
        total = np.bincount(number.reshape(-1), weights=votes)
        sure &= votes > _LEAST_SHARE * total[number.reshape(-1)]
    pairs, votes = pairs[sure], votes[sure]
    pairs = pairs[np.lexsort((*pairs.T[::-1], -votes))]
    return Links(
        map_a=pairs[:, 0],
        point_a=pairs[:, 1],
        map_b=pairs[:, 2],
        point_b=pairs[:, 3],
        heard=heard,
        elsewhere=tuple(elsewhere),
        elsewhere_m=float(np.median(list(elsewhere.values()))) if elsewhere else 0.0,
    )
