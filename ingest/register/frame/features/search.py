"""From a coarse prior to a first pose: star renders, pooled features, consistent matches, LO-RANSAC."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.rendering import Rendering
from ingest.register.frame.features.consistency import MAX_TURN_DEG, consistent_matches
from ingest.register.frame.features.matching import FrameMatches, Pool, guided_matches, joined, pooled_matches
from ingest.register.frame.prior_fit import fitted_under_prior
from ingest.register.frame.views import (
    FULL_CIRCLE_SIGMA_DEG,
    FrameViews,
    fan_headings_deg,
    star_poses,
    turned_about_vertical,
)
from ingest.register.frame_registration import FramePrior, RenderSource
from reloc.localise.acceptance import independent_inliers, log_nfa
from reloc.localise.lens_prior import LensPriors
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, estimate_pose, refine_pose, reprojection_errors

# Longer side of the renders of the first round and of those from the pose found, at most.
_SEARCH_SIDE_PX = 960
_FINAL_SIDE_PX = 1600
# Per render, and of the photo.
_SEARCH_FEATURES = 3000
_FINAL_FEATURES = 6000
_PHOTO_FEATURES = 5000
_MAX_RATIO = 0.97  # of descriptor distances, best to next place. Loose: true ones are among the bad.
_SAME_PLACE = 0.01  # pool points nearer than this share of their distance from the camera are one place
# Inlier tolerance as a share of the longer side (4 pixels at 1600), where points are denser than pixels;
# where they are sparser, it grows up to the other.
_TOLERANCE_REL = 0.0025
_MAX_TOLERANCE_REL = 0.006

MatchKind = Literal["upright", "oriented", "dense"]

_NADIR_COSINE = 0.87  # within 30 degrees of straight down a heading is a rotation of the image
# One structure's keypoints at several scales lie this close, share of the longer side (3 px at 1600).
_SAME_STRUCTURE_REL = 0.002


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameHypothesis:
    """A pose with the matches behind it.

    Attributes:
        pose: with the lens. source: what was rendered.
        matches: all that it was found among. inliers: those of them that agree and are independent.
        candidates: matches before any selection by geometry; log_nfa: evidence that the pose is no chance
            among these, so that nothing that was selected by the pose testifies for it.
        kind: what was matched first.
        rival_share: support of the best pose elsewhere, as a share of this one's.
    """

    pose: PoseHypothesis
    source: RenderSource
    kind: MatchKind
    matches: FrameMatches
    inliers: FrameMatches
    candidates: int
    log_nfa: float
    rival_share: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderGroup:
    """Renders whose features share one reference view.

    Attributes:
        reference: pose in which neighbourhood is judged. max_turn_deg: how far the photo may be turned to it.
    """

    reference: Rigid3
    renderings: Sequence[Rendering]
    max_turn_deg: float


def star_groups(views: FrameViews, prior: FramePrior) -> list[RenderGroup]:
    """Renders of the star around the prior: for features with orientation, and upright ones."""
    poses = star_poses(prior, views.look.depth_m, views.camera)
    turn = 180.0 if _any_heading(prior) else MAX_TURN_DEG
    renderings = views.renders(poses, views.side_px(_SEARCH_SIDE_PX))
    return [RenderGroup(reference=prior.cam_from_local, renderings=renderings, max_turn_deg=turn)]


def fan_groups(views: FrameViews, prior: FramePrior) -> list[RenderGroup]:
    """Renders at the headings that the star leaves out, one view each; none where the heading is known."""
    groups = []
    for angle in fan_headings_deg(prior.sigma_heading_deg)[1:]:
        pose = turned_about_vertical(prior.cam_from_local, angle)
        renderings = views.renders([pose], views.side_px(_SEARCH_SIDE_PX))
        groups.append(RenderGroup(reference=pose, renderings=renderings, max_turn_deg=MAX_TURN_DEG))
    return groups


def oriented_features_suffice(prior: FramePrior) -> bool:
    """Whether an unknown heading is a mere rotation of the image, as in nadir photos."""
    return bool(prior.cam_from_local.rotation[2, 2] < -_NADIR_COSINE)


def search(
    views: FrameViews, groups: Sequence[RenderGroup], source: RenderSource, upright: bool
) -> FrameHypothesis | None:
    """A pose from one source and one kind of features, or None where no pose has matches behind it."""
    features = views.photo_features(upright, round(1.25 * views.side_px(_SEARCH_SIDE_PX)), _PHOTO_FEATURES)
    raw, kept = [], []
    for group in groups:
        pools = views.pools(group.renderings, source, upright, _SEARCH_FEATURES)
        if not pools:
            continue
        matches = pooled_matches(features, joined_pools(pools), _SAME_PLACE * views.look.depth_m, _MAX_RATIO)
        raw.append(matches)
        kept.append(_consistent(views, matches, group))
    return _hypothesis(views, joined(raw), joined(kept), source, upright)


def guided(
    views: FrameViews, prior: FramePrior, start: FrameHypothesis, radius_px: float
) -> FrameHypothesis | None:
    """The pose from matches looked for where `start` predicts them, on a render from its pose."""
    side_px = views.side_px(_FINAL_SIDE_PX)
    renderings = views.renders([start.pose.cam_from_local], side_px)
    if not renderings:
        return None
    pool = joined_pools(views.pools(renderings, start.source, True, _FINAL_FEATURES))
    features = views.photo_features(True, round(1.25 * side_px), _FINAL_FEATURES)
    matches = guided_matches(
        features,
        pool,
        start.pose.camera,
        start.pose.cam_from_local,
        radius_px,
        _SAME_PLACE * views.look.depth_m,
        _MAX_RATIO,
    )
    settings = pose_options(views)
    pose = estimate_pose(matches.pixels, matches.points, start.pose.camera, "request", settings)
    if pose is None:
        return None
    pose = refine_pose(matches.pixels, matches.points, pose, settings)
    pose = fitted_under_prior(matches, pose, prior, settings)
    return replace(
        start, pose=pose, matches=matches, inliers=independent(views.camera, matches.take(pose.inliers))
    )


def unmatched(
    cam_from_local: Rigid3, camera: Camera, source: RenderSource, kind: MatchKind
) -> FrameHypothesis:
    """A pose that no matches stand behind yet."""
    pose = PoseHypothesis(
        cam_from_local=cam_from_local,
        camera=camera,
        camera_source="request",
        inliers=np.zeros(0, dtype=bool),
        prior_focal_px=camera.focal_px,
    )
    return FrameHypothesis(
        pose=pose,
        source=source,
        kind=kind,
        matches=joined([]),
        inliers=joined([]),
        candidates=0,
        log_nfa=0.0,
        rival_share=0.0,
    )


def pose_options(views: FrameViews) -> PoseOptions:
    """Tolerance by the density of the scan: a keypoint on splats is no better located than these."""
    side = max(views.camera.width, views.camera.height)
    by_scan = views.spacing_full_px / side
    tolerance = float(np.clip(by_scan, _TOLERANCE_REL, _MAX_TOLERANCE_REL))
    # A frame on a scan has too few matches for more of a lens.
    return PoseOptions(tolerance_rel=tolerance, lens=LensPriors(whole_lens=False))


def joined_pools(pools: Sequence[Pool]) -> Pool:
    """One pool of all."""
    return Pool(
        points=np.concatenate([p.points for p in pools]),
        descriptors=np.concatenate([p.descriptors for p in pools]),
    )


def _consistent(views: FrameViews, matches: FrameMatches, group: RenderGroup) -> FrameMatches:
    camera = views.camera
    reference = camera.project(group.reference.act(matches.points))
    found = consistent_matches(
        matches.pixels,
        reference,
        float(max(camera.width, camera.height)),
        float(camera.width * camera.height),
        group.max_turn_deg,
    )
    return matches.take(found)


def _hypothesis(
    views: FrameViews, raw: FrameMatches, kept: FrameMatches, source: RenderSource, upright: bool
) -> FrameHypothesis | None:
    settings = pose_options(views)
    pose = estimate_pose(kept.pixels, kept.points, views.camera, "request", settings)
    if pose is None:
        return None
    pose = refine_pose(kept.pixels, kept.points, pose, settings)
    tolerance_px = settings.tolerance_rel * max(views.camera.width, views.camera.height)
    error = reprojection_errors(raw.pixels, raw.points, pose.camera, pose.cam_from_local)
    testimony = independent(views.camera, raw.take(error < tolerance_px))
    return FrameHypothesis(
        pose=pose,
        source=source,
        kind="upright" if upright else "oriented",
        matches=kept,
        inliers=independent(views.camera, kept.take(pose.inliers)),
        candidates=len(raw),
        log_nfa=log_nfa(
            len(raw), len(testimony), tolerance_px, views.camera.width, views.camera.height, sample=3
        ),
        rival_share=_rival(views, kept, pose, settings) / max(pose.count, 1),
    )


def _rival(views: FrameViews, kept: FrameMatches, best: PoseHypothesis, settings: PoseOptions) -> int:
    """Inliers of the best pose among the matches that the winner does not explain."""
    tolerance_px = settings.tolerance_rel * max(views.camera.width, views.camera.height)
    error = reprojection_errors(kept.pixels, kept.points, best.camera, best.cam_from_local)
    # What lies a little off the winner is its own: slopes, a bent scan, a lens that is not quite right.
    rest = kept.take(error > 4.0 * tolerance_px)
    other = estimate_pose(rest.pixels, rest.points, best.camera, "request", settings)
    if other is None:
        return 0
    return len(independent(views.camera, rest.take(other.inliers)))


def independent(camera: Camera, inliers: FrameMatches) -> FrameMatches:
    """Those inliers that are measurements of their own."""
    gap = _SAME_STRUCTURE_REL * max(camera.width, camera.height)
    return inliers.take(independent_inliers(inliers.pixels, inliers.points, gap))


def _any_heading(prior: FramePrior) -> bool:
    return prior.sigma_heading_deg >= FULL_CIRCLE_SIGMA_DEG
