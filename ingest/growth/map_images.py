"""Images of maps as a query has them, features, and as a reconstruction does, with points."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap
from ingest.colmap.bridge import Model
from ingest.growth.values import LEAST_SHARED_POINTS

# Observations with descriptors that an image needs to be asked, of which a third are inliers in a good one.
LEAST_FEATURES = 2 * LEAST_SHARED_POINTS
NEAR_M = 50.0  # images of maps around another one are asked whose camera is so far from it at most
MOST_IMAGES = 24  # that are asked of a map or around one, nearest first; more only sharpen what they say


def observed_rows(any_map: AnyMap, image: MapImage, *, described: bool) -> NDArray[np.int64]:
    """Rows (n,) of a map's observations of one image: with descriptors first, largest of them first.

    Args:
        described: only those with descriptors.
    """
    seen = any_map.observations
    rows = np.flatnonzero(seen.image_id == image.image_id)
    rows = rows[np.lexsort((-seen.scale[rows], ~seen.has_descriptor[rows]))]
    return rows[seen.has_descriptor[rows]] if described else rows


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


def features_and_points(feature_map: FeatureMap, image: MapImage) -> tuple[Features, NDArray[np.int64]]:
    """What a map keeps of one of its photos, and the row of its points (n,) that each feature observes."""
    rows = observed_rows(feature_map, image, described=True)
    return observed_features(feature_map, image, rows), feature_map.observations.point_index[rows]


def model_of(any_map: AnyMap, xyz: FloatArray, images: Sequence[MapImage], *, described: bool) -> Model:
    """Images of a map with the points (n, 3) that they see, as a reconstruction in the map's frame.

    Keypoints of an image are its `observed_rows`.
    """
    rows = [observed_rows(any_map, image, described=described) for image in images]
    counts = [len(r) for r in rows]
    photo_of = np.repeat(np.arange(len(images), dtype=np.int64), counts)
    points = any_map.observations.point_index[np.concatenate(rows)]
    used, point_of = np.unique(points, return_inverse=True)
    order = np.lexsort((photo_of, point_of))
    return Model(
        cameras=any_map.cameras,
        rows=np.arange(len(images), dtype=np.int64),
        camera_of=np.array([image.camera_id for image in images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in images),
        xyz=xyz[used],
        point_of=point_of.reshape(-1)[order].astype(np.int64),
        photo_of=photo_of[order],
        keypoint_of=np.concatenate([np.arange(n, dtype=np.int64) for n in counts])[order],
    )
