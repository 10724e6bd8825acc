"""Stage: structure from motion of clusters. Blocks are tasks, joining a cluster's blocks is one more."""

import logging
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.atomic import atomic_folder
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from ingest.clusters.graph import PhotoBlock, PhotoCluster
from ingest.clusters.join import JoinedModel, hangs_together, join
from ingest.colmap.adjust import adjust_posed
from ingest.colmap.bridge import Model, posed, read_model, read_models
from ingest.executor import Executor, Lost, Progress, no_progress
from ingest.fingerprint import digest
from ingest.sfm.mapper import (
    SfmOptions,
    SfmTask,
    SfmView,
    adjust_options,
    disjoint,
    loss_scale_px,
    reconstruct,
)
from ingest.sfm.pairs import Pair
from ingest.workspace import Workspace

_LOG = logging.getLogger(__name__)
# What numbers can do to a block, in COLMAP or here. A full disk is another thing: it ends the run.
_OF_THE_DATA = (ArithmeticError, LookupError, RuntimeError, ValueError)
_MOSTLY = 0.5  # of joined photos; right joints lose single ones


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFiles:
    """The reconstructions of one cluster, on disk.

    Attributes:
        folder: of numbered COLMAP models.
        rows: (n,) photos by the rows that the models name.
        min_photos: smaller models do not count.
    """

    folder: Path
    rows: tuple[int, ...]
    min_photos: int

    def load(self) -> list[Model]:
        """Models, largest first, whose `rows` are those of all photos. A photo is in one of them only."""
        rows = np.array(self.rows, dtype=np.int64)
        models = disjoint(read_models(self.folder), self.min_photos)
        return [replace(model, rows=rows[model.rows]) for model in models]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconstruction:
    """What the stage did.

    Attributes:
        clusters: one entry each cluster, largest cluster first.
        reused: blocks that were reconstructed already.
        blocks: all blocks.
        lost: photos by row whose block or cluster could not be reconstructed, with the reason.
    """

    clusters: tuple[ModelFiles, ...] = ()
    reused: int = 0
    blocks: int = 0
    lost: dict[int, str] = field(default_factory=dict)

    def models(self) -> Iterator[Model]:
        """All models, one cluster's in memory at a time."""
        for cluster in self.clusters:
            yield from cluster.load()


@dataclass(frozen=True, slots=True, kw_only=True)
class _BlockTask:
    """One block; travels to a worker."""

    sfm: SfmTask
    folder: Path

    def __str__(self) -> str:
        return str(self.sfm)


@dataclass(frozen=True, slots=True, kw_only=True)
class _JoinTask:
    """A cluster of several blocks; travels to a worker.

    Attributes:
        sfm: of all photos of the cluster.
        blocks: folder of each block's models.
        rows: of each block, into the views of `sfm`; what its models' rows count.
        own: of each block, those that are in no other block.
        folder: where the result goes.
    """

    sfm: SfmTask
    blocks: tuple[Path, ...]
    rows: tuple[tuple[int, ...], ...]
    own: tuple[frozenset[int], ...]
    folder: Path

    def __str__(self) -> str:
        return f"{len(self.blocks)} blocks, {self.sfm}"


