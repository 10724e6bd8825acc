"""Stage: which photos to match with which. The number of pairs grows linearly with that of photos.

Positions, times and looks each propose neighbours. None is a proof: positions may be wrong by kilometres and
cameras' clocks by hours, different places look alike. What two photos truly share, matching finds out, and
then photos that were matched with the same third one are tried (`more_pairs`).
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.index.descriptor_index import use_threads
from featuredb.index.nearest import most_similar
from featuredb.index.vocabulary import Vocabulary
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.photos.photo import Photo, gps_positions
from ingest.workspace import Workspace, read_array, write_arrays

Pair = tuple[int, int]
_Ranked = tuple[int, int, int]  # rank among the proposals of one photo, the photo, the other


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """How pairs are chosen.

    Attributes:
        exhaustive_max_photos: up to this many photos all pairs are matched. 24 photos have 276 pairs; the
            neighbourhoods below would choose about 24 * 12 of them anyway, and may miss one that matters.
        gps_neighbours: nearest photos by GPS, each photo. A block flight sees a point from some nine
            photos at 70 % overlap; twelve leaves room for GPS errors.
        gps_radius_m: no pair is chosen by GPS beyond this distance, and twice the deviation of the
            positions' difference; oblique photos still overlap there.
        precise_sigma_m: photos whose position is worse have their neighbours within that distance chosen by
            look, since the nearest by position are as good as any.
        time_neighbours: following photos of the same owner and camera by capture time, each photo; of
            keyframes those that follow in the film.
        look_neighbours: photos most similar by aggregated descriptor, each photo with a precise position:
            positions can be wrong. Most of them are GPS neighbours anyway.
        retrieval_neighbours: the same for photos without a precise position.
        other_shots: most similar keyframes of other shots and films, each keyframe: those of its own shot
            look most like it, and would be all that it is matched with.
        features_per_photo: strongest features that the aggregated descriptor is made of.
        pairs_per_photo: at most so many, best proposals first: a photo that everybody finds similar, a
            blank one for example, is matched with no more.
        more_neighbours: photos that overlap a photo's verified neighbours, tried afterwards.
    """

    exhaustive_max_photos: int = 24
    gps_neighbours: int = 12
    gps_radius_m: float = 300.0
    precise_sigma_m: float = 10.0
    time_neighbours: int = 2
    look_neighbours: int = 4
    retrieval_neighbours: int = 12
    other_shots: int = 8
    features_per_photo: int = 3000
    pairs_per_photo: int = 60
    more_neighbours: int = 6

    def needs_vectors(self, photos: int) -> bool:
        """Whether `choose_pairs` looks at aggregated descriptors."""
        return (
            photos > self.exhaustive_max_photos and max(self.look_neighbours, self.retrieval_neighbours) > 0
        )


def choose_pairs(
    photos: Sequence[Photo], vectors: NDArray[np.float16] | None, options: PairOptions
) -> list[Pair]:
    """Pairs (i, j), i < j, of rows of `photos`, sorted.

    Args:
        photos: usable photos.
        vectors: aggregated descriptor of each, (n, d) of unit length; None where they are not looked at.
    """
    if len(photos) <= options.exhaustive_max_photos:
        return list(itertools.combinations(range(len(photos)), 2))
    proposals = [*_time_pairs(photos, options), *_gps_pairs(photos, vectors, options)]
    if vectors is not None:
        proposals += [*_look_pairs(photos, vectors, options), *_shot_pairs(photos, vectors, options)]
    return _bounded(proposals, options.pairs_per_photo, ())


def more_pairs(
    photos: int, inliers: Mapping[Pair, int], tried: Iterable[Pair], options: PairOptions
) -> list[Pair]:
    """Pairs not tried yet of photos that overlap the same others, those with most in common first.

    Args:
        photos: number of photos.
        inliers: verified matches of the pairs that have enough.
    """
    if photos <= options.exhaustive_max_photos:
        return []
    neighbours: dict[int, list[tuple[int, int]]] = {}
    for (i, j), count in inliers.items():
        neighbours.setdefault(i, []).append((j, count))
        neighbours.setdefault(j, []).append((i, count))
    known = set(tried)
    proposals: list[_Ranked] = []
    for i, mine in sorted(neighbours.items()):
        common: Counter[int] = Counter()
        for j, to_j in mine:
            for k, from_j in neighbours[j]:
                if k != i and _ordered(i, k) not in known:
                    common[k] += min(to_j, from_j)
        best = sorted(common.items(), key=lambda item: (-item[1], item[0]))
        proposals += [(rank, i, k) for rank, (k, _) in enumerate(best[: options.more_neighbours])]
    return _bounded(proposals, options.pairs_per_photo, known)


def _bounded(proposals: Sequence[_Ranked], most: int, tried: Iterable[Pair]) -> list[Pair]:
    """Proposed pairs, best ranks first, as long as both photos have fewer than `most`."""
    degree = Counter(row for pair in tried for row in pair)
    chosen: set[Pair] = set()
    for _, i, j in sorted(proposals):
        pair = _ordered(i, j)
        if pair not in chosen and degree[i] < most and degree[j] < most:
            chosen.add(pair)
            degree[i] += 1
            degree[j] += 1
    return sorted(chosen)


def _gps_pairs(
    photos: Sequence[Photo], vectors: NDArray[np.float16] | None, options: PairOptions
) -> Iterator[_Ranked]:
    """Each photo with its nearest ones on the ground plan, or the most similar ones of those in reach."""
    rows = [i for i, photo in enumerate(photos) if photo.gps is not None]
    if len(rows) < 2:
        return
    plan = gps_positions([photos[i] for i in rows])[:, :2]
    sigmas = np.array([gps.sigma_horizontal_m for i in rows if (gps := photos[i].gps) is not None])
    tree = cKDTree(plan)
    count = min(options.gps_neighbours + 1, len(rows))
    distances, nearest = _nearest(tree, plan, count)
    for me, (found, near) in enumerate(zip(distances, nearest, strict=True)):
        if vectors is not None and sigmas[me] > options.precise_sigma_m:
            near = _alike_in_reach(me, rows, plan, sigmas, tree, vectors, options)
        else:
            reach = options.gps_radius_m + 2.0 * np.hypot(sigmas[me], sigmas[near])
            near = near[found <= reach]
        others = [int(k) for k in near if k != me]
        for rank, other in enumerate(others[: options.gps_neighbours]):
            yield rank, rows[me], rows[other]


# Photos in reach that are compared by look: in a crowd, the nearest of them.
_MOST_IN_REACH = 400


def _alike_in_reach(
    me: int,
    rows: Sequence[int],
    plan: FloatArray,
    sigmas: FloatArray,
    tree: cKDTree,
    vectors: NDArray[np.float16],
    options: PairOptions,
) -> NDArray[np.int64]:
    """Photos that may be in reach by their positions, most similar first; at most 400 are looked at."""
    distances, neighbours = _nearest(tree, plan[me : me + 1], min(_MOST_IN_REACH, len(plan)))
    near = neighbours[0]
    near = near[distances[0] <= options.gps_radius_m + 2.0 * np.hypot(sigmas[me], sigmas[near])]
    own = vectors[rows[me]].astype(np.float32)
    cosines = vectors[[rows[k] for k in near]].astype(np.float32) @ own
    return np.asarray(near[np.lexsort((near, -cosines))])


def _nearest(tree: cKDTree, points: FloatArray, k: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Distances and rows (n, k), k > 1, of the tree's nearest points."""
    distances, rows = tree.query(points, k=k)
    return np.asarray(distances, dtype=np.float64), np.asarray(rows, dtype=np.int64)


