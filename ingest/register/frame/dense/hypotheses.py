"""Dense templates where point features do not decide: poses to start from, and the fit around a pose."""

from dataclasses import replace

import numpy as np

from ingest.register.frame.dense.confirmation import PictureConfirmation, confirm_pose
from ingest.register.frame.dense.fit import DenseFitOptions, near_places
from ingest.register.frame.dense.search import register_dense, searched_near
from ingest.register.frame.features.matching import joined
from ingest.register.frame.features.search import FrameHypothesis, independent
from ingest.register.frame.prior_fit import fitted_under_prior
from ingest.register.frame.views import FrameViews
from ingest.register.frame_registration import FramePrior, RenderSource
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, refine_pose

_MIN_PLACES = 12  # twice what six parameters need
_FINALISTS = 3  # their scores are often nearly equal; pieces on their own tell them apart
_MAX_SIDE_PX = 1200  # beyond, pieces of 40 px are too small a part of the picture to have structure


def dense_hypotheses(views: FrameViews, prior: FramePrior, source: RenderSource) -> list[FrameHypothesis]:
    """The best few poses that dense templates find around the prior; no matches behind them yet."""
    found = register_dense(views.gray, views.camera, prior, views.cloud, source)
    return [
        FrameHypothesis(
            pose=PoseHypothesis(
                cam_from_local=pose.cam_from_local,
                camera=views.camera,
                camera_source="request",
                inliers=np.zeros(0, dtype=bool),
                prior_focal_px=views.camera.focal_px,
            ),
            source=source,
            kind="dense",
            matches=joined([]),
            inliers=joined([]),
            candidates=pose.pieces,
            log_nfa=0.0,
            rival_share=0.0,
        )
        for pose in found[:_FINALISTS]
    ]


def dense_fitted(
    views: FrameViews, prior: FramePrior, start: FrameHypothesis, options: DenseFitOptions
) -> FrameHypothesis | None:
    """The pose fitted to all pieces near it, under the prior, coarse to fine; None with too few."""
    found: FrameHypothesis | None = start
    rounds = list(zip(options.spacing_px, options.piece_px, options.near_px, strict=True))
    for sizes in rounds:
        found = found and _fit_round(views, prior, found, options, *sizes)
    # A pose that is still on its way may look right already: the pieces that lie near have made it.
    for _ in range(options.more_rounds):
        before = found
        found = found and _fit_round(views, prior, found, options, *rounds[-1])
        if before is None or found is None or _moved_px(views, before, found) < options.settled_px:
            break
    return found


def searched_again(views: FrameViews, prior: FramePrior, found: FrameHypothesis) -> FrameHypothesis | None:
    """The dense search's own maximum next to a pose that was fitted; None where there is none."""
    pose = found.pose.cam_from_local
    near = searched_near(views.gray, found.pose.camera, pose, prior, views.cloud, found.source)
    if near is None:
        return None
    return replace(found, pose=replace(found.pose, cam_from_local=near.cam_from_local))


def _fit_round(
    views: FrameViews,
    prior: FramePrior,
    start: FrameHypothesis,
    options: DenseFitOptions,
    spacing_px: float,
    piece_px: int,
    near_px: int,
) -> FrameHypothesis | None:
    renderings = views.renders([start.pose.cam_from_local], dense_side_px(views, spacing_px))
    if not renderings:
        return None
    matches = near_places(views.gray, views.camera, renderings[0], start.source, piece_px, near_px, options)
    if len(matches) < _MIN_PLACES:
        return None
    settings = dense_pose_options(views, options, spacing_px)
    pose = refine_pose(matches.pixels, matches.points, start.pose, settings)
    pose = fitted_under_prior(matches, pose, prior, settings, views.options.correlated_inliers)
    inliers = independent(views.camera, matches.take(pose.inliers))
    return replace(start, pose=pose, matches=matches, inliers=inliers)


def _moved_px(views: FrameViews, before: FrameHypothesis, after: FrameHypothesis) -> float:
    """How far the fit moved its matches in the picture, in the middle, pixels of the render."""
    here, there = (
        views.camera.project(found.pose.cam_from_local.act(after.matches.points)) for found in (before, after)
    )
    scale = dense_side_px(views, views.options.dense_fit.spacing_px[-1]) / max(
        views.camera.width, views.camera.height
    )
    return float(np.median(np.linalg.norm(here - there, axis=1))) * scale


def dense_pose_options(views: FrameViews, options: DenseFitOptions, spacing_px: float) -> PoseOptions:
    """Inlier tolerance of the fit, as a share of the longer side."""
    return PoseOptions(
        tolerance_rel=options.tolerance_px / dense_side_px(views, spacing_px), seed=views.options.seed
    )


def dense_side_px(views: FrameViews, spacing_px: float) -> int:
    """Longer side of renders in which neighbouring scan points are `spacing_px` apart."""
    side = max(views.camera.width, views.camera.height)
    wanted = round(spacing_px * side / max(views.spacing_full_px, 1e-6))
    return int(np.clip(wanted, min(views.options.min_side_px, side), min(_MAX_SIDE_PX, side)))


def confirmed(views: FrameViews, found: FrameHypothesis) -> PictureConfirmation:
    """What the pictures say of a pose."""
    return confirm_pose(
        views.gray,
        found.pose.camera,
        found.pose.cam_from_local,
        views.cloud,
        found.source,
        views.options.confirm,
    )