def reconstruct_clusters(
    clusters: Sequence[PhotoCluster],
    cameras: Sequence[tuple[Camera, bool]],
    views: Sequence[SfmView],
    matches: Mapping[Pair, Path],
    workspace: Workspace,
    options: SfmOptions,
    executor: Executor,
    progress: Progress = no_progress,
) -> Reconstruction:
    """Reconstruct clusters, or find what an earlier run left of them.

    Args:
        cameras: with whether the focal length is known beforehand.
        views: all photos; clusters name their rows.
        matches: files of the verified pairs.
    """
    task_of = _task_maker(cameras, views, matches)
    whole = [task_of(c.rows, options) for c in clusters]
    rough = replace(options, adjust=replace(options.adjust, whole_lens=False))
    block_tasks: list[list[_BlockTask]] = []
    for cluster, task in zip(clusters, whole, strict=True):
        # Of several blocks the lens is for the whole cluster to tell.
        alone = len(cluster.blocks) == 1
        sfms = [task] if alone else [task_of(b.rows, rough) for b in cluster.blocks]
        block_tasks.append([_BlockTask(sfm=s, folder=workspace.models(s.key())) for s in sfms])

    todo = [t for tasks in block_tasks for t in tasks if not t.folder.is_dir()]
    todo.sort(key=lambda t: -len(t.sfm.views))  # the longest first, so that no worker is late with it
    outcomes = executor.map("reconstruct", _reconstructed, todo, progress)
    failed = {t.folder: o.reason for t, o in zip(todo, outcomes, strict=True) if isinstance(o, Lost)}

    joins = [
        _join_task(cluster, task, tasks, failed, workspace)
        for cluster, task, tasks in zip(clusters, whole, block_tasks, strict=True)
        if len(cluster.blocks) > 1
    ]
    waiting = [j for j in joins if not j.folder.is_dir()]
    joined = executor.map("join", _reconstructed, waiting, progress)
    failed |= {t.folder: o.reason for t, o in zip(waiting, joined, strict=True) if isinstance(o, Lost)}
    reused = sum(map(len, block_tasks)) - len(todo)
    return _collected(clusters, block_tasks, joins, failed, options, reused)


def _collected(
    clusters: Sequence[PhotoCluster],
    block_tasks: Sequence[Sequence[_BlockTask]],
    joins: Sequence[_JoinTask],
    failed: Mapping[Path, str],
    options: SfmOptions,
    reused: int,
) -> Reconstruction:
    """Where each cluster's models are, and what is lost."""
    results: list[ModelFiles] = []
    lost: dict[int, str] = {}
    joined = iter(joins)
    for cluster, tasks in zip(clusters, block_tasks, strict=True):
        for block, task in zip(cluster.blocks, tasks, strict=True):
            if task.folder in failed:
                lost |= dict.fromkeys(block.own, failed[task.folder])
        folder = next(joined).folder if len(cluster.blocks) > 1 else tasks[0].folder
        if folder in failed:
            lost |= dict.fromkeys(cluster.rows, failed[folder])
        else:
            results.append(ModelFiles(folder=folder, rows=cluster.rows, min_photos=options.min_model_photos))
    return Reconstruction(
        clusters=tuple(results), reused=reused, blocks=sum(map(len, block_tasks)), lost=lost
    )


def _task_maker(
    cameras: Sequence[tuple[Camera, bool]], views: Sequence[SfmView], matches: Mapping[Pair, Path]
) -> Callable[[Sequence[int], SfmOptions], SfmTask]:
    """Makes the task of the photos of some rows, which rise, with their cameras and pairs numbered anew."""
    of_photo: dict[int, list[tuple[int, Path]]] = {}
    for (i, j), file in sorted(matches.items()):
        of_photo.setdefault(i, []).append((j, file))

    def make(rows: Sequence[int], options: SfmOptions) -> SfmTask:
        used = sorted({views[row].camera_row for row in rows})
        place = {row: k for k, row in enumerate(rows)}
        return SfmTask(
            cameras=tuple(cameras[c] for c in used),
            views=tuple(replace(views[row], camera_row=used.index(views[row].camera_row)) for row in rows),
            matches=tuple(
                (place[i], place[j], file) for i in rows for j, file in of_photo.get(i, ()) if j in place
            ),
            options=options,
        )

    return make


def _join_task(
    cluster: PhotoCluster,
    sfm: SfmTask,
    tasks: Sequence[_BlockTask],
    failed: Mapping[Path, str],
    workspace: Workspace,
) -> _JoinTask:
    place = {row: k for k, row in enumerate(cluster.rows)}

    def rows(of: Sequence[int]) -> tuple[int, ...]:
        return tuple(place[row] for row in of)

    good: list[tuple[PhotoBlock, _BlockTask]] = [
        (b, t) for b, t in zip(cluster.blocks, tasks, strict=True) if t.folder not in failed
    ]
    key = digest(sfm.key(), *(t.folder.name for _, t in good))[:24]
    return _JoinTask(
        sfm=sfm,
        blocks=tuple(t.folder for _, t in good),
        rows=tuple(rows(b.rows) for b, _ in good),
        own=tuple(frozenset(rows(b.own)) for b, _ in good),
        folder=workspace.models(key),
    )


