"""Stage: the features of each photo, on a pool of processes, one file each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.features.decode import INGEST_LIMITS, decode_gray, decode_rgb
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.fingerprint import options_fingerprint
from ingest.photos.photo import Photo
from ingest.workspace import Workspace, read_array, read_arrays, write_arrays

_COLOUR_SHRINK = 4  # colours of points need no full resolution; JPEG decodes a quarter size much faster
_ARRAYS = ("xy", "scale", "angle", "response", "descriptors")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractTask:
    """One photo to extract; travels to a worker.

    Attributes:
        photo: the photo's file.
        target: the npz file to write.
    """

    photo: Path
    target: Path
    options: ExtractorOptions

    def __str__(self) -> str:
        return self.photo.name


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFeatures:
    """Features of a photo with the colour under each keypoint, (n, 3) uint8 RGB."""

    features: Features
    rgb: NDArray[np.uint8]


def extract_photos(
    photos: list[Photo],
    workspace: Workspace,
    options: ExtractorOptions,
    executor: Executor,
    progress: Progress = no_progress,
) -> tuple[dict[str, str], int]:
    """Write the features of every photo that has none yet.

    Returns:
        Photos by name whose pixels could not be read after all, with the reason; and how many had features.
    """
    fingerprint = features_key(options)
    tasks: dict[str, ExtractTask] = {}
    for photo in photos:
        target = workspace.features(fingerprint, photo.sha256)
        if not target.exists():
            tasks[photo.name] = ExtractTask(photo=photo.path, target=target, options=options)
    outcomes = executor.map("extract", _extract_one, list(tasks.values()), progress)
    reasons = (o.reason if isinstance(o, Lost) else o for o in outcomes)
    unreadable = {name: reason for name, reason in zip(tasks, reasons, strict=True) if reason}
    return unreadable, len(photos) - len(tasks)


def features_key(options: ExtractorOptions) -> str:
    """Names the folder of features made with these options by this version of the extractor."""
    return f"{options.fingerprint}-{options_fingerprint(options)}"


def read_features(path: Path) -> PhotoFeatures:
    """Features and colours of one npz file of this stage."""
    arrays = read_arrays(path)
    width, height = (int(v) for v in arrays["size"])
    features = Features(
        **{name: arrays[name] for name in _ARRAYS},
        width=width,
        height=height,
        fingerprint=str(arrays["fingerprint"]),
    )
    return PhotoFeatures(features=features, rgb=arrays["rgb"])


def read_keypoints(path: Path) -> NDArray[np.float32]:
    """Keypoints (n, 2) in pixels of one npz file of this stage; nothing else is read."""
    return np.asarray(read_array(path, "xy"), dtype=np.float32)


class FeatureFiles(Sequence[PhotoFeatures]):
    """Features of many photos, a file each, read when it is asked for and not kept; there are no slices."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)

    def __getitem__(self, index: int) -> PhotoFeatures:  # type: ignore[override]
        return read_features(self.paths[index])

    def __len__(self) -> int:
        return len(self.paths)

    def of(self, rows: Sequence[int] | NDArray[np.int64]) -> "FeatureFiles":
        """Those of some photos."""
        return FeatureFiles([self.paths[int(row)] for row in rows])


def _extract_one(task: ExtractTask) -> str:
    """Extract one photo; the reason for people if its pixels cannot be used, else ""."""
    try:
        data = task.photo.read_bytes()
        features = extract(decode_gray(data, INGEST_LIMITS), task.options)
        rgb = _colours(data, features)
    except (ImageError, OSError) as error:
        return str(error)
    write_arrays(
        task.target,
        {name: getattr(features, name) for name in _ARRAYS}
        | {
            "size": np.array([features.width, features.height]),
            "fingerprint": np.array(features.fingerprint),
            "rgb": rgb,
        },
    )
    return ""


def _colours(data: bytes, features: Features) -> NDArray[np.uint8]:
    """RGB (n, 3) under the keypoints, from the photo at a quarter of its size."""
    flags = cv2.IMREAD_REDUCED_COLOR_4 | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if bgr is None:  # OpenCV has no HEIC
        bgr = decode_rgb(data, INGEST_LIMITS)[::_COLOUR_SHRINK, ::_COLOUR_SHRINK, ::-1]
    columns = np.clip((features.xy[:, 0] / _COLOUR_SHRINK).astype(int), 0, bgr.shape[1] - 1)
    rows = np.clip((features.xy[:, 1] / _COLOUR_SHRINK).astype(int), 0, bgr.shape[0] - 1)
    return np.asarray(bgr[rows, columns, ::-1], dtype=np.uint8)
