"""Stage: one vector for each photo by a vocabulary, on the executor, one file each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.index.descriptor_index import use_threads
from featuredb.index.vocabulary import Vocabulary
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.workspace import Workspace, read_array, write_arrays

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
            vocabulary=vocabulary,
            files=tuple(todo[k : k + _PER_TASK]),
            features_per_photo=features_per_photo,
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
