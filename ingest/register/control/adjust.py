"""A block adjusted with control points as targets, in metres in the local frame."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.adjust.marginals import Whitened
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, Orientations, PointPriors, Targets, Terms, lens_prior, whole_lens
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3, point_jacobian
from ingest.colmap.adjust import AdjustOptions, block_variance_px2
from ingest.register.control.fit import Vertical
from ingest.register.control.marks import Control, on_ground

_LOOSE_M = 1e4  # of a coordinate that nobody surveyed
_LOOSE_RAD = 10.0  # of a heading
_NEAREST = 20  # points of the block, of which that of most photos carries the height
_LEAST_PX2 = 0.05**2  # of a variance: exact observations
_TOLERANCE = 1e-7  # of the cost, relative: a hundredth of what a tenth of a sigma in all coordinates is
_FOLLOW = (10, 1e-4)  # steps and relative cost: single points settle in three or four
# A block hangs on a few coordinates, a billionth of what holds its photos together.
_RADIUS = 1e9
# Around the lenses as the block has them, and so many observations count as one against them: as in the
# adjustment of photos whose EXIF tells the focal length.
_LENS = replace(AdjustOptions().lens, focal_rel=AdjustOptions().exif_focal_rel)
_DILUTION = AdjustOptions().dilution
_GROUND_SHARE = 0.01  # standard deviation of the ground's height under a single mark, over its distance
# Of the block's own points that take part, long tracks first, with the weight of all; the others follow the
# cameras afterwards.
_POINTS_PER_PHOTO = 150
_MAX_ITERATIONS = 50  # of one adjustment


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """Standard deviations, and what takes part.

    Attributes:
        mark_px: of a mark's pixel coordinate. control_m: (3,) of a surveyed coordinate.
        marks: (m,) bool: those that take part.
        points: (n,) bool: those whose surveyed coordinates take part; the others only tie photos together.
    """

    mark_px: float
    control_m: FloatArray
    marks: NDArray[np.bool_]
    points: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjusted:
    """An adjusted block, in metres in the local frame.

    Attributes:
        block: as it is now. change: the similarity nearest to what became of it.
        covariance: (7, 7) of its left perturbation.
        control_xyz: (n, 3) of the control points, NaN where no mark that took part shows them.
        spread: (n, 3, 3) their covariances.
        marks: of the marks that took part, in their order.
        survey: (n, 3) of the control points, found minus surveyed over sigma; 0 where nothing was surveyed.
        weights: of this adjustment.
    """

    block: Block
    change: Sim3
    covariance: FloatArray
    control_xyz: FloatArray
    spread: FloatArray
    marks: Whitened
    survey: Whitened
    weights: Weights


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """What all adjustments of a block have in common.

    Attributes:
        placed: the whole block; metres, in place but for small changes. Its ground holds points that one
            photo shows.
        block: those of its points that take part.
        control_xyz: (n, 3) where the control points lie in it.
        terms: what is known beside the control points.
    """

    placed: Block
    block: Block
    control: Control
    control_xyz: FloatArray
    terms: Terms


def task_of(
    placed: Block, control: Control, control_xyz: FloatArray, vertical: Vertical | None, keep_lens: bool
) -> Task:
    """For a block in metres in the local frame, in place but for small changes; `vertical` is in it, too."""
    chosen = _sample(placed, _POINTS_PER_PHOTO)
    variance_px2 = max(block_variance_px2(chosen), _LEAST_PX2)
    share = len(chosen.xy) / len(placed.xy)
    block = chosen if keep_lens else whole_lens(chosen)
    terms = Terms(
        keypoint_px=float(np.sqrt(variance_px2 * max(1.0, _DILUTION * share))),
        lenses=tuple(None if keep_lens else lens_prior(camera, _LENS) for camera in block.cameras),
        orientations=None if vertical is None else _upright(block, vertical),
        points=None if vertical is None else _anchor(block, vertical),
    )
    return Task(placed=placed, block=block, control=control, control_xyz=control_xyz, terms=terms)


def adjust(task: Task, weights: Weights) -> Adjusted:
    """Adjust a block."""
    control, start, count = task.control, task.block, len(task.block.xyz)
    targets = Targets(
        point_of=count + control.point_of[weights.marks],
        photo_of=control.photo_of[weights.marks],
        xy=control.xy[weights.marks],
        sigma_px=weights.mark_px,
        survey=_survey(task, weights),
    )
    whole = replace(start, xyz=np.concatenate([start.xyz, task.control_xyz]))
    problem = Problem(whole, replace(task.terms, targets=targets))
    problem.solve(_MAX_ITERATIONS, _TOLERANCE, _RADIUS)
    everything, found = problem.block(), problem.target_marginals()
    adjusted = replace(everything, xyz=everything.xyz[:count])
    by_poses = similarity_of_change(adjusted)
    poses = 6 * len(adjusted.names)
    located = np.isin(np.arange(len(control.names)), control.point_of[weights.marks])
    both = zip(adjusted.cam_from_block, start.cam_from_block, strict=True)
    changes = np.concatenate([(now @ old.inverse()).log() for now, old in both])
    return Adjusted(
        block=adjusted,
        change=Sim3.exp(similarity_of_change(start) @ changes),
        covariance=by_poses @ found.block.shared[:poses, :poses] @ by_poses.T,
        control_xyz=np.where(located[:, None], everything.xyz[count:], np.nan),
        spread=found.point,
        marks=found.marks,
        survey=found.survey,
        weights=weights,
    )


def with_all_points(adjusted: Adjusted, task: Task) -> Block:
    """All of the block: points that took no part follow the cameras."""
    start = replace(
        task.placed,
        cameras=adjusted.block.cameras,
        cam_from_block=adjusted.block.cam_from_block,
        xyz=adjusted.change.act(task.placed.xyz),
    )
    held = Terms(
        keypoint_px=task.terms.keypoint_px,
        lenses=(None,) * len(start.cameras),
        held_photos=tuple(range(len(start.names))),
    )
    problem = Problem(start, held)
    problem.solve(*_FOLLOW)
    return problem.block()


def _sample(block: Block, per_photo: int) -> Block:
    """The block with so many points of each photo only, those of its longest tracks."""
    lengths = np.bincount(block.point_of, minlength=len(block.xyz))
    kept = np.zeros(len(block.xyz), dtype=bool)
    order = np.argsort(-lengths[block.point_of], kind="stable")
    for photo in range(len(block.names)):
        mine = order[block.photo_of[order] == photo]
        kept[block.point_of[mine[:per_photo]]] = True
    kept &= lengths >= 2
    rows = kept[block.point_of]
    index = np.cumsum(kept) - 1
    return replace(
        block,
        xyz=block.xyz[kept],
        point_of=index[block.point_of[rows]],
        photo_of=block.photo_of[rows],
        xy=block.xy[rows],
    )


def _survey(task: Task, weights: Weights) -> PointPriors:
    """Surveyed coordinates of the points, else the ground's height, else next to nothing."""
    control = task.control
    expected, sigma = task.control_xyz.copy(), np.full(task.control_xyz.shape, _LOOSE_M)
    rows = np.flatnonzero(weights.marks)
    point_of = control.point_of[rows]
    for row in rows[np.bincount(point_of)[point_of] == 1].tolist():
        photo, point = int(control.photo_of[row]), int(control.point_of[row])
        ground = on_ground(task.placed, photo, control.xy[row])
        if ground is not None:
            expected[point, 2] = ground[2]
            distance_m = np.linalg.norm(ground - task.placed.cam_from_block[photo].center)
            sigma[point, 2] = _GROUND_SHARE * distance_m
    known = np.isfinite(control.surveyed) & weights.points[:, None]
    return PointPriors(
        point_of=len(task.block.xyz) + np.arange(len(expected)),
        xyz=np.where(known, control.surveyed, expected),
        covariance=np.where(known, weights.control_m, sigma)[:, :, None] ** 2 * np.eye(3),
    )


