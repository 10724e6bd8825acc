"""Stage: matches of each pair of photos, verified by two-view geometry, one file a pair."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from featuredb.features.features import Features
from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import TwoView
from ingest.executor import Executor, Lost, Progress
from ingest.fingerprint import digest, options_fingerprint
from ingest.sfm.extract import read_features
from ingest.sfm.overlays import is_copy
from ingest.sfm.pair_geometry import MatchOptions, pair_geometry
from ingest.sfm.pairs import Pair
from ingest.workspace import Workspace, read_array, read_arrays, write_arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoView:
    """What matching needs of a photo: its name, digest, features file and camera as EXIF has it."""

    name: str
    sha256: str
    features: Path
    camera: Camera
    focal_known: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchTask:
    """One photo with some others; travels to a worker.

    Attributes:
        photo: whose features are read once.
        others: the photos that it is matched with, and the file of each pair.
    """

    photo: PhotoView
    others: tuple[tuple[PhotoView, Path], ...]
    options: MatchOptions

    def __str__(self) -> str:
        return f"{self.photo.name} with {len(self.others)} others"


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

    def without(self, rows: Set[int] = frozenset(), pairs: Set[Pair] = frozenset()) -> "Matched":
        """Without the verified pairs of some photos, and without some pairs."""
        kept = {p: n for p, n in self.inliers.items() if p not in pairs and rows.isdisjoint(p)}
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
    progress: Progress,
) -> Matched:
    """Match and verify every pair that is not done yet."""
    files = {pair: _match_file(views[pair[0]], views[pair[1]], workspace, options) for pair in pairs}
    todo: dict[int, list[Pair]] = {}
    counts: dict[Pair, _Outcome] = {}
    for pair, file in files.items():
        if file.exists():
            counts[pair] = _outcome(file)
        else:
            todo.setdefault(pair[0], []).append(pair)
    tasks = [
        MatchTask(photo=views[i], others=tuple((views[j], files[i, j]) for _, j in own), options=options)
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


_Outcome = tuple[int, bool]
"""Number of verified matches of a pair, and whether its photos are copies."""


def _outcome(file: Path) -> _Outcome:
    """Of a pair that was matched already."""
    return len(read_array(file, "inliers")), bool(read_array(file, "copy"))


def _match_one(task: MatchTask) -> list[_Outcome]:
    """Match one photo with its others and write a file for each; what became of each pair."""
    with threadpool_limits(1):  # several wait for each other, and the products are small
        features = read_features(task.photo.features).features
        return [_match_pair(task, features, other, target) for other, target in task.others]


def _match_pair(task: MatchTask, a: Features, other: PhotoView, target: Path) -> _Outcome:
    if target.exists():  # a worker that died had come so far
        return _outcome(target)
    b = read_features(other.features).features
    sizes = (a.width, a.height), (b.width, b.height)
    focal_known = task.photo.focal_known and other.focal_known
    view = pair_geometry(a, b, (task.photo.camera, other.camera), focal_known, task.options)
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
