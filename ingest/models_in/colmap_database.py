"""Keypoints and descriptors of a COLMAP database, which is only read, whatever version wrote it.

pycolmap brings a database that it opens to its own version; so the tables are read here as SQLite has them.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError
from ingest.models_in.stored import Keypoints, ReadKeypoints, StoredModel, as_rootsift, scale_and_angle

_SAME_PLACE_PX = 0.01  # text models have as many digits as one likes, keypoints are float32
_UNDEFINED, _SIFT = -1, 0  # of COLMAP's kinds of features


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
    if rows.shape[0] != len(xy) or (len(xy) and np.abs(rows[:, :2] - xy).max() > _SAME_PLACE_PX):
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
    return as_rootsift(data, name, count)
