"""Bundle adjustment of a block with control points (Triggs et al., 2000; sections 4 and 6).

Unknowns: poses, lenses that enough photos share, control points, and a sample of the block's own points,
which are eliminated (Schur complement). Observations: keypoints (Cauchy loss), marks, surveyed coordinates,
and what is known of the vertical where heights are not. Surveyed coordinates are taken as distributed by
Student's t with four degrees of freedom: a file does not tell how good they are, and satellite positions
have long tails (Lange, Little and Taylor, Robust statistical modeling using the t distribution, 1989). Marks
keep a quadratic loss: wrong ones are found by tests and left out (`ingest.register.control.snooping`).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian
from ingest.register.control.fit import Vertical
from ingest.register.control.marks import Control
from ingest.register.control.normal_system import (
    Problem,
    State,
    Weights,
    common_change,
    cost_of,
    linear_of,
    mark_equations,
    moved,
    solve,
    system_of,
    trust_of,
)

# Damping over the diagonal of the normal matrix. The block as a whole hangs on a few coordinates, a billionth
# of what holds its photos together, so that any damping would keep it where it is: none to begin with.
_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e4


def _less(damping: float) -> float:
    return 0.0 if damping <= 10.0 * _MIN_DAMPING else damping / 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustOptions:
    """How the block is adjusted.

    Attributes:
        points_per_photo: of the block's own points that take part, long tracks first; the others follow
            the cameras afterwards. With 150 of a photo, a block is held as firmly as with all of them.
        min_photos_of_camera: lenses of fewer photos are kept as they are.
        keep_lens: keep all lenses.
        max_iterations: of one adjustment.
        tolerance: of the cost, a sum of squares over variances; a smaller step is far below one sigma.
    """

    points_per_photo: int = 150
    min_photos_of_camera: int = 8
    keep_lens: bool = False
    max_iterations: int = 15
    tolerance: float = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjusted:
    """An adjusted block, in metres in the local frame.

    Attributes:
        block: with all its points.
        control_xyz: (n, 3) of the control points; those that took no part lie where their marks say.
        covariance: of the unknowns (poses, lenses, control points), in that order.
        similarity: (7, 6 k) the similarity that a change of poses amounts to.
        lens_columns: number of lens unknowns.
        keypoint_px: robust standard deviation of a keypoint's coordinate.
        mark_spread: (m, 2, 2) covariance of where the block shows the point of each mark, used or not.
        trust: (n,) weight of each point's surveyed coordinates, 0 for those that took no part.
        state: of the unknowns, to go on from.
    """

    block: Block
    control_xyz: FloatArray
    covariance: FloatArray
    similarity: FloatArray
    lens_columns: int
    keypoint_px: float
    mark_spread: FloatArray
    trust: FloatArray
    state: State

    def control_covariance(self, point: int) -> FloatArray:
        """(3, 3) of a control point."""
        start = 6 * len(self.block.names) + self.lens_columns + 3 * point
        return np.asarray(self.covariance[start : start + 3, start : start + 3])

    def placement_covariance(self) -> FloatArray:
        """(7, 7) of the similarity that places the block."""
        poses = 6 * len(self.block.names)
        return np.asarray(self.similarity @ self.covariance[:poses, :poses] @ self.similarity.T)


def adjust(
    block: Block,
    control: Control,
    control_xyz: FloatArray,
    weights: Weights,
    vertical: Vertical | None,
    options: AdjustOptions,
    previous: "Adjusted | None" = None,
) -> Adjusted:
    """Adjust a block that is in place already but for small changes.

    Args:
        block: metres, local frame; `vertical` is in that frame, too.
        control_xyz: (n, 3) where the control points lie in the block.
        previous: of the same block under other weights, to go on from.
    """
    problem = _problem(block, control, control_xyz, weights, vertical, options)
    state, damping = problem.start if previous is None else previous.state, 0.0
    cost = cost_of(problem, state)
    for _ in range(options.max_iterations):
        system, accepted = system_of(problem, state), False
        while not accepted and damping < _MAX_DAMPING:
            candidate = moved(problem, state, *solve(system, damping))
            new_cost = cost_of(problem, candidate)
            accepted = new_cost <= cost
            damping = _less(damping) if accepted else max(10.0 * damping, _MIN_DAMPING)
        if not accepted:
            break
        converged = cost - new_cost <= options.tolerance
        state, cost = candidate, new_cost
        if converged:
            break
    covariance = _inverse(system_of(problem, state).reduced)
    everything = replace(
        block,
        cameras=state.cameras,
        cam_from_block=state.poses,
        xyz=block.xyz,
    )
    return Adjusted(
        block=_with_all_points(everything, problem, state),
        control_xyz=state.control,
        covariance=covariance,
        similarity=problem.similarity,
        lens_columns=sum(len(columns) for _, columns in problem.free),
        keypoint_px=problem.keypoint_px,
        mark_spread=_mark_spread(problem, state, covariance),
        trust=np.where(weights.points, trust_of(problem, state), 0.0),
        state=state,
    )


def _mark_spread(problem: Problem, state: State, covariance: FloatArray) -> FloatArray:
    everything = replace(
        problem, weights=replace(problem.weights, marks=np.ones(len(problem.control.marks), dtype=bool))
    )
    _, jacobian = mark_equations(everything, state, len(covariance))
    rows = np.asarray(jacobian.todense()).reshape(-1, 2, len(covariance))
    return np.asarray(np.einsum("mik,kl,mjl->mij", rows, covariance, rows, optimize=True))


def similarity_of_change(block: Block) -> FloatArray:
    """(7, 6 k): the best similarity of a change of poses, from what becomes of each centre and orientation.

    A turn counts by how far it moves what the camera looks at; so the similarity is well defined even where
    all cameras lie on a line.
    """
    k = len(block.names)
    wanted, given = np.zeros((6 * k, 7)), np.zeros((6 * k, 6 * k))
    for photo, (pose, depth) in enumerate(zip(block.cam_from_block, _depths(block), strict=True)):
        rows = slice(6 * photo, 6 * photo + 3)
        turns = slice(6 * photo + 3, 6 * photo + 6)
        # cam_from_local becomes exp(omega, nu) cam_from_local: centre and axes move by the inverse.
        wanted[rows] = point_jacobian(pose.center)
        given[rows, 6 * photo + 3 : 6 * photo + 6] = -pose.rotation.T
        wanted[turns, 1:4] = depth * np.eye(3)
        given[turns, 6 * photo : 6 * photo + 3] = -depth * pose.rotation.T
    return np.asarray(np.linalg.lstsq(wanted, given, rcond=None)[0])


def _depths(block: Block) -> FloatArray:
    """Median depth (k,) of the points that each photo sees."""
    rotations = np.array([p.rotation for p in block.cam_from_block])
    translations = np.array([p.translation for p in block.cam_from_block])
    depth = (
        np.einsum("mj,mj->m", rotations[block.photo_of, 2], block.xyz[block.point_of])
        + translations[block.photo_of, 2]
    )
    overall = float(np.median(depth))
    return np.array(
        [
            float(np.median(depth[rows])) if (rows := block.photo_of == k).any() else overall
            for k in range(len(block.names))
        ]
    )


def _problem(
    block: Block,
    control: Control,
    control_xyz: FloatArray,
    weights: Weights,
    vertical: Vertical | None,
    options: AdjustOptions,
) -> Problem:
    chosen = _sample(block, options.points_per_photo)
    counts = np.bincount(block.camera_of, minlength=len(block.cameras))
    free = tuple(
        (index, camera.lens_parameters())
        for index, camera in enumerate(block.cameras)
        if counts[index] >= options.min_photos_of_camera and not options.keep_lens
    )
    lens_start = np.full(len(block.cameras), -1)
    column = 6 * len(block.names)
    for index, columns in free:
        lens_start[index] = column
        column += len(columns)
    residual = linear_of(block.cameras, block.cam_from_block, chosen.xyz, chosen).residual
    return Problem(
        block=chosen,
        control=control,
        weights=weights,
        vertical=vertical,
        free=free,
        lens_start=lens_start,
        start=State(
            poses=block.cam_from_block, cameras=block.cameras, control=control_xyz, points=chosen.xyz
        ),
        similarity=similarity_of_change(block),
        keypoint_px=max(1.4826 * float(np.median(np.abs(residual))), 0.05),
    )


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


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix whose unknowns differ by orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    scaled = normal * scale[:, None] * scale
    inverse = cho_solve(cho_factor(scaled + 1e-13 * np.eye(len(scaled))), np.eye(len(scaled)))
    inverse = inverse * scale[:, None] * scale
    return np.asarray((inverse + inverse.T) / 2)


def _with_all_points(block: Block, problem: Problem, state: State) -> Block:
    """The block with every point where the adjusted cameras see it.

    Points first move with the cameras' common change and then by least squares on their own observations.
    """
    xyz = common_change(problem.similarity, problem.start.poses, state.poses).act(block.xyz)
    for _ in range(3):
        linear = linear_of(block.cameras, block.cam_from_block, xyz, block)
        usable = np.isfinite(linear.residual).all(axis=1)
        scaled = (linear.residual**2).sum(axis=1) / problem.keypoint_px**2
        weight = np.where(usable, 1.0 / (1.0 + np.where(usable, scaled, 0.0)), 0.0)
        by_point = np.nan_to_num(linear.by_point)
        normal = np.zeros((len(xyz), 3, 3))
        np.add.at(normal, linear.point_of, np.swapaxes(by_point, 1, 2) @ by_point * weight[:, None, None])
        gradient = np.zeros((len(xyz), 3))
        moment = np.einsum("mij,mi->mj", by_point, np.nan_to_num(linear.residual)) * weight[:, None]
        np.add.at(gradient, linear.point_of, moment)
        # Damped, so that points on nearly parallel rays keep their place along them.
        trace = np.trace(normal, axis1=1, axis2=2)
        normal += np.eye(3) * (1e-6 * np.maximum(trace, 1e-12))[:, None, None]
        xyz = xyz + np.einsum("nij,nj->ni", np.linalg.inv(normal), gradient)
    return replace(block, xyz=xyz)
