"""From a coarse prior to a first pose: star renders, pooled features, consistent matches, LO-RANSAC.

Between a photo and a render of a scan only 3 to 7 of 100 matches are true (paper, section 3.1.1), too few
for RANSAC on all of them. Near one true match another one has about the same rotation and scale.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammainc

from featuredb.compiled import compiled_module
from featuredb.geometry.arrays import FloatArray, joined
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.renderer import Rendering
from ingest.register.frame.features.matching import (
    NO_MATCHES,
    FrameMatches,
    pool_features,
    pooled_matches,
)
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

# Matches around each one that are asked. At 3 % true ones, 180 hold five; with 120 a third of these is lost,
# and time grows with the square.
_NEIGHBOURS = 180
# None farther away than this share of the image's longer side: beyond, relief and perspective make more than
# one similarity of it.
_REACH_REL = 0.15
# -log10 of the expected number of matches, among all, that random neighbours would support as well. Three
# false ones do not disturb RANSAC.
_MIN_LOG_CHANCE = -0.5


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
    kind: MatchKind = "dense"
    matches: FrameMatches = NO_MATCHES
    inliers: FrameMatches = NO_MATCHES
    candidates: int = 0
    log_nfa: float = 0.0
    rival_share: float = 0.0


class RenderGroup(NamedTuple):
    """Renders whose features share the view at one pose: neighbourhood is judged there."""

    pose: Rigid3
    renderings: Sequence[Rendering]


def prior_group(views: FrameViews, pose: Rigid3) -> RenderGroup:
    """The render at one pose alone."""
    return RenderGroup(pose, views.renders([pose], views.features_side_px))


def star_groups(views: FrameViews, prior: FramePrior) -> Iterator[RenderGroup]:
    """Renders of the star around the prior, and one at each heading that it leaves out, if any."""
    poses = star_poses(prior, views.look.depth_m, views.camera)
    yield RenderGroup(prior.cam_from_local, views.renders(poses, views.features_side_px))
    for angle in fan_headings_deg(prior.sigma_heading_deg)[1:]:
        yield prior_group(views, turned_about_vertical(prior.cam_from_local, angle))


def search(views: FrameViews, groups: Sequence[RenderGroup], source: RenderSource) -> FrameHypothesis | None:
    """A pose from the features of one source, or None where no pose has matches behind it."""
    raw, kept = [NO_MATCHES], [NO_MATCHES]
    width, height = views.camera.width, views.camera.height
    for pose, renderings in groups:
        if not renderings:
            continue
        with ThreadPoolExecutor(views.threads) as threads:
            pool = joined(list(threads.map(lambda r: pool_features(r, source), renderings)))
        matches = pooled_matches(views.features, pool, _SAME_PLACE * views.look.depth_m, _MAX_RATIO)
        raw.append(matches)
        reference = views.camera.project(pose.act(matches.points))
        consistent = consistent_matches(
            matches.pixels, reference, float(max(width, height)), float(width * height)
        )
        kept.append(matches.take(consistent))
    return _hypothesis(views, joined(raw), joined(kept), source)


def consistent_matches(
    photo: FloatArray, reference: FloatArray, side_px: float, area_px: float
) -> NDArray[np.bool_]:
    """Which matches (m,) have more neighbours that one similarity moves than chance gives them.

    A match and each neighbour suggest a rotation and scale, (q_j - q_i) / (p_j - p_i) as complex numbers.
    Support is the largest number of neighbours that one of these takes to where they are; by chance it is
    Poisson.

    Args:
        photo: (m, 2) pixels. reference: (m, 2) where the matched scan points appear in one common view;
            rows that are not finite are supported by nothing.
        side_px: longer side of the photo. area_px: over which false matches are spread in the reference.
    """
    m = len(photo)
    support, expected = np.zeros(m, np.int64), np.full(m, 1.0)
    rows = np.flatnonzero(np.isfinite(reference).all(axis=1))
    if len(rows) >= 3:
        k, reach_px = min(_NEIGHBOURS + 1, len(rows)), _REACH_REL * side_px
        distance, neighbour = cKDTree(photo[rows]).query(photo[rows], k=k, distance_upper_bound=reach_px)
        neighbour = np.where(np.isfinite(distance), neighbour, -1).astype(np.int64)
        loops = compiled_module("ingest.register.frame.features.consistency_loops")
        support[rows], expected[rows] = loops.neighbour_support(
            np.ascontiguousarray(photo[rows], dtype=np.float64),
            np.ascontiguousarray(reference[rows], dtype=np.float64),
            neighbour,
            side_px,
            area_px,
        )
    # -log10 of matches x hypotheses x P(at least so many of the others by chance).
    others = np.maximum(support - 1, 0)  # the neighbour that gave the hypothesis agrees with itself
    tail = np.where(others > 0, gammainc(np.maximum(others, 1), np.maximum(expected, 1e-12)), 1.0)
    return np.asarray(-np.log10(np.maximum(tail, 1e-300) * m * _NEIGHBOURS) >= _MIN_LOG_CHANCE)


def unmatched(cam_from_local: Rigid3, camera: Camera, source: RenderSource) -> FrameHypothesis:
    """A pose that no matches stand behind yet."""
    pose = PoseHypothesis(
        cam_from_local=cam_from_local,
        camera=camera,
        camera_source="request",
        inliers=np.zeros(0, dtype=bool),
    )
    return FrameHypothesis(pose=pose, source=source)


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
    settings, camera = pose_options(views), views.camera
    pose = estimate_pose(kept.pixels, kept.points, camera, "request", settings)
    if pose is None:
        return None
    pose = refine_pose(kept.pixels, kept.points, pose, settings)
    tolerance_px = settings.tolerance_px(camera)
    error = reprojection_errors(raw.pixels, raw.points, pose.camera, pose.cam_from_local)
    testimony = len(independent(camera, raw.take(error < tolerance_px)))
    return FrameHypothesis(
        pose=pose,
        source=source,
        kind="features",
        matches=kept,
        inliers=independent(camera, kept.take(pose.inliers)),
        candidates=len(raw),
        log_nfa=log_nfa(len(raw), testimony, tolerance_px, camera.width, camera.height, sample=3),
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
