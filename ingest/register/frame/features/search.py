"""From a coarse prior to a first pose: star renders, pooled features, consistent matches, LO-RANSAC."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.rendering import Rendering
from ingest.register.frame.features.consistency import consistent_matches
from ingest.register.frame.features.matching import FrameMatches, joined, joined_pools, pooled_matches
from ingest.register.frame.views import FrameViews, fan_headings_deg, star_poses, turned_about_vertical
from ingest.register.frame_registration import FramePrior, RenderSource
from reloc.localise.acceptance import independent_inliers, log_nfa
from reloc.localise.lens_prior import LensPriors
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis, estimate_pose, refine_pose, reprojection_errors

_MAX_RATIO = 0.97  # of descriptor distances, best to next place. Loose: true ones are among the bad.
_SAME_PLACE = 0.01  # pool points nearer than this share of their distance from the camera are one place
# Inlier tolerance as a share of the longer side (4 pixels at 1600), where points are denser than pixels;
# where they are sparser, it grows up to the other.
_TOLERANCE_REL = 0.0025
_MAX_TOLERANCE_REL = 0.006

MatchKind = Literal["features", "dense"]

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
        reference: pose in which neighbourhood is judged.
    """

    reference: Rigid3
    renderings: Sequence[Rendering]


def prior_group(views: FrameViews, prior: FramePrior) -> RenderGroup:
    """The render at the prior alone."""
    pose = prior.cam_from_local
    return RenderGroup(reference=pose, renderings=views.renders([pose], views.features_side_px))


def star_group(views: FrameViews, prior: FramePrior) -> RenderGroup:
    """Renders of the star around the prior."""
    poses = star_poses(prior, views.look.depth_m, views.camera)
    return RenderGroup(
        reference=prior.cam_from_local, renderings=views.renders(poses, views.features_side_px)
    )


def fan_groups(views: FrameViews, prior: FramePrior) -> list[RenderGroup]:
    """Renders at the headings that the star leaves out, one view each; none where the heading is known."""
    groups = []
    for angle in fan_headings_deg(prior.sigma_heading_deg)[1:]:
        pose = turned_about_vertical(prior.cam_from_local, angle)
        groups.append(prior_group(views, replace(prior, cam_from_local=pose)))
    return groups


def search(views: FrameViews, groups: Sequence[RenderGroup], source: RenderSource) -> FrameHypothesis | None:
    """A pose from the features of one source, or None where no pose has matches behind it."""
    raw, kept = [], []
    for group in groups:
        pools = views.pools(group.renderings, source)
        if not pools:
            continue
        same_place_m = _SAME_PLACE * views.look.depth_m
        matches = pooled_matches(views.features, joined_pools(pools), same_place_m, _MAX_RATIO)
        raw.append(matches)
        width, height = views.camera.width, views.camera.height
        reference = views.camera.project(group.reference.act(matches.points))
        consistent = consistent_matches(
            matches.pixels, reference, float(max(width, height)), float(width * height)
        )
        kept.append(matches.take(consistent))
    return _hypothesis(views, joined(raw), joined(kept), source)


def unmatched(cam_from_local: Rigid3, camera: Camera, source: RenderSource) -> FrameHypothesis:
    """A pose that no matches stand behind yet."""
    pose = PoseHypothesis(
        cam_from_local=cam_from_local,
        camera=camera,
        camera_source="request",
        inliers=np.zeros(0, dtype=bool),
    )
    return FrameHypothesis(
        pose=pose,
        source=source,
        kind="dense",
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


def _hypothesis(
    views: FrameViews, raw: FrameMatches, kept: FrameMatches, source: RenderSource
) -> FrameHypothesis | None:
    settings = pose_options(views)
    pose = estimate_pose(kept.pixels, kept.points, views.camera, "request", settings)
    if pose is None:
        return None
    pose = refine_pose(kept.pixels, kept.points, pose, settings)
    tolerance_px = settings.tolerance_px(views.camera)
    error = reprojection_errors(raw.pixels, raw.points, pose.camera, pose.cam_from_local)
    testimony = independent(views.camera, raw.take(error < tolerance_px))
    return FrameHypothesis(
        pose=pose,
        source=source,
        kind="features",
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
    tolerance_px = settings.tolerance_px(views.camera)
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