def _time_pairs(photos: Sequence[Photo], options: PairOptions) -> Iterator[_Ranked]:
    """Each photo with those that its owner's camera took next; keyframes are named in their order."""
    # Times with and without offset do not compare; the camera's own clock is what orders photos.
    timed = sorted(
        ((p.contributor, p.owner), p.film or p.camera_key, time.replace(tzinfo=None), p.name, i)
        for i, p in enumerate(photos)
        if (time := datetime.min if p.film else p.capture_time) is not None
    )
    for place, (owner, camera, *_, i) in enumerate(timed):
        for rank, (other, its, *_, j) in enumerate(timed[place + 1 : place + 1 + options.time_neighbours]):
            if (other, its) == (owner, camera):
                yield rank, i, j


def _look_pairs(
    photos: Sequence[Photo], vectors: NDArray[np.float16], options: PairOptions
) -> Iterator[_Ranked]:
    """Each photo with those whose aggregated descriptor is nearest, wherever they are."""
    for precise, count in ((True, options.look_neighbours), (False, options.retrieval_neighbours)):
        rows = [i for i, p in enumerate(photos) if _is_precise(p, options) == precise]
        found = most_similar(vectors, np.array(rows, dtype=np.int64), count)
        for i, near in zip(rows, found.tolist(), strict=True):
            for rank, j in enumerate(near):
                if j >= 0:
                    yield rank, i, j


