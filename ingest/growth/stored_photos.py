"""A map without a place as growth takes new photos: what is kept of its images, and its reconstruction."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.maps.feature_map import MapImage
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from ingest.colmap_bridge import Model
from ingest.extract import PhotoFeatures
from ingest.photo import Photo


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredPhotos:
    """Images of a map as photos; one row each, in the map's order.

    Attributes:
        model: the map's reconstruction, in its own frame; keypoints are rows of the features.
        features: of every observation; those with a descriptor first, the largest of them first.
        described: (k,) how many of each image's features have a descriptor.
    """

    photos: tuple[Photo, ...]
    model: Model
    features: tuple[PhotoFeatures, ...]
    described: tuple[int, ...]

    def features_of(self, row: int) -> PhotoFeatures:
        """All features of an image."""
        return self.features[row]

    def described_of(self, row: int) -> PhotoFeatures:
        """Those that can be matched; they have the same rows."""
        rows = np.arange(self.described[row])
        whole = self.features[row]
        return PhotoFeatures(features=whole.features.take(rows), rgb=whole.rgb[rows])


def stored_photos(unplaced: UnplacedMap) -> StoredPhotos:
    """The images of a map, as if they were new."""
    seen = unplaced.observations
    features, described, point_of, photo_of, keypoint_of = [], [], [], [], []
    for row, image in enumerate(unplaced.images):
        rows = np.flatnonzero(seen.image_id == image.image_id)
        rows = rows[np.lexsort((-seen.scale[rows], ~seen.has_descriptor[rows]))]
        rgb = unplaced.points.rgb[unplaced.observations.point_index[rows]]
        features.append(PhotoFeatures(features=observed_features(unplaced, image, rows), rgb=rgb))
        described.append(int(seen.has_descriptor[rows].sum()))
        point_of.append(seen.point_index[rows])
        photo_of.append(np.full(len(rows), row, dtype=np.int64))
        keypoint_of.append(np.arange(len(rows), dtype=np.int64))
    points, photos, keypoints = (np.concatenate(parts) for parts in (point_of, photo_of, keypoint_of))
    order = np.lexsort((photos, points))
    model = Model(
        cameras=unplaced.cameras,
        rows=np.arange(len(unplaced.images), dtype=np.int64),
        camera_of=np.array([image.camera_id for image in unplaced.images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in unplaced.images),
        xyz=unplaced.points.xyz,
        point_of=points[order].astype(np.int64),
        photo_of=photos[order],
        keypoint_of=keypoints[order],
    )
    return StoredPhotos(
        photos=tuple(_photo(unplaced, image) for image in unplaced.images),
        model=model,
        features=tuple(features),
        described=tuple(described),
    )


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


def _photo(unplaced: UnplacedMap, image: MapImage) -> Photo:
    camera = unplaced.cameras[image.camera_id]
    keys = unplaced.camera_keys
    return Photo(
        name=image.name,
        path=Path(image.name),
        sha256=image.sha256,
        width=camera.width,
        height=camera.height,
        camera_key=keys[image.camera_id] if keys else "",
        capture_time=image.capture_time,
        gps=image.gps,
        owner=image.owner,
        licence=image.licence,
    )
