"""Descriptors made anew of the photos, at the keypoints that the model was made of."""

from collections.abc import Sequence
from pathlib import Path

from featuredb.errors import ImageError, IngestError
from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.features.describe import describe_at
from featuredb.features.orientation import orientations_at
from ingest.models_in.stored import StoredFeatures
from ingest.sfm.extract import LazyFeatures, PhotoFeatures


class DescribedAnew(LazyFeatures):
    """Features of the model's images with this extractor's own descriptors, and its own orientations where
    the model's files have none; one photo in memory at a time."""

    def __init__(self, stored: StoredFeatures, photos: Sequence[Path]) -> None:
        self._stored, self._photos = stored, tuple(photos)

    def read(self, index: int) -> PhotoFeatures:
        keypoints = self._stored.keypoints(index, with_descriptors=False)
        if not (keypoints.scale > 0).all():
            raise IngestError(
                f"{self._stored.stored.names[index]}: expected keypoints with scales > 0, found "
                f"{keypoints.scale.min()}; give a model of features that have scales"
            )
        try:
            gray = decode_gray(self._photos[index].read_bytes(), INGEST_LIMITS)
            angle = keypoints.angle
            if angle is None:
                angle = orientations_at(gray, keypoints.xy, keypoints.scale)
            descriptors = describe_at(gray, keypoints.xy, keypoints.scale, angle)
        except (ImageError, OSError) as error:
            raise IngestError(f"{self._photos[index]}: cannot be described anew: {error}") from error
        return self._stored.features(index, keypoints, angle, descriptors, gray.shape)

    def __len__(self) -> int:
        return len(self._stored)
