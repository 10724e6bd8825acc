"""Stage: matches of each pair of photos, verified by two-view geometry, one file a pair."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from featuredb.index.descriptor_index import use_threads
from featuredb.index.nearest import nearest
from ingest.colmap.bridge import TwoView, verify_pair
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.fingerprint import digest, options_fingerprint
from ingest.sfm.extract import read_features
from ingest.sfm.overlays import is_copy, without_overlay
from ingest.sfm.pairs import Pair
from ingest.workspace import Workspace, read_array, read_arrays, write_arrays

_DESCRIPTOR_LENGTH = 512.0  # of 8-bit RootSIFT
# The box holds 99.0 % of the verified matches of `seneca`, and takes 42 % of the time.
_OUTSIDE = (0.05, 0.95)  # of the first matches, along each axis: some are wrong
_MARGIN = 0.15  # of the longer side


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """How pairs are matched and verified.

    Attributes:
        max_ratio: angle to the nearest descriptor over angle to the second nearest (Lowe's 0.8),
            below it in both directions.
        max_angle_rad: no match between descriptors further apart (COLMAP's 0.7).
        max_error_px: of the two-view geometry, at `error_reference_side_px`, growing with the image.
        error_reference_side_px: keypoints are located on images of about this size.
        first_features: strongest features of each photo, which are matched first.
        least_first: a pair with fewer matches among them is not matched further.
        min_inliers: pairs with fewer verified matches do not count. Pairs of `brighton` and `lewis` had
            none at all; repeated structure gives more, and two good photos hundreds.
        seed: of RANSAC.
    """

    max_ratio: float = 0.8
    max_angle_rad: float = 0.7
    max_error_px: float = 2.0
    error_reference_side_px: int = 1600
    first_features: int = 3000
    least_first: int = 6
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
        copies: pairs among them whose matches are those of two copies of one picture.
        files: where every pair's geometry lies.
        reused: pairs that were matched already.
        lost: why some pairs could not be matched.
    """

    inliers: dict[Pair, int]
    files: dict[Pair, Path]
    copies: frozenset[Pair] = frozenset()
    reused: int = 0
    lost: tuple[Lost, ...] = ()

    def __or__(self, other: "Matched") -> "Matched":
        """Both."""
        return Matched(
            inliers=self.inliers | other.inliers,
            files=self.files | other.files,
            copies=self.copies | other.copies,
            reused=self.reused + other.reused,
            lost=self.lost + other.lost,
        )

    def without(self, rows: Collection[int]) -> "Matched":
        """Without the verified pairs of some photos."""
        kept = {(i, j): n for (i, j), n in self.inliers.items() if i not in rows and j not in rows}
        return replace(self, inliers=kept, copies=self.copies & kept.keys())

    def geometry(self, pair: Pair) -> TwoView:
        """The two-view geometry of a pair, read from its file."""
        return read_two_view(self.files[pair])


def read_two_view(path: Path) -> TwoView:
    """The geometry in a file of this stage."""
    arrays = read_arrays(path)
    return TwoView(**{f.name: arrays[f.name] for f in fields(TwoView)})


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
    counts: dict[Pair, _Outcome] = {}
    for pair, file in files.items():
        if file.exists():
            counts[pair] = _outcome(file)
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
    enough = {p: counts[p] for p in files if p in counts and counts[p][0] >= options.min_inliers}
    return Matched(
        inliers={pair: count for pair, (count, _) in enough.items()},
        copies=frozenset(pair for pair, (_, copy) in enough.items() if copy),
        files=files,
        reused=reused,
        lost=tuple(o for o in outcomes if isinstance(o, Lost)),
    )


def pair_matches(a: Features, b: Features, options: MatchOptions) -> NDArray[np.uint32]:
    """Mutual matches of two photos, strongest features first: rows (m, 2) of a and b.

    The strongest tell whether two photos show the same at all, for a sixteenth of the time, and where in each
    photo the other's part of the scene is; only there the rest is matched.
    """
    count = options.first_features
    if max(len(a), len(b)) <= count:
        return mutual_matches(a.descriptors, b.descriptors, options)
    first = mutual_matches(a.descriptors[:count], b.descriptors[:count], options)
    if len(first) < options.least_first:
        return first[:0]
    in_a, in_b = _around(a, first[:, 0]), _around(b, first[:, 1])
    found = mutual_matches(a.descriptors[in_a], b.descriptors[in_b], options)
    return np.stack([in_a[found[:, 0]], in_b[found[:, 1]]], axis=1).astype(np.uint32)


def _around(photo: Features, rows: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Rows of the features in the box that the middle of these spans, made larger on each side."""
    low, high = np.quantile(photo.xy[rows], _OUTSIDE, axis=0)
    margin = _MARGIN * max(photo.width, photo.height)
    return np.flatnonzero(((photo.xy >= low - margin) & (photo.xy <= high + margin)).all(axis=1))


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


_Outcome = tuple[int, bool]
"""Number of verified matches of a pair, and whether its photos are copies."""


def _outcome(file: Path) -> _Outcome:
    """Of a pair that was matched already."""
    return len(read_array(file, "inliers")), bool(read_array(file, "copy"))


def _match_one(task: MatchTask) -> list[_Outcome]:
    """Match one photo with its others and write a file for each; what became of each pair."""
    use_threads(1)
    features = read_features(task.photo.features).features
    return [_match_pair(task, features, other, target) for other, target in task.others]


def _match_pair(task: MatchTask, a: Features, other: PhotoView, target: Path) -> _Outcome:
    if target.exists():  # a worker that died had come so far
        return _outcome(target)
    b = read_features(other.features).features
    options, sizes = task.options, ((a.width, a.height), (b.width, b.height))
    matches = pair_matches(a, b, options)
    matches = without_overlay(a.xy, b.xy, *sizes, matches)
    side = max(a.width, a.height, b.width, b.height)
    view = verify_pair(
        task.photo.camera,
        a.xy,
        other.camera,
        b.xy,
        matches,
        focal_known=task.photo.focal_known and other.focal_known,
        max_error_px=options.max_error_px * max(1.0, side / options.error_reference_side_px),
        seed=options.seed,
    )
    if view.is_watermark:
        view = replace(view, inliers=view.inliers[:0])
    pixels = a.xy[view.inliers[:, 0]], b.xy[view.inliers[:, 1]]
    copy = is_copy(pixels[0].astype(np.float64), pixels[1].astype(np.float64), *sizes)
    write_arrays(target, view.arrays() | {"copy": np.array(copy)})
    return len(view.inliers), copy


def _match_file(a: PhotoView, b: PhotoView, workspace: Workspace, options: MatchOptions) -> Path:
    """The pair's file: keyed by the photos, how features were made, the cameras and the options."""
    key = digest(options_fingerprint(options), a.features.parent.name, repr(a.camera), repr(b.camera))[:16]
    return workspace.matches(key, a.sha256, b.sha256)
