"""How far the photos of a refined reconstruction may be off, given the existing points that hold it.

A similarity says how the whole may lie; that a reconstruction bends where nothing holds it any more, it does
not. The adjustment does (`featuredb.adjust.marginals`): poses and lenses with the free points eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.adjust.block import Block
from featuredb.adjust.marginals import Marginals
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Marks, Terms
from featuredb.geometry.arrays import FloatArray
from ingest.colmap_adjust import longest_side, residuals_of
from ingest.colmap_anchored import (
    AnchoredOptions,
    FixedPoints,
    Lenses,
    block_and_marks,
    with_observations,
)
from ingest.colmap_bridge import Model
from ingest.growth.photo_spread import PhotoSpread
from ingest.precision import design_effect

_LEAST_FREEDOM = 0.1
_PIECE = 5  # photos; a photo alone says more of its own noise than of where its neighbourhood looks


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftOptions:
    """How the bending is judged.

    Attributes:
        least_px: of the standard deviation of an observation with what its neighbours share; it is measured
            on the residuals, which a handful of observations keeps too small.
        max_photos: of more, the rest is taken to be no worse; the equations are dense.
        max_points: free points that take part; fewer know less, so the bound stays one.
    """

    least_px: float = 0.1
    max_photos: int = 300
    max_points: int = 20_000


def photo_covariances(
    model: Model,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
    lenses: Lenses,
    adjust: AnchoredOptions,
    options: DriftOptions,
) -> PhotoSpread:
    """Of all photos, relative to the existing points.

    Observations count as their neighbours share, and for lenses as photos disagree about them
    (`featuredb.adjust.lens_agreement`). By how much a lens differs from the one that a map has lent is this
    reconstruction's alone: it may have changed since. All else that the lenses bring other maps of the same
    cameras have as well.

    Args:
        model: refined, in metres. keypoints: of its photos.
        fixed: existing points, those observations of `kept` (m,).
        lenses: what is known of the model's cameras without the photos, as the adjustment had it.
    """
    count = len(model.rows)
    spread = PhotoSpread(
        poses=np.full((count, 6, 6), np.nan),
        turns=np.full((count, 3, 3), np.nan),
        lens_turns=np.full((count, 3, 3), np.nan),
    )
    if count > options.max_photos or not kept.any():
        return spread
    model = _thinned(model, options)
    everything = np.ones(len(model.point_of), dtype=np.bool_)
    block, marks = block_and_marks(model, everything, keypoints, fixed, kept)
    dilution = adjust.mapping.dilution
    sigma_px = float(np.sqrt(_variance_px2(block, marks, options)))
    terms = Terms(
        keypoint_px=sigma_px,
        dilution=dilution,
        lenses=lenses.priors(model.cameras, adjust),
        marks=replace(marks, sigma_px=sigma_px),
    )
    problem = Problem(block, terms)
    found, weighted = problem.honest_marginals()
    common = found.by_lenses() - dilution**2 * problem.by_lens_priors(weighted, lenses.lent)
    seen = np.flatnonzero(found.pose_start >= 0)
    for k in seen.tolist():
        at = found.pose_start[k] + np.arange(6)
        spread.poses[k] = found.shared[np.ix_(at, at)]
    turn_of = _view_turns(block, found)
    for k, piece in _pieces(model, fixed, kept, seen).items():
        turn = turn_of[piece].mean(axis=0)
        spread.turns[k] = turn @ found.shared @ turn.T
        spread.lens_turns[k] = turn @ common @ turn.T
    return spread


def _view_turns(block: Block, found: Marginals) -> FloatArray:
    """(k, 3, q) how what each photo sees turns about the block's axes with poses and lenses.

    A principal point that is off turns the photo, and its points stay where they are: only what is left of
    both turns what comes next.
    """
    result = np.zeros((len(block.names), 3, len(found.shared)))
    for k, pose in enumerate(block.cam_from_block):
        if found.pose_start[k] < 0:
            continue
        by_pose = slice(int(found.pose_start[k]), int(found.pose_start[k]) + 3)
        result[k, :, by_pose] = pose.rotation.T
        camera, first = block.camera(k), int(found.lens_start[block.camera_of[k]])
        if first >= 0:
            lens = camera.to_pycolmap()
            focal, (cx, cy) = lens.focal_length_idxs(), lens.principal_point_idxs()
            fx, fy = camera.params[focal[0]], camera.params[focal[-1]]
            result[k, :, first + cx] = pose.rotation.T @ [0.0, 1.0 / fx, 0.0]
            result[k, :, first + cy] = pose.rotation.T @ [-1.0 / fy, 0.0, 0.0]
    return result


def _variance_px2(block: Block, marks: Marks, options: DriftOptions) -> float:
    """Of an observation, with what its neighbours share and what points and poses take up of it."""
    count = 2.0 * (len(block.point_of) + len(marks.xyz))
    taken = 3 * len(block.xyz) + 6 * len(block.names)
    freedom = max(1.0 - taken / count, _LEAST_FREEDOM)
    residuals, pixels, photo_of = residuals_of(block, marks)
    shared = design_effect(residuals, pixels, photo_of, longest_side(block.cameras))
    return max(float((residuals**2).mean()) * shared / freedom, options.least_px**2)


def _thinned(model: Model, options: DriftOptions) -> Model:
    """The model with at most so many points, evenly chosen."""
    if len(model.xyz) <= options.max_points:
        return model
    chosen = np.zeros(len(model.xyz), dtype=np.bool_)
    chosen[np.linspace(0, len(model.xyz) - 1, options.max_points).astype(np.int64)] = True
    return with_observations(model, chosen[model.point_of])


def _pieces(
    model: Model, fixed: FixedPoints, kept: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[int, NDArray[np.int64]]:
    """For each photo that sees something, itself and those that share most points with it."""
    photo = np.concatenate([model.photo_of, fixed.photo_of[kept]])
    point = np.concatenate([model.point_of, len(model.xyz) + fixed.point_of[kept]])
    shape = (len(model.rows), len(model.xyz) + len(fixed.xyz))
    sees = sparse.csr_array((np.ones(len(photo)), (photo, point)), shape=shape)
    shared = (sees @ sees.T).toarray()
    np.fill_diagonal(shared, np.inf)
    order = {k: np.argsort(-shared[k], kind="stable")[:_PIECE] for k in seen.tolist()}
    return {k: rows[shared[k, rows] > 0.0] for k, rows in order.items()}
