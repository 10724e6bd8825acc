"""What every format of models gives: the model as arrays, and the keypoints and descriptors of its images."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, IngestError
from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.features.extractor import describe_at, orientations_at
from featuredb.features.features import DESCRIPTOR_SIZE, Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import GeoPrior
from ingest.colmap.bridge import Model
from ingest.sfm.extract import PhotoFeatures

# RootSIFT in 8 bits has length 512. Its mean value tells it from SIFT that was normalised by L2: on photos of
# `brighton` 37.3 (this extractor), 37.0 (COLMAP's, L1_ROOT) and 29.1 (COLMAP's, L2).
_NORM_RANGE, _MEAN_RANGE = (500.0, 524.0), (33.0, 42.0)


ModelFormat = Literal["colmap", "opensfm"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredModel:
    """What the model's files hold.

    Attributes:
        model: `model.rows` are 0, 1, ... of `names`.
        names: of the registered images, in the order of the files.
        camera_ids: of `model.cameras`, counted from 1.
        xy: for each image its keypoints (k, 2), pixels.
        rgb: (n, 3) uint8 of the points.
    """

    model: Model
    names: tuple[str, ...]
    camera_ids: tuple[int, ...]
    xy: tuple[NDArray[np.float64], ...]
    rgb: NDArray[np.uint8]

    def keypoint_colours(self, row: int) -> NDArray[np.uint8]:
        """(k, 3): each keypoint of an image has the colour of its point; black without one."""
        colours = np.zeros((len(self.xy[row]), 3), np.uint8)
        mine = self.model.photo_of == row
        colours[self.model.keypoint_of[mine]] = self.rgb[self.model.point_of[mine]]
        return colours


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keypoints:
    """Of one image: xy (k, 2) and, in our units, diameter (k,) and degrees (k,), None where the files have no
    orientations; descriptors (k, 128), None where they have none."""

    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    angle: NDArray[np.float32] | None
    descriptors: NDArray[np.uint8] | None


ReadKeypoints = Callable[[int, bool], Keypoints]
"""Keypoints of an image by its number, checked against the model, and whether with descriptors; raises
IngestError where the files have other keypoints than the model, or other descriptors than RootSIFT."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelSource:
    """A model that has been read.

    Attributes:
        files: what it was read from. feature_files: what its features will be.
        has_descriptors: whether the format keeps descriptors that can be compared with ours.
        photos: where the format has its photos, None where that is anywhere.
        reference: the frame of the model's coordinates, without its accuracy; None: the files do not say.
        gps: for each image, what the files say of its own position; empty: nothing.
        choice: which of several models it is, "" where there is one.
    """

    format: ModelFormat
    place: Path
    stored: StoredModel
    files: tuple[Path, ...]
    open_keypoints: Callable[[], AbstractContextManager[ReadKeypoints]]
    feature_files: tuple[Path, ...] = ()
    has_descriptors: bool = True
    photos: Path | None = None
    reference: LocalFrame | None = None
    gps: tuple[GeoPrior | None, ...] = ()
    choice: str = ""


