"""Keypoints and descriptors of a COLMAP database, which is only read, whatever version wrote it.

pycolmap brings a database that it opens to its own version; so the tables are read here as SQLite has them.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError
from featuredb.features.features import DESCRIPTOR_SIZE, Features
from ingest.extract import PhotoFeatures
from ingest.models_in.colmap_folder import ColmapModel

_SAME_PLACE_PX = 0.01  # text models have as many digits as one likes, keypoints are float32
# RootSIFT in 8 bits has length 512. Its mean value tells it from SIFT that was normalised by L2: on photos of
# `brighton` 37.3 (this extractor), 37.0 (COLMAP's, L1_ROOT) and 29.1 (COLMAP's, L2).
_NORM_RANGE, _MEAN_RANGE = (500.0, 524.0), (33.0, 42.0)
_UNDEFINED, _SIFT = -1, 0  # of COLMAP's kinds of features


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keypoints:
    """Of one image, from COLMAP's database: xy (k, 2) and, in our units, diameter (k,) and degrees (k,);
    descriptors (k, 128), None where the database has none."""

    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | None


class ColmapFeatures(Sequence[PhotoFeatures]):
    """Features of the model's images from the database, each read when it is asked for, and not kept."""

    def __init__(self, database: sqlite3.Connection, colmap: ColmapModel, fingerprint: str) -> None:
        self._database, self._colmap, self._fingerprint = database, colmap, fingerprint

    @overload
    def __getitem__(self, index: int) -> PhotoFeatures: ...

    @overload
    def __getitem__(self, index: slice) -> "Sequence[PhotoFeatures]": ...

    def __getitem__(self, index: int | slice) -> "PhotoFeatures | Sequence[PhotoFeatures]":
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        found = self.keypoints(index)
        if found.descriptors is None:
            raise IngestError(
                f"{self._colmap.names[index]}: COLMAP's database has no descriptors of it; give --photos and "
                "--descriptors photos"
            )
        return self.features(index, found, found.descriptors)

    def __len__(self) -> int:
        return len(self._colmap.names)

    def features(
        self,
        index: int,
        keypoints: Keypoints,
        descriptors: NDArray[np.uint8],
        shape: tuple[int, ...] | None = None,
    ) -> PhotoFeatures:
        """The keypoints with these descriptors.

        Args:
            shape: (height, width) of the photo, where it has been read.

        Raises:
            IngestError: the photo is of another size than the camera.
        """
        camera = self._colmap.model.cameras[int(self._colmap.model.camera_of[index])]
        if shape is not None and shape[:2] != (camera.height, camera.width):
            raise IngestError(
                f"{self._colmap.names[index]}: expected {camera.width}x{camera.height} pixels as the model's "
                f"camera has, found {shape[1]}x{shape[0]}; give the photos that the model was made of"
            )
        return PhotoFeatures(
            features=Features(
                xy=keypoints.xy,
                scale=keypoints.scale,
                angle=keypoints.angle,
                response=np.ones(len(keypoints.xy), np.float32),
                descriptors=descriptors,
                width=camera.width,
                height=camera.height,
                fingerprint=self._fingerprint,
            ),
            rgb=self._colmap.keypoint_colours(index),
        )

    def keypoints(self, index: int, *, with_descriptors: bool = True) -> Keypoints:
        """Of one image, checked against the model; without descriptors where they are not asked for.

        Raises:
            IngestError: the database has no such image, other keypoints than the model, or other descriptors
                than RootSIFT.
        """
        name, xy = self._colmap.names[index], self._colmap.xy[index]
        found = self._database.execute("SELECT image_id FROM images WHERE name = ?", (name,)).fetchone()
        if found is None:
            raise IngestError(f"{name}: expected this image of the model in COLMAP's database, found none")
        (image_id,) = found
        stored = _blob(self._database, "keypoints", image_id, np.dtype("<f4"))
        rows = np.zeros((0, 4), np.float32) if stored is None else stored.astype(np.float32)
        if rows.shape[0] != len(xy) or (len(xy) and np.abs(rows[:, :2] - xy).max() > _SAME_PLACE_PX):
            raise IngestError(
                f"{name}: COLMAP's database and model disagree: {len(rows)} keypoints and {len(xy)} 2D "
                "points, or other places; give the database that the model was made with"
            )
        scale, angle = _scale_and_angle(rows)
        descriptors = None
        if with_descriptors:
            descriptors = _descriptors(self._database, name, image_id, len(xy))
        return Keypoints(xy=xy.astype(np.float32), scale=scale, angle=angle, descriptors=descriptors)


@contextmanager
def open_features(path: Path, colmap: ColmapModel, fingerprint: str) -> Iterator[ColmapFeatures]:
    """The features in COLMAP's database at `path`.

    Raises:
        IngestError: there is none.
    """
    if not path.is_file():
        raise IngestError(
            f"{path}: expected COLMAP's database with keypoints and descriptors, found none; a model alone "
            "has no scales and orientations to describe its keypoints by: give --database FILE"
        )
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            database.execute("SELECT count(*) FROM keypoints")
            yield ColmapFeatures(database, colmap, fingerprint)
    except sqlite3.DatabaseError as error:
        raise IngestError(f"{path}: expected COLMAP's database, found something else ({error})") from error


def _blob(
    database: sqlite3.Connection, table: str, image_id: int, kind: np.dtype[np.generic]
) -> NDArray[np.generic] | None:
    """The (rows, cols) array of an image in `keypoints` or `descriptors`, None where there is none.

    Raises:
        IngestError: it has other bytes than its size says.
    """
    query = f"SELECT rows, cols, data FROM {table} WHERE image_id = ?"
    found = database.execute(query, (image_id,)).fetchone()
    if found is None:
        return None
    rows, columns, data = found
    if len(data or b"") != rows * columns * kind.itemsize:
        raise IngestError(
            f"COLMAP's database: {table} of image {image_id}: expected {rows}x{columns} values of "
            f"{kind.itemsize} bytes, found {len(data or b'')} bytes"
        )
    return np.frombuffer(data or b"", dtype=kind).reshape(rows, columns)


def _scale_and_angle(rows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Diameter in pixels and degrees of COLMAP's keypoints of 4 columns, or 6 (an affine shape).

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
            f"expected keypoints with scale and orientation (4 or 6 columns) in COLMAP's database, found "
            f"{rows.shape[1]} columns: these are no SIFT features"
        )
    degrees = np.degrees(turn.astype(np.float64)) % 360.0
    return (2.0 * scale).astype(np.float32), (degrees.astype(np.float32) % np.float32(360.0))


def _descriptors(
    database: sqlite3.Connection, name: str, image_id: int, count: int
) -> NDArray[np.uint8] | None:
    """Descriptors (k, 128) that can be compared with ours, or None.

    Raises:
        IngestError: other features than SIFT, or not RootSIFT.
    """
    columns = {row[1] for row in database.execute("PRAGMA table_info(descriptors)")}
    if "type" in columns:  # since COLMAP 4
        kind = database.execute("SELECT type FROM descriptors WHERE image_id = ?", (image_id,)).fetchone()
        if kind is not None and kind[0] not in (_UNDEFINED, _SIFT):
            raise IngestError(
                f"{name}: expected SIFT in COLMAP's database, found features of its type {kind[0]}; maps "
                "hold SIFT only: ingest the photos instead"
            )
    data = _blob(database, "descriptors", image_id, np.dtype("u1"))
    if data is None:
        return None
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
