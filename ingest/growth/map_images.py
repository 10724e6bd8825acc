"""Images of maps as what a query has: features, and the points that they observe."""

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap


def observed_features(any_map: AnyMap, image: MapImage, rows: NDArray[np.int64]) -> Features:
    """Rows (n,) of a map's observations, all of one image, as features of that photo, best first."""
    seen, camera = any_map.observations, any_map.cameras[image.camera_id]
    return Features(
        xy=seen.xy[rows],
        scale=seen.scale[rows],
        angle=seen.angle[rows],
        response=np.linspace(1.0, 0.5, len(rows), dtype=np.float32),
        descriptors=seen.descriptors[rows],
        width=camera.width,
        height=camera.height,
        fingerprint=any_map.extractor_fingerprint,
    )


def features_of_image(feature_map: FeatureMap, image: MapImage) -> Features:
    """What a map keeps of one of its photos: the observations with descriptors, largest scale first."""
    return features_and_points(feature_map, image)[0]


def features_and_points(feature_map: FeatureMap, image: MapImage) -> tuple[Features, NDArray[np.int64]]:
    """The same, with the row of the map's points (n,) that each feature observes."""
    seen = feature_map.observations
    rows = np.flatnonzero((seen.image_id == image.image_id) & seen.has_descriptor)
    rows = rows[np.argsort(-seen.scale[rows], kind="stable")]
    return observed_features(feature_map, image, rows), seen.point_index[rows]