def _shot_pairs(
    photos: Sequence[Photo], vectors: NDArray[np.float16], options: PairOptions
) -> Iterator[_Ranked]:
    """Each keyframe with those of other shots whose aggregated descriptor is nearest."""
    keyframes = np.array([i for i, p in enumerate(photos) if p.film], dtype=np.int64)
    shots: dict[tuple[str, str], list[int]] = {}
    for i in keyframes.tolist():
        shots.setdefault((photos[i].film, photos[i].camera_key), []).append(i)
    for mine in shots.values():
        others = np.setdiff1d(keyframes, mine)
        cosines = vectors[mine].astype(np.float32) @ vectors[others].astype(np.float32).T
        for i, row in zip(mine, cosines, strict=True):
            best = others[np.argsort(-row, kind="stable")[: options.other_shots]]
            yield from ((rank, i, j) for rank, j in enumerate(best.tolist()))


def _is_precise(photo: Photo, options: PairOptions) -> bool:
    return photo.gps is not None and photo.gps.sigma_horizontal_m <= options.precise_sigma_m


def _ordered(i: int, j: int) -> Pair:
    return (i, j) if i < j else (j, i)


_PER_TASK = 50  # photos; one takes some milliseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class _AggregateTask:
    """Some photos; travels to a worker."""

    vocabulary: Vocabulary
    files: tuple[tuple[Path, Path], ...]
    features_per_photo: int

    def __str__(self) -> str:
        return f"{len(self.files)} photos from {self.files[0][0].stem}"


def aggregate_photos(
    features: Sequence[Path],
    vocabulary: Vocabulary,
    features_per_photo: int,
    workspace: Workspace,
    executor: Executor,
    progress: Progress = no_progress,
) -> NDArray[np.float16]:
    """Vectors (n, vocabulary.size) of unit length of photos' features files; zeros for what is lost.

    Args:
        features_per_photo: strongest features that count.
    """
    key = f"{vocabulary.digest}-{features_per_photo}"
    targets = [workspace.aggregated(key, f.parent.name, f.stem) for f in features]
    todo = [(f, t) for f, t in zip(features, targets, strict=True) if not t.exists()]
    tasks = [
        _AggregateTask(
            vocabulary=vocabulary, files=tuple(todo[k : k + _PER_TASK]), features_per_photo=features_per_photo
        )
        for k in range(0, len(todo), _PER_TASK)
    ]
    outcomes = executor.map("aggregate", _aggregate, tasks, progress)
    lost = {t for o, task in zip(outcomes, tasks, strict=True) if isinstance(o, Lost) for _, t in task.files}
    vectors = np.zeros((len(features), vocabulary.size), np.float16)
    for row, target in enumerate(targets):
        if target not in lost or target.exists():
            vectors[row] = read_array(target, "vector")
    return vectors


def _aggregate(task: _AggregateTask) -> None:
    use_threads(1)
    for features, target in task.files:
        if not target.exists():
            strongest = read_array(features, "descriptors")[: task.features_per_photo]
            write_arrays(target, {"vector": task.vocabulary.aggregate(strongest).astype(np.float16)})