def scale_and_angle(rows: NDArray[np.float32], where: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Diameter in pixels and degrees of keypoints (k, 4 or 6): x, y and COLMAP's scale and radians, or x, y
    and an affine shape.

    Raises:
        IngestError: keypoints without scale.
    """
    if rows.shape[1] == 4:
        scale, turn = rows[:, 2], rows[:, 3]
    elif rows.shape[1] == 6:
        a11, a12, a21, a22 = rows[:, 2:].T
        scale, turn = (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2.0, np.arctan2(a21, a11)
    else:
        raise IngestError(
            f"{where}: expected keypoints with scale and orientation (4 or 6 columns), found "
            f"{rows.shape[1]} columns: these are no SIFT features"
        )
    degrees = np.degrees(turn.astype(np.float64)) % 360.0
    return (2.0 * scale).astype(np.float32), (degrees.astype(np.float32) % np.float32(360.0))


def as_rootsift(data: NDArray[np.generic], name: str, count: int) -> NDArray[np.uint8]:
    """Descriptors (k, 128) that can be compared with ours.

    Raises:
        IngestError: of another number or size, or not RootSIFT.
    """
    if data.shape != (count, DESCRIPTOR_SIZE):
        raise IngestError(
            f"{name}: expected descriptors of {count} keypoints with {DESCRIPTOR_SIZE} values, found "
            f"{data.shape}; give --photos and --descriptors photos"
        )
    described = data[data.any(axis=1)].astype(np.float64)
    if len(described):
        norm, mean = float(np.median(np.linalg.norm(described, axis=1))), float(described.mean())
        if not (_NORM_RANGE[0] < norm < _NORM_RANGE[1] and _MEAN_RANGE[0] < mean < _MEAN_RANGE[1]):
            raise IngestError(
                f"{name}: expected RootSIFT (COLMAP's normalisation L1_ROOT: length 512, mean about 37), "
                f"found length {norm:.0f}, mean {mean:.1f}; give --photos and --descriptors photos"
            )
    return data.astype(np.uint8)


class ModelFeatures(Sequence[PhotoFeatures]):
    """Features of the model's images, each read when it is asked for, and not kept; there are no slices.

    Args:
        fingerprint: of the extractor whose descriptors they have.
        photos: of the images, to make descriptors anew at the keypoints, and orientations where the model's
            files have none; None: descriptors are those of the files.
    """

    def __init__(
        self,
        stored: StoredModel,
        keypoints: ReadKeypoints,
        fingerprint: str,
        photos: Sequence[Path] | None = None,
    ) -> None:
        self._stored, self._keypoints, self._fingerprint = stored, keypoints, fingerprint
        self._photos = photos

    def __getitem__(self, index: int) -> PhotoFeatures:  # type: ignore[override]
        stored, name = self._stored, self._stored.names[index]
        found = self._keypoints(index, self._photos is None)
        if self._photos is not None:
            found = self._described(found, index, self._photos[index])
        if found.descriptors is None or found.angle is None:
            raise IngestError(
                f"{name}: the model's files have no descriptors of it; give --photos and --descriptors photos"
            )
        camera = self._camera(index)
        return PhotoFeatures(
            features=Features(
                xy=found.xy,
                scale=found.scale,
                angle=found.angle,
                response=np.ones(len(found.xy), np.float32),
                descriptors=found.descriptors,
                width=camera.width,
                height=camera.height,
                fingerprint=self._fingerprint,
            ),
            rgb=stored.keypoint_colours(index),
        )

    def _described(self, found: Keypoints, index: int, photo: Path) -> Keypoints:
        name, camera = self._stored.names[index], self._camera(index)
        if not (found.scale > 0).all():
            raise IngestError(
                f"{name}: expected keypoints with scales > 0, found {found.scale.min()}; give a model of "
                "features that have scales"
            )
        try:
            gray = decode_gray(photo.read_bytes(), INGEST_LIMITS)
        except (ImageError, OSError) as error:
            raise IngestError(f"{photo}: cannot be described anew: {error}") from error
        if gray.shape != (camera.height, camera.width):
            raise IngestError(
                f"{name}: expected {camera.width}x{camera.height} pixels as the model's camera has, found "
                f"{gray.shape[1]}x{gray.shape[0]}; give the photos that the model was made of"
            )
        try:
            angle = orientations_at(gray, found.xy, found.scale) if found.angle is None else found.angle
            descriptors = describe_at(gray, found.xy, found.scale, angle)
        except ImageError as error:
            raise IngestError(f"{name}: {error}; give the database that the model was made with") from error
        return replace(found, angle=angle, descriptors=descriptors)

    def _camera(self, index: int) -> Camera:
        model = self._stored.model
        return model.cameras[int(model.camera_of[index])]

    def __len__(self) -> int:
        return len(self._stored.names)
