"""Models that share photos, brought into one frame; those that disagree stay apart.

A photo that two models have registered gives its two poses, and its keypoints that both have triangulated
give pairs of 3D points. The similarity comes from the points, robustly; the poses, which it does not know,
confirm it. Models are then joined by strongest joints first, and a joint that contradicts those that hold
already breaks the weakest of them.
"""

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from ingest.colmap.bridge import Model
from ingest.register.structure.similarity import ransac_similarity
from ingest.sfm.links import tied_parts

_LOG = logging.getLogger(__name__)
_KEYPOINTS = 1 << 32  # more than any photo has
_MIN_PHOTOS = 3  # that agree; one photo may be wrong in one of the models
_MIN_SHARE = 0.5  # of the shared photos that agree
_MIN_POINTS = 30  # that both models have and that fit the similarity
# Of a pair of points, over the distance to the camera: what two adjustments of the same points differ by at a
# few percent of uncertain depth.
_MAX_ERROR_OVER_DEPTH = 0.03
_MAX_ROTATION_DEG = 2.0  # between a photo's two orientations
_MAX_CENTER_OVER_DEPTH = 0.05  # between a photo's two centres, over the distance to its points


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """Two models that agree in what they share.

    Attributes:
        first, second: which models.
        first_from_second: the similarity.
        points: pairs of points that fit it; the joint's strength.
    """

    first: int
    second: int
    first_from_second: Sim3
    points: int


JoinedModel = dict[int, Sim3]
"""Models that are one, largest first: of each member the similarity into the frame of the first."""


def join(models: Sequence[Model]) -> list[JoinedModel]:
    """Groups of models that agree, largest model first. `rows` of all models number the same photos."""
    joints = []
    for a, b in itertools.combinations(range(len(models)), 2):
        shared = np.intersect1d(models[a].rows, models[b].rows)
        if len(shared) >= _MIN_PHOTOS:
            joint = find_joint(models, a, b, shared)
            if joint is not None:
                joints.append(joint)
    held = _consistent(joints, models)
    return _groups(held, models)


def find_joint(models: Sequence[Model], first: int, second: int, shared: NDArray[np.int64]) -> Joint | None:
    """The similarity between two models by the photos they share, or None where they do not agree."""
    a, b = models[first], models[second]
    point_a, point_b, depth = common_points(a, b)
    if len(point_a) < _MIN_POINTS:
        return None
    target, source = a.xyz[point_a], b.xyz[point_b]
    tolerance = _MAX_ERROR_OVER_DEPTH * depth
    sim = _robust_similarity(source, target, tolerance)
    if sim is None:
        return None
    inliers = int((np.linalg.norm(target - sim.act(source), axis=1) <= tolerance).sum())
    agreeing = _agreeing(a, b, shared, sim, float(np.median(depth)))
    good = inliers >= _MIN_POINTS and agreeing >= _MIN_PHOTOS and agreeing >= _MIN_SHARE * len(shared)
    if not good:
        _LOG.info("models %d and %d: %d of %d shared photos agree", first, second, agreeing, len(shared))
        return None
    return Joint(first=first, second=second, first_from_second=sim, points=inliers)


