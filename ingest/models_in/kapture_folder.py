"""A reconstruction in kapture 1.1 on disk, as arrays, with its keypoints and descriptors.

Its poses, lenses and pixels are COLMAP's. Reference: naver/kapture, kapture_format.adoc.
"""

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IngestError
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geometry.arrays import FloatArray
from ingest.colmap.bridge import Model
from ingest.models_in.kapture_sensors import KaptureSensors, floats, read_sensors, table, whole
from ingest.models_in.stored import (
    Keypoints,
    ModelSource,
    StoredFeatures,
    StoredModel,
    as_rootsift,
    scale_and_angle,
)

_TYPES = {"float32": "<f4", "float64": "<f8", "float": "<f8"}
_GREY = 128  # of points without a colour


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointKind:
    """The keypoints of one detector: their folder, and the type and number of values of each."""

    folder: Path
    dtype: str
    size: int

    def rows(self, name: str) -> FloatArray:
        """(k, size) of an image.

        Raises:
            IngestError: it has no file, or one of other values than said.
        """
        path = self.folder / f"{name}.kpt"
        data = _bytes(path, np.dtype(self.dtype).itemsize * self.size)
        rows = np.frombuffer(data, dtype=self.dtype).reshape(-1, self.size).astype(np.float64)
        if not np.isfinite(rows).all():
            raise IngestError(f"{path}: expected finite numbers, found others; extract the features again")
        return rows


class KaptureFeatures(StoredFeatures):
    """Features of the model's images from their `.kpt` and `.desc` files."""

    def __init__(
        self, stored: StoredModel, kind: KeypointKind, descriptors: Path | None, fingerprint: str
    ) -> None:
        """
        Args:
            descriptors: the folder of descriptors of these keypoints that are SIFT in 8 bits, or None.
        """
        super().__init__(stored, fingerprint)
        self._kind, self._descriptors = kind, descriptors

    def keypoints(self, index: int, *, with_descriptors: bool = True) -> Keypoints:
        """See the base class."""
        name = self.stored.names[index]
        rows = self._kind.rows(name).astype(np.float32)
        scale, angle = scale_and_angle(rows, str(self._kind.folder / name))
        descriptors = None
        if with_descriptors and self._descriptors is not None:
            path = self._descriptors / f"{name}.desc"
            data = np.frombuffer(_bytes(path, DESCRIPTOR_SIZE), dtype=np.uint8).reshape(-1, DESCRIPTOR_SIZE)
            descriptors = as_rootsift(data, str(path), len(rows))
        return Keypoints(xy=rows[:, :2], scale=scale, angle=angle, descriptors=descriptors)


def is_kapture(folder: Path) -> bool:
    """Whether a folder looks like kapture's."""
    return (folder / "sensors" / "sensors.txt").is_file()


def read_kapture(folder: Path) -> ModelSource:
    """The reconstruction in a folder.

    Raises:
        IngestError: another version of the format; files that are missing, broken, or do not belong together;
            no keypoints with scale and orientation; a lens that maps do not have.
    """
    sensors = read_sensors(folder / "sensors")
    place = folder / "reconstruction"
    xyz, rgb = _points(place / "points3d.txt")
    path = place / "observations.txt"
    kind = _keypoint_kind(place, path)
    names = tuple(image.name for image in sensors.images)
    keypoints = tuple(kind.rows(name)[:, :2] for name in names)
    seen = _observations(path, kind.folder.name, sensors, keypoints, len(xyz))
    model, used = _model(sensors, xyz, seen, path)
    descriptors = _descriptors(place, kind.folder.name)
    features = [kind.folder / f"{name}.kpt" for name in names]
    features += [] if descriptors is None else [descriptors / f"{name}.desc" for name in names]
    stored = StoredModel(model=model, names=names, camera_ids=sensors.camera_ids, xy=keypoints, rgb=rgb[used])
    photos = folder / "sensors" / "records_data"
    return ModelSource(
        format="kapture",
        place=folder,
        stored=stored,
        open_features=lambda fingerprint: nullcontext(
            KaptureFeatures(stored, kind, descriptors, fingerprint)
        ),
        has_descriptors=descriptors is not None,
        photos=photos if photos.is_dir() else None,
        gps=tuple(image.gps for image in sensors.images),
        files=(*sensors.files, place / "points3d.txt", path),
        feature_files=tuple(features),
    )