def _upright(start: Block, vertical: Vertical) -> Orientations:
    """The tilt of the whole block, shared out among its photos."""
    up = vertical.up_block
    axis = np.cross(up, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    upright = so3_exp(axis * (np.arctan2(length, up[2]) / length)) if length > 0 else np.eye(3)
    by_tilt = np.array([[0.0, -1.0], [1.0, 0.0]])  # the turn about east and north that tilts so
    covariance = np.diag([0.0, 0.0, _LOOSE_RAD**2])
    covariance[:2, :2] = len(start.names) * by_tilt @ vertical.tilt_covariance @ by_tilt.T
    return Orientations(
        photo_of=np.arange(len(start.names)),
        cam_from_block=np.array([pose.rotation @ upright.T for pose in start.cam_from_block]),
        covariance=np.tile(covariance, (len(start.names), 1, 1)),
    )


def _anchor(start: Block, vertical: Vertical) -> PointPriors:
    """The height of the block, at a point near to where it is known."""
    anchor = vertical.anchor_block
    seen = np.bincount(start.point_of, minlength=len(start.xyz))
    rows = np.flatnonzero(seen > 0)
    near = rows[cKDTree(start.xyz[rows]).query(anchor, k=min(_NEAREST, len(rows)))[1]]
    row = int(near[np.argmax(seen[near])])
    lift = np.array([0.0, 0.0, vertical.anchor_up_m - anchor[2]])
    return PointPriors(
        point_of=np.array([row]),
        xyz=(start.xyz[row] + lift)[None],
        covariance=np.diag([_LOOSE_M**2, _LOOSE_M**2, vertical.sigma_up_m**2])[None],
    )


def similarity_of_change(block: Block) -> FloatArray:
    """(7, 6 k): the best similarity of a change of poses, from what becomes of each centre and orientation.

    A turn counts by how far it moves what the camera looks at; so the similarity is well defined even where
    all cameras lie on a line.
    """
    k = len(block.names)
    wanted, given = np.zeros((6 * k, 7)), np.zeros((6 * k, 6 * k))
    for photo, (pose, distance) in enumerate(zip(block.cam_from_block, block.distances(), strict=True)):
        rows = slice(6 * photo, 6 * photo + 3)
        turns = slice(6 * photo + 3, 6 * photo + 6)
        # cam_from_local becomes exp(omega, nu) cam_from_local: centre and axes move by the inverse.
        wanted[rows] = point_jacobian(pose.center)
        given[rows, 6 * photo + 3 : 6 * photo + 6] = -pose.rotation.T
        wanted[turns, 1:4] = distance * np.eye(3)
        given[turns, 6 * photo : 6 * photo + 3] = -distance * pose.rotation.T
    return np.asarray(np.linalg.lstsq(wanted, given, rcond=None)[0])