def common_points(a: Model, b: Model) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Rows of points of both models that share a keypoint, each pair once, and the distance (n,) to the
    camera of `a` that saw it."""
    key_a = a.rows[a.photo_of] * _KEYPOINTS + a.keypoint_of
    key_b = b.rows[b.photo_of] * _KEYPOINTS + b.keypoint_of
    _, in_a, in_b = np.intersect1d(key_a, key_b, assume_unique=True, return_indices=True)
    pairs = np.stack([a.point_of[in_a], b.point_of[in_b]], axis=1)
    pairs, first = np.unique(pairs, axis=0, return_index=True)
    cameras = a.centers()[a.photo_of[in_a[first]]] if len(pairs) else np.zeros((0, 3))
    depth = np.linalg.norm(a.xyz[pairs[:, 0]] - cameras, axis=1)
    return pairs[:, 0], pairs[:, 1], depth


def _robust_similarity(source: FloatArray, target: FloatArray, tolerance: FloatArray) -> Sim3 | None:
    """RANSAC over three pairs, then least squares over the inliers until they settle."""
    best = ransac_similarity(source, target, tolerance)
    for _ in range(5):
        if best is None:
            return None
        inliers = np.linalg.norm(target - best.act(source), axis=1) <= tolerance
        best = similarity_closed_form(source[inliers], target[inliers]) if inliers.sum() >= 3 else None
    return best


def _agreeing(a: Model, b: Model, shared: NDArray[np.int64], sim: Sim3, depth: float) -> int:
    """How many shared photos have the same pose in both models."""
    count = 0
    for row in shared:
        pose_a = a.cam_from_sfm[int(np.searchsorted(a.rows, row))]
        pose_b = sim.act_on_pose(b.cam_from_sfm[int(np.searchsorted(b.rows, row))])
        apart = float(np.linalg.norm(pose_a.center - pose_b.center))
        count += pose_a.angle_to_deg(pose_b) <= _MAX_ROTATION_DEG and apart <= _MAX_CENTER_OVER_DEPTH * depth
    return count


def _consistent(joints: Sequence[Joint], models: Sequence[Model]) -> list[Joint]:
    """A forest of joints, strongest first; where another joint contradicts it, its weakest one on the way
    between the two models goes."""
    tree: list[Joint] = []
    for joint in sorted(joints, key=lambda j: (-j.points, j.first, j.second)):
        way = _way(tree, joint.first, joint.second)
        if way is None:
            tree.append(joint)
            continue
        through = _along(way, joint.first)
        if not _same(joint.first_from_second, through, models[joint.second]):
            weakest = min(way, key=lambda j: j.points)
            _LOG.warning(
                "models %d and %d are apart by their own photos from where others put them: the joint of "
                "%d and %d is broken",
                joint.first, joint.second, weakest.first, weakest.second,
            )  # fmt: skip
            tree.remove(weakest)
    return tree


def _same(one: Sim3, other: Sim3, model: Model) -> bool:
    """Whether two similarities put the model's cameras at the same place, within what joints allow.

    Errors add up along the way, hence three times what one joint may have.
    """
    poses = model.cam_from_sfm[:: max(1, len(model.cam_from_sfm) // 20)]
    depth = one.scale * float(np.median(model.distances()))
    apart = [np.linalg.norm(one.act_on_pose(p).center - other.act_on_pose(p).center) / depth for p in poses]
    angle = one.act_on_pose(poses[0]).angle_to_deg(other.act_on_pose(poses[0]))
    return angle <= 3 * _MAX_ROTATION_DEG and float(np.median(apart)) <= 3 * _MAX_CENTER_OVER_DEPTH


def _way(tree: Sequence[Joint], start: int, end: int) -> list[Joint] | None:
    """Joints from one model to another, or None."""
    ways: dict[int, list[Joint]] = {start: []}
    queue = [start]
    for model in queue:
        for joint in tree:
            for here, there in ((joint.first, joint.second), (joint.second, joint.first)):
                if here == model and there not in ways:
                    ways[there] = [*ways[model], joint]
                    queue.append(there)
    return ways.get(end)


def _along(way: Sequence[Joint], start: int) -> Sim3:
    """Similarity from the last model of the way into the first."""
    here, total = start, Sim3.identity()
    for joint in way:
        forward = joint.first == here
        total = total @ (joint.first_from_second if forward else joint.first_from_second.inverse())
        here = joint.second if forward else joint.first
    return total


def _groups(tree: Sequence[Joint], models: Sequence[Model]) -> list[JoinedModel]:
    """What the joints connect, largest group first."""
    left = sorted(range(len(models)), key=lambda k: (-len(models[k].rows), k))
    groups = []
    while left:
        root = left[0]
        ways = {k: way for k in left if (way := _way(tree, root, k)) is not None}
        groups.append({k: _along(way, root) for k, way in ways.items()})
        left = [k for k in left if k not in ways]
    return sorted(groups, key=lambda g: -sum(len(models[k].rows) for k in g))


def hangs_together(model: Model, parts: Sequence[Sequence[int]]) -> bool:
    """Whether chains of photos with enough points in common tie most photos of each part to one whole.

    Args:
        model: of all of them. parts: rows of the models that were joined; others do not count.
    """
    whole = np.isin(model.rows, tied_parts(model, _MIN_POINTS)[0])
    return all(float(whole[here].mean()) > 0.5 for part in parts if (here := np.isin(model.rows, part)).any())