def _points(path: Path) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Coordinates (n, 3) and colours (n, 3) of the points."""
    rows = [floats(values, where) for where, values in table(path, 3, 6)]
    if not rows or any(len(row) != len(rows[0]) or len(row) not in (3, 6) for row in rows):
        raise IngestError(
            f"{path}: expected points of X, Y, Z or X, Y, Z, R, G, B, found {len(rows)} or others"
        )
    values = np.array(rows)
    rgb = np.full((len(rows), 3), _GREY) if values.shape[1] == 3 else np.clip(np.rint(values[:, 3:]), 0, 255)
    return values[:, :3], rgb.astype(np.uint8)


def _keypoint_kind(place: Path, observations: Path) -> KeypointKind:
    """The one whose keypoints the points are seen by; of several the one that is SIFT."""
    kinds = sorted({values[1] for _, values in table(observations, 2)})
    if len(kinds) > 1:
        kinds = [kind for kind in kinds if "sift" in kind.lower()]
    if len(kinds) != 1:
        raise IngestError(
            f"{observations}: expected observations of one kind of keypoints, or of one of SIFT among them, "
            f"found {kinds}"
        )
    folder = place / "keypoints" / _plain(kinds[0], observations)
    ((where, (_, dtype, size)),) = _one(folder / "keypoints.txt", 3)
    if (folder / "keypoints.tar").is_file():
        raise IngestError(
            f"{folder / 'keypoints.tar'}: expected .kpt files; unpack the archive beside it first"
        )
    if dtype.split(".")[-1] not in _TYPES:
        raise IngestError(f"{where}: expected keypoints of {', '.join(_TYPES)}, found {dtype[:40]!r}")
    count = whole(size, 1000, where)
    if count not in (4, 6):
        raise IngestError(
            f"{where}: expected keypoints with scale and orientation (4 or 6 values), found {count} values: "
            "these are no SIFT features; ingest the photos instead"
        )
    return KeypointKind(folder=folder, dtype=_TYPES[dtype.split(".")[-1]], size=count)


def _descriptors(place: Path, kind: str) -> Path | None:
    """The folder of 8-bit descriptors of these keypoints."""
    for path in sorted((place / "descriptors").glob("*/descriptors.txt")):
        ((_, (_, dtype, size, of, _)),) = _one(path, 5)
        if of == kind and dtype.split(".")[-1] == "uint8" and size == str(DESCRIPTOR_SIZE):
            return None if (path.parent / "descriptors.tar").is_file() else path.parent
    return None


def _one(path: Path, count: int) -> list[tuple[str, list[str]]]:
    """The one row of a file."""
    rows = list(table(path, count, count))
    if len(rows) != 1:
        raise IngestError(f"{path}: expected one line, found {len(rows)}")
    return rows


def _plain(name: str, where: Path) -> str:
    """A name that is a folder's, and leads nowhere else."""
    if name in ("", ".", "..") or "/" in name or "\\" in name or "\0" in name:
        raise IngestError(f"{where}: expected the name of a folder, found {name[:40]!r}")
    return name


def _observations(
    path: Path, kind: str, sensors: KaptureSensors, keypoints: tuple[FloatArray, ...], points: int
) -> NDArray[np.int64]:
    """(m, 3) point, image, keypoint of the images that have a pose."""
    row_of = {image.name: row for row, image in enumerate(sensors.images)}
    found: list[tuple[int, int, int]] = []
    for where, (point_id, of, *pairs) in table(path, 2):
        point = whole(point_id, points, where)
        if len(pairs) % 2:
            raise IngestError(
                f"{where}: expected pairs of image and keypoint, found {len(pairs)} values: cut off?"
            )
        if of != kind:
            continue
        for name, keypoint in zip(pairs[::2], pairs[1::2], strict=True):
            row = row_of.get(name)
            if row is not None:
                found.append((point, row, whole(keypoint, len(keypoints[row]), f"{where}, {name}")))
            elif name not in sensors.records:
                raise IngestError(f"{where}: expected an image of records_camera.txt, found {name[:60]!r}")
    if not found:
        raise IngestError(f"{path}: expected observations by images with a pose, found none")
    return np.array(found, dtype=np.int64)


def _model(
    sensors: KaptureSensors, xyz: FloatArray, seen: NDArray[np.int64], path: Path
) -> tuple[Model, NDArray[np.int64]]:
    """The model of the points that two or more keypoints see, and their rows."""
    lengths = np.bincount(seen[:, 0], minlength=len(xyz))
    used = np.flatnonzero(lengths >= 2)
    if not len(used):
        raise IngestError(f"{path}: expected points that two images see, found none")
    seen = seen[lengths[seen[:, 0]] >= 2]
    seen = seen[np.lexsort((seen[:, 2], seen[:, 1], seen[:, 0]))]
    number_of: Mapping[str, int] = {device: k for k, device in enumerate(sensors.cameras)}
    model = Model(
        cameras=tuple(sensors.cameras.values()),
        rows=np.arange(len(sensors.images), dtype=np.int64),
        camera_of=np.array([number_of[image.device] for image in sensors.images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_world for image in sensors.images),
        xyz=xyz[used],
        point_of=np.searchsorted(used, seen[:, 0]),
        photo_of=seen[:, 1],
        keypoint_of=seen[:, 2],
    )
    return model, used


def _bytes(path: Path, row: int) -> bytes:
    """A file of whole rows of so many bytes."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise IngestError(f"{path}: expected kapture's features, cannot be read: {error}") from error
    if len(data) % row:
        raise IngestError(
            f"{path}: expected rows of {row} bytes, found {len(data)} bytes: the file is cut off, or of "
            "another kind than is said"
        )
    return data
