"""Stage: matches of each pair of photos, verified by two-view geometry, one file a pair."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from featuredb.index.codebook import use_threads
from featuredb.index.nearest import nearest
from ingest.colmap_bridge import TwoView, verify_pair
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.extract import read_features
from ingest.fingerprint import digest, options_fingerprint
from ingest.pairs import Pair
from ingest.workspace import Workspace, read_array, read_arrays, write_arrays

_DESCRIPTOR_LENGTH = 512.0  # of 8-bit RootSIFT


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """How pairs are matched and verified.

    Attributes:
        max_ratio: angle to the nearest descriptor over angle to the second nearest (Lowe's 0.8),
            below it in both directions.
        max_angle_rad: no match between descriptors further apart (COLMAP's 0.7).
        max_error_px: of the two-view geometry, at `error_reference_side_px`, growing with the image.
        error_reference_side_px: keypoints are located on images of about this size.
        min_inliers: pairs with fewer verified matches do not count. Pairs of different places had none at
            all (tools/pair_inliers.py); repeated structure gives more, and two good photos hundreds.
        seed: of RANSAC.
    """

    max_ratio: float = 0.8
    max_angle_rad: float = 0.7
    max_error_px: float = 2.0
    error_reference_side_px: int = 1600
    min_inliers: int = 20
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoView:
    """What matching needs of a photo: its digest, features file and camera as EXIF has it."""

    sha256: str
    features: Path
    camera: Camera
    focal_known: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchTask:
    """One photo with some others; travels to a worker.

    Attributes:
        name: of the first photo.
        photo: whose features are read once.
        others: the photos that it is matched with, and the file of each pair.
    """

    name: str
    photo: PhotoView
    others: tuple[tuple[PhotoView, Path], ...]
    options: MatchOptions

    def __str__(self) -> str:
        return f"{self.name} with {len(self.others)} others"


@dataclass(frozen=True, slots=True, kw_only=True)
class Matched:
    """What the stage did.

    Attributes:
        inliers: number of verified matches of the pairs that have enough of them.
        files: where every pair's geometry lies.
        reused: pairs that were matched already.
        lost: why some pairs could not be matched.
    """

    inliers: dict[Pair, int]
    files: dict[Pair, Path]
    reused: int = 0
    lost: tuple[Lost, ...] = ()

    def __or__(self, other: "Matched") -> "Matched":
        """Both."""
        return Matched(
            inliers=self.inliers | other.inliers,
            files=self.files | other.files,
            reused=self.reused + other.reused,
            lost=self.lost + other.lost,
        )

    def geometry(self, pair: Pair) -> TwoView:
        """The two-view geometry of a pair, read from its file."""
        return TwoView(**read_arrays(self.files[pair]))


def match_pairs(
    views: Sequence[PhotoView],
    pairs: Sequence[Pair],
    workspace: Workspace,
    options: MatchOptions,
    executor: Executor,
    progress: Progress = no_progress,
    names: Sequence[str] | None = None,
) -> Matched:
    """Match and verify every pair that is not done yet.

    Args:
        names: of the photos, for messages.
    """
    files = {pair: _match_file(views[pair[0]], views[pair[1]], workspace, options) for pair in pairs}
    todo: dict[int, list[Pair]] = {}
    counts: dict[Pair, int] = {}
    for pair, file in files.items():
        if file.exists():
            counts[pair] = len(read_array(file, "inliers"))
        else:
            todo.setdefault(pair[0], []).append(pair)
    tasks = [
        MatchTask(
            name=names[i] if names is not None else views[i].sha256,
            photo=views[i],
            others=tuple((views[j], files[i, j]) for _, j in own),
            options=options,
        )
        for i, own in todo.items()
    ]
    reused = len(counts)
    outcomes = executor.map("match", _match_one, tasks, progress)
    for own, outcome in zip(todo.values(), outcomes, strict=True):
        if not isinstance(outcome, Lost):
            counts |= dict(zip(own, outcome, strict=True))
    return Matched(
        inliers={p: counts[p] for p in files if counts.get(p, 0) >= options.min_inliers},
        files=files,
        reused=reused,
        lost=tuple(o for o in outcomes if isinstance(o, Lost)),
    )


def mutual_matches(
    descriptors_a: NDArray[np.uint8], descriptors_b: NDArray[np.uint8], options: MatchOptions
) -> NDArray[np.uint32]:
    """Mutual nearest neighbours that pass the ratio test in both directions: rows (m, 2) of a and b."""
    if len(descriptors_a) < 2 or len(descriptors_b) < 2:
        return np.zeros((0, 2), np.uint32)
    nearest_b = _distinct_nearest(descriptors_a, descriptors_b, options)
    rows = np.flatnonzero(nearest_b >= 0)
    candidates, place = np.unique(nearest_b[rows], return_inverse=True)
    nearest_a = _distinct_nearest(descriptors_b[candidates], descriptors_a, options)
    mutual = nearest_a[place] == rows
    return np.stack([rows[mutual], nearest_b[rows[mutual]]], axis=1).astype(np.uint32)


def _distinct_nearest(
    queries: NDArray[np.uint8], base: NDArray[np.uint8], options: MatchOptions
) -> NDArray[np.int64]:
    """Row of base (n,) nearest to each query, -1 where it is too far or the second nearest is as near."""
    if not len(queries):
        return np.zeros(0, np.int64)
    squared, rows = nearest(queries, base, 2)
    angles = 2.0 * np.arcsin(np.clip(np.sqrt(squared) / (2.0 * _DESCRIPTOR_LENGTH), 0.0, 1.0))
    good = (angles[:, 0] < options.max_ratio * angles[:, 1]) & (angles[:, 0] <= options.max_angle_rad)
    return np.where(good, rows[:, 0], -1)


def _match_one(task: MatchTask) -> list[int]:
    """Match one photo with its others and write a file for each; the numbers of verified matches."""
    use_threads(1)
    features = read_features(task.photo.features).features
    return [_match_pair(task, features, other, target) for other, target in task.others]


def _match_pair(task: MatchTask, a: Features, other: PhotoView, target: Path) -> int:
    if target.exists():  # a worker that died had come so far
        return len(read_array(target, "inliers"))
    b = read_features(other.features).features
    matches = mutual_matches(a.descriptors, b.descriptors, task.options)
    side = max(a.width, a.height, b.width, b.height)
    view = verify_pair(
        task.photo.camera,
        a.xy,
        other.camera,
        b.xy,
        matches,
        focal_known=task.photo.focal_known and other.focal_known,
        max_error_px=task.options.max_error_px * max(1.0, side / task.options.error_reference_side_px),
        seed=task.options.seed,
    )
    write_arrays(target, view.arrays())
    return len(view.inliers)


def _match_file(a: PhotoView, b: PhotoView, workspace: Workspace, options: MatchOptions) -> Path:
    """The pair's file: keyed by the photos, how features were made, the cameras and the options."""
    key = digest(options_fingerprint(options), a.features.parent.name, repr(a.camera), repr(b.camera))[:16]
    return workspace.matches(key, a.sha256, b.sha256)