def _reconstructed(task: _BlockTask | _JoinTask) -> Lost | None:
    """What goes wrong with one block or cluster costs that one."""
    try:
        if isinstance(task, _JoinTask):
            _join(task)
        else:
            reconstruct(task.sfm, task.folder)
    except _OF_THE_DATA as error:
        _LOG.error("%s: not reconstructed", task, exc_info=error)
        text = f"reconstruction failed with {type(error).__name__}: {error}; the next run tries it again"
        return Lost(task=str(task), reason=text)
    return None


def _join(task: _JoinTask) -> None:
    """Join the models of a cluster's blocks and adjust each of what comes of it.

    Where joined models have no points in common once these are triangulated from all matches, or most of the
    photos no longer fit theirs, the joint was wrong (look-alikes): each model is adjusted by itself.
    """
    if task.folder.is_dir():
        return
    models, own = _block_models(task)
    with (
        atomic_folder(task.folder) as output,
        tempfile.TemporaryDirectory(prefix="featuredb-join-") as scratch,
    ):
        if not models:
            return
        database = Path(scratch) / "colmap.db"
        photos = task.sfm.write_database(database)
        taken: set[int] = set()
        groups = deque(join(models))
        number = 0
        while groups:
            group = groups.popleft()
            poses = {r: p for r, p in _poses(group, models, own).items() if r not in taken}
            if len(poses) < task.sfm.options.min_model_photos:
                continue
            folder = output / str(number)
            folder.mkdir()
            number += 1
            posed(_cameras(group, models, task.sfm), photos, poses).write(str(folder))
            kept = adjust_posed(
                folder,
                database,
                task.sfm.known(photos),
                loss_scale_px(task.sfm),
                adjust_options(task.sfm.options),
            )
            if len(group) > 1 and (
                len(kept) < _MOSTLY * len(poses)
                or not hangs_together(read_model(folder), [models[m].rows.tolist() for m in group])
            ):
                _LOG.info("%s: the joint of %d photos does not hold; apart again", task, len(poses))
                shutil.rmtree(folder, ignore_errors=True)
                groups.extendleft({m: Sim3.identity()} for m in reversed(group))
                continue
            taken |= {int(row) for row in kept}


def _block_models(task: _JoinTask) -> tuple[list[Model], list[frozenset[int]]]:
    """All models of all blocks with the cluster's rows, and the block's own rows beside each."""
    models, own = [], []
    for folder, rows, mine in zip(task.blocks, task.rows, task.own, strict=True):
        number: NDArray[np.int64] = np.array(rows, dtype=np.int64)
        for model in disjoint(read_models(folder), task.sfm.options.min_model_photos):
            models.append(replace(model, rows=number[model.rows]))
            own.append(mine)
    return models, own


def _poses(group: JoinedModel, models: Sequence[Model], own: Sequence[frozenset[int]]) -> dict[int, Rigid3]:
    """Pose of every photo of the group: of the block whose own it is, where that has registered it."""
    poses: dict[int, Rigid3] = {}
    for mine in (True, False):
        for member, sim in group.items():
            for row, pose in zip(models[member].rows.tolist(), models[member].cam_from_sfm, strict=True):
                if row not in poses and (row in own[member]) == mine:
                    poses[row] = sim.act_on_pose(pose)
    return dict(sorted(poses.items()))


def _cameras(group: JoinedModel, models: Sequence[Model], sfm: SfmTask) -> list[Camera]:
    """Cameras of the cluster, each as the member with most of its photos has it."""
    cameras = [camera for camera, _ in sfm.cameras]
    most = [0] * len(cameras)
    for member in group:
        model = models[member]
        counts = np.bincount(model.camera_of, minlength=len(model.cameras))
        for row, index in zip(model.rows.tolist(), model.camera_of.tolist(), strict=True):
            camera_row = sfm.views[row].camera_row
            if counts[index] > most[camera_row]:
                most[camera_row] = int(counts[index])
                cameras[camera_row] = model.cameras[index]
    return cameras
