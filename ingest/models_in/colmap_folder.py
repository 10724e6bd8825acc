"""A COLMAP model on disk, as arrays: poses, points and keypoints, whatever version wrote it."""

import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.errors import IngestError, InvalidValueError
from ingest.colmap.bridge import model_of
from ingest.models_in.stored import Keypoints, ReadKeypoints, StoredModel, as_rootsift, scale_and_angle

_SAME_PLACE_PX = 0.01  # text models have as many digits as one likes, keypoints are float32
_UNDEFINED, _SIFT = -1, 0  # of COLMAP's kinds of features


def model_folder(folder: Path) -> Path:
    """Where the model lies: in the folder, its `sparse` or `sparse/0`.

    Raises:
        IngestError: nowhere there.
    """
    for place in (folder, folder / "sparse", folder / "sparse" / "0"):
        if any((place / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
            return place
    raise IngestError(
        f"{folder}: expected a COLMAP model (cameras, images and points3D, .bin or .txt), found none there "
        "nor in sparse or sparse/0"
    )


def read_colmap(folder: Path) -> StoredModel:
    """The model in one of the places of `model_folder`.

    Raises:
        IngestError: there is none, it is broken, without registered images or points, or has a lens that maps
            do not have.
    """
    place = model_folder(folder)
    check_whole(place)
    try:
        reconstruction = pycolmap.Reconstruction(str(place))
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        raise IngestError(f"{place}: COLMAP cannot read this model: {str(error).strip()}") from error
    image_ids = sorted(reconstruction.reg_image_ids())
    if not image_ids or not reconstruction.num_points3D():
        raise IngestError(
            f"{place}: expected a model with registered images and points, found {len(image_ids)} and "
            f"{reconstruction.num_points3D()}"
        )
    try:
        model = model_of(reconstruction)
    except InvalidValueError as error:
        raise IngestError(f"{place}: {error}; undistort the images to a simpler camera first") from error
    images = [reconstruction.image(i) for i in image_ids]
    point_ids = sorted(reconstruction.point3D_ids())
    return StoredModel(
        # Rows are those of this model alone: ids of COLMAP may have gaps.
        model=replace(model, rows=np.arange(len(model.rows), dtype=np.int64)),
        names=tuple(image.name for image in images),
        camera_ids=tuple(sorted({image.camera_id for image in images})),
        xy=tuple(np.array([p.xy for p in i.points2D], dtype=np.float64).reshape(-1, 2) for i in images),
        rgb=np.array([reconstruction.point3D(i).color for i in point_ids], dtype=np.uint8),
    )


# Whether the binary files of a COLMAP model are whole: their records end where the file does.
#
# COLMAP believes a file's counts: from one that was cut off it goes on to read records that are not there,
# for as long as there is memory. So the records are walked before it is asked. Formats:
# `reconstruction_io.cc` of COLMAP (`cameras`, `images`, `points3D` of all versions, `rigs` and `frames`
# since 3.12); little endian, no padding.

_COUNT = struct.Struct("<Q")
_SENSOR = 8  # type int32, id uint32
_POSE = 7 * 8  # quaternion, translation
_CAMERA, _IMAGE, _POINT = 4 + 4 + 8 + 8, 4 + _POSE + 4, 8 + 3 * 8 + 3 + 8
_KEYPOINT, _TRACK_ELEMENT = 2 * 8 + 8, 4 + 4


def check_whole(folder: Path) -> None:
    """Walk the records of each binary file of a model.

    Raises:
        IngestError: a file ends within a record, or goes on after the last, or names a lens that is unknown.
    """
    for name, after in _AFTER.items():
        file = folder / f"{name}.bin"
        if not file.is_file():
            continue
        data = file.read_bytes()
        count = 0
        try:
            (wanted,) = _COUNT.unpack_from(data)
            at = _COUNT.size
            while count < wanted:
                at = after(data, at)
                if at > len(data):
                    raise IndexError
                count += 1
        except (struct.error, IndexError, ValueError):
            raise IngestError(
                f"{file}: expected a whole file of COLMAP, found {len(data)} bytes that break off after "
                f"{count} records; copy or export the model again"
            ) from None
        if at != len(data):
            raise IngestError(
                f"{file}: expected a whole file of COLMAP, found {len(data) - at} bytes after its {count} "
                "records; copy or export the model again"
            )


def _after_camera(data: bytes, at: int) -> int:
    (model,) = struct.unpack_from("<i", data, at + 4)
    return at + _CAMERA + 8 * _parameters(model)


@lru_cache(maxsize=64)
def _parameters(model: int) -> int:
    """Number of parameters of a lens; ValueError for a number that is none."""
    named = pycolmap.CameraModelId(model)
    if named == pycolmap.CameraModelId.INVALID:
        raise ValueError(model)
    return len(pycolmap.Camera.create_from_model_id(1, named, 1.0, 1, 1).params)


def _after_image(data: bytes, at: int) -> int:
    end = data.index(b"\0", at + _IMAGE) + 1  # of the name
    (keypoints,) = _COUNT.unpack_from(data, end)
    return int(end + _COUNT.size + keypoints * _KEYPOINT)


def _after_point(data: bytes, at: int) -> int:
    (track,) = _COUNT.unpack_from(data, at + _POINT)
    return int(at + _POINT + _COUNT.size + track * _TRACK_ELEMENT)


def _after_rig(data: bytes, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8 + (_SENSOR if sensors else 0)
    for _ in range(1, sensors):
        at += _SENSOR + 1 + (_POSE if data[at + _SENSOR] else 0)
    return at


def _after_frame(data: bytes, at: int) -> int:
    (seen,) = struct.unpack_from("<I", data, at + 8 + _POSE)
    return int(at + 8 + _POSE + 4 + seen * (_SENSOR + 8))


_AFTER: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _after_camera,
    "rigs": _after_rig,
    "frames": _after_frame,
    "images": _after_image,
    "points3D": _after_point,
}


def _keypoints(
    database: sqlite3.Connection, stored: StoredModel, index: int, with_descriptors: bool
) -> Keypoints:
    """Of one image; see `ReadKeypoints`."""
    name, xy = stored.names[index], stored.xy[index]
    found = database.execute("SELECT image_id FROM images WHERE name = ?", (name,)).fetchone()
    if found is None:
        raise IngestError(f"{name}: expected this image of the model in COLMAP's database, found none")
    (image_id,) = found
    blob = _blob(database, "keypoints", image_id, np.dtype("<f4"))
    rows = np.zeros((0, 4), np.float32) if blob is None else blob.astype(np.float32)
    if len(rows) != len(xy) or not (np.abs(rows[:, :2] - xy) <= _SAME_PLACE_PX).all():
        raise IngestError(
            f"{name}: COLMAP's database and model disagree: {len(rows)} keypoints and {len(xy)} 2D points, "
            "or other places; give the database that the model was made with"
        )
    scale, angle = scale_and_angle(rows, f"{name} in COLMAP's database")
    descriptors = _descriptors(database, name, image_id, len(xy)) if with_descriptors else None
    return Keypoints(xy=xy.astype(np.float32), scale=scale, angle=angle, descriptors=descriptors)


@contextmanager
def open_keypoints(path: Path, stored: StoredModel) -> Iterator[ReadKeypoints]:
    """The keypoints in COLMAP's database at `path`.

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
            yield partial(_keypoints, database, stored)
    except sqlite3.DatabaseError as error:
        raise IngestError(f"{path}: expected COLMAP's database, found something else ({error})") from error


def _blob(
    database: sqlite3.Connection, table: str, image_id: int, kind: np.dtype[np.generic]
) -> NDArray[np.generic] | None:
    """The (rows, cols) array of an image in `keypoints` or `descriptors`, None where there is none."""
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


def _descriptors(
    database: sqlite3.Connection, name: str, image_id: int, count: int
) -> NDArray[np.uint8] | None:
    """Descriptors (k, 128) that can be compared with ours, or None."""
    columns = {row[1] for row in database.execute("PRAGMA table_info(descriptors)")}
    if "type" in columns:  # since COLMAP 4
        kind = database.execute("SELECT type FROM descriptors WHERE image_id = ?", (image_id,)).fetchone()
        if kind is not None and kind[0] not in (_UNDEFINED, _SIFT):
            raise IngestError(
                f"{name}: expected SIFT in COLMAP's database, found features of its type {kind[0]}; maps "
                "hold SIFT only: ingest the photos instead"
            )
    data = _blob(database, "descriptors", image_id, np.dtype("u1"))
    return None if data is None else as_rootsift(data, name, count)
