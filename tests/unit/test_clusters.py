"""Cutting the graph of verified pairs, and joining the models of its pieces."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from ingest.clusters.graph import ClusterOptions, Graph, PhotoBlock, PhotoCluster, find_clusters
from ingest.clusters.join import common_points, hangs_together, join
from ingest.clusters.reconstruct import Reconstruction, reconstruct_clusters
from ingest.colmap.bridge import Model
from ingest.executor import InProcessExecutor
from ingest.sfm.mapper import SfmOptions, SfmTask, SfmView
from ingest.sfm.pairs import Pair
from ingest.workspace import Workspace
from tests.support.planar_map import CAMERA
from tests.support.posed_models import model_of


def _grid(columns: int, rows: int, start: int = 0) -> dict[Pair, int]:
    """Photos on a grid, each matched with its eight neighbours."""
    pairs = {}
    for k in range(columns * rows):
        x, y = k % columns, k // columns
        for dx, dy, count in ((1, 0, 300), (0, 1, 200), (1, 1, 80), (-1, 1, 80)):
            if 0 <= x + dx < columns and y + dy < rows:
                i, j = start + k, start + k + dx + columns * dy
                pairs[min(i, j), max(i, j)] = count
    return pairs


def test_towns_are_clusters_of_their_own_and_loners_are_in_none() -> None:
    pairs = _grid(5, 4) | _grid(6, 4, start=20) | {(44, 45): 50}
    clusters = find_clusters(50, pairs, 3, ClusterOptions())
    assert [c.rows for c in clusters] == [tuple(range(20, 44)), tuple(range(20))]
    assert all(len(c.blocks) == 1 for c in clusters)


def test_a_large_cluster_is_cut_into_blocks_with_seams() -> None:
    options = ClusterOptions(max_block_photos=60, max_map_photos=1000)
    (cluster,) = find_clusters(400, _grid(20, 20), 3, options)
    own = [row for block in cluster.blocks for row in block.own]
    assert sorted(own) == list(range(400))  # each photo is one block's own
    sizes = [len(block.own) for block in cluster.blocks]
    assert max(sizes) <= 60
    assert min(sizes) >= 20
    graph = Graph.of(400, _grid(20, 20))
    for block in cluster.blocks:
        assert 12 <= len(block.shared) <= 0.2 * 60
        assert not set(block.own) & set(block.shared)
        assert len(graph.components(np.array(block.own))) == 1  # none is in pieces
        # Compact: a square of s photos has a border of 4 sqrt(s), a strip of one row has 2 s.
        inside = sum(i in set(block.own) and j in set(block.own) for i, j in _grid(20, 20))
        assert inside > 2.5 * len(block.own)


def test_what_is_too_large_for_a_map_becomes_several() -> None:
    clusters = find_clusters(900, _grid(30, 30), 3, ClusterOptions(max_block_photos=60, max_map_photos=250))
    assert sorted(row for c in clusters for row in c.rows) == list(range(900))
    assert max(len(c.rows) for c in clusters) <= 250


def test_blocks_per_photo_do_not_depend_on_the_number_of_photos() -> None:
    per_photo = []
    for side in (20, 40, 70):
        clusters = find_clusters(side * side, _grid(side, side), 3, ClusterOptions())
        blocks = [b for c in clusters for b in c.blocks]
        per_photo.append(sum(len(b.rows) for b in blocks) / side**2)
        assert max(len(b.rows) for b in blocks) <= 1.2 * 150
    assert max(per_photo) / min(per_photo) < 1.15


def test_a_star_is_cut_too() -> None:
    star = {(0, k): 30 for k in range(1, 400)}
    clusters = find_clusters(400, star, 3, ClusterOptions(max_block_photos=60, max_map_photos=100))
    assert [len(c.rows) for c in clusters] == [100]  # without its middle the rest hangs on nothing


_POINTS = np.random.default_rng(1).uniform([-40, -40, -3], [40, 40, 3], (1500, 3))


def _model(columns: Sequence[int], local_from_sfm: Sim3, noise_m: float = 0.0, seed: int = 0) -> Model:
    """Photos in columns of a grid 40 m over the points, in a frame of its own; row = 10 column + line."""
    rng = np.random.default_rng(seed)
    sfm_from_local = local_from_sfm.inverse()
    rows, poses, seen = [], [], []
    for column in columns:
        for line in range(5):
            center = np.array([10.0 * column - 30.0, 12.0 * line - 24.0, 40.0])
            pose = Rigid3(
                rotation=np.diag([1.0, -1.0, -1.0]), translation=-np.diag([1.0, -1.0, -1.0]) @ center
            )
            pixels = CAMERA.project(pose.act(_POINTS))
            inside = ((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
            rows.append(10 * column + line)
            poses.append(sfm_from_local.act_on_pose(pose))
            seen.append(np.flatnonzero(inside))
    used = np.unique(np.concatenate(seen))
    point_of = np.concatenate([np.searchsorted(used, s) for s in seen])
    photo_of = np.repeat(np.arange(len(rows)), [len(s) for s in seen])
    keypoint_of = np.concatenate(seen)  # each photo has a keypoint for each point
    order = np.lexsort((photo_of, point_of))
    return Model(
        cameras=(CAMERA,),
        rows=np.array(rows, dtype=np.int64),
        camera_of=np.zeros(len(rows), np.int64),
        cam_from_sfm=tuple(poses),
        xyz=sfm_from_local.act(_POINTS[used] + rng.normal(0, noise_m, (len(used), 3))),
        point_of=point_of[order],
        photo_of=photo_of[order],
        keypoint_of=keypoint_of[order],
    )


def _sim(seed: int) -> Sim3:
    return Sim3.exp(np.random.default_rng(seed).normal(0, [0.3] + [0.5] * 3 + [20.0] * 3))


def _assert_in_place(
    models: Sequence[Model], sims: Sequence[Sim3], members: NDArray[np.int64], found: Sequence[Sim3]
) -> None:
    for member, first_from in zip(members, found, strict=True):
        # local_from_first @ first_from_member must be local_from_member
        whole = sims[members[0]] @ first_from
        for pose in models[member].cam_from_sfm:
            apart = whole.act_on_pose(pose).center - sims[member].act_on_pose(pose).center
            assert np.linalg.norm(apart) < 0.05


def test_models_that_share_photos_are_joined() -> None:
    sims = [_sim(k) for k in range(3)]
    columns = [(0, 1, 2, 3), (3, 4, 5), (5, 6)]
    models = [_model(c, s, 0.02, seed=k) for k, (c, s) in enumerate(zip(columns, sims, strict=True))]
    (joined,) = join(models)
    assert next(iter(joined)) == 0
    assert sorted(joined) == [0, 1, 2]
    _assert_in_place(models, sims, np.array(list(joined)), list(joined.values()))


def test_models_that_share_nothing_stay_apart() -> None:
    models = [_model((0, 1, 2), _sim(0)), _model((4, 5), _sim(1))]
    assert [tuple(j) for j in join(models)] == [(0,), (1,)]


@pytest.mark.parametrize("wrong", ["bent", "points", "poses"])
def test_models_that_disagree_are_not_joined(wrong: str) -> None:
    one, other = _model((0, 1, 2, 3), _sim(0)), _model((3, 4, 5), _sim(1))
    if wrong == "bent":  # another scale along one axis: no similarity fits
        other = replace(other, xyz=other.xyz @ np.diag([1.0, 1.3, 1.0]))
    elif wrong == "points":  # keypoints of the shared photos are points elsewhere
        order = np.random.default_rng(0).permutation(len(other.xyz))
        other = replace(other, xyz=other.xyz[order])
    else:  # the points agree, the photos' poses do not
        turn = Rigid3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
        other = replace(other, cam_from_sfm=tuple(turn @ p for p in other.cam_from_sfm))
    assert len(common_points(one, other)[0]) > 100  # they share plenty
    assert [tuple(j) for j in join([one, other])] == [(0,), (1,)]


def test_a_joint_that_contradicts_the_others_breaks_the_weakest() -> None:
    """Models 0-1-2 hang together; 2 shares look-alike photos with 0 that put it elsewhere."""
    sims = [_sim(k) for k in range(3)]
    models = [
        _model((0, 1, 2, 3), sims[0]), _model((3, 4, 5), sims[1]), _model((5, 6), sims[2])
    ]  # fmt: skip
    # A copy of column 0 as seen by model 2, five columns off: same keypoints, another place.
    shift = Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([55.0, 0.0, 0.0]))
    false = _model((0,), Sim3.identity())
    moved = sims[2].inverse() @ shift
    count = len(models[2].rows)
    two = models[2]
    models[2] = replace(
        two,
        rows=np.concatenate([false.rows, two.rows]),
        camera_of=np.zeros(count + 5, np.int64),
        cam_from_sfm=tuple(moved.act_on_pose(p) for p in false.cam_from_sfm) + two.cam_from_sfm,
        xyz=np.concatenate([moved.act(false.xyz), two.xyz]),
        point_of=np.concatenate([false.point_of, two.point_of + len(false.xyz)]),
        photo_of=np.concatenate([false.photo_of, two.photo_of + 5]),
        keypoint_of=np.concatenate([false.keypoint_of, two.keypoint_of]),
    )
    groups = join(models)
    # Two of the three joints hold, or fewer: never all three models in one frame by contradicting joints.
    assert len(groups) == 2


def test_joined_models_hang_together_by_points_in_common() -> None:
    first, second = range(100), range(1000, 1100)
    apart = model_of(first, first, second, second)
    assert not hangs_together(apart, [[0, 1], [2, 3]])
    tied = model_of(first, range(60, 130), range(90, 1050), second)
    assert hangs_together(tied, [[0, 1], [2, 3]])
    weak = model_of(first, range(60, 130), range(105, 1050), second)
    assert not hangs_together(weak, [[0, 1], [2, 3]])
    # A single photo that is hardly tied does not make a joint wrong.
    loose = model_of(first, first, first, first, range(95, 105))
    assert hangs_together(loose, [[0, 1], [2, 3, 4]])


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("Singular matrix"), RuntimeError("[sfm.cc:1] Check")]
)
def test_a_block_that_fails_costs_its_photos_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fails_in_a_town(task: SfmTask, folder: Path) -> None:
        if task.views[0].name == "a":
            raise error
        folder.mkdir(parents=True)

    monkeypatch.setattr("ingest.clusters.reconstruct.reconstruct", fails_in_a_town)
    done = _two_towns(tmp_path)
    assert list(done.lost) == [0, 1]
    assert all(str(error) in reason for reason in done.lost.values())
    assert [c.rows for c in done.clusters] == [(2, 3)]


def test_a_full_disk_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(task: SfmTask, folder: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ingest.clusters.reconstruct.reconstruct", full)
    with pytest.raises(OSError, match="No space left"):
        _two_towns(tmp_path)


def _two_towns(work: Path) -> Reconstruction:
    """Two clusters of two photos each."""
    clusters = [PhotoCluster(blocks=(PhotoBlock(own=rows),)) for rows in ((0, 1), (2, 3))]
    views = [SfmView(name=name, camera_row=0, features=work / "features" / name) for name in "abcd"]
    return reconstruct_clusters(
        clusters,
        [(CAMERA, True)],
        views,
        {},
        Workspace(root=work),
        SfmOptions(),
        InProcessExecutor(),
    )
