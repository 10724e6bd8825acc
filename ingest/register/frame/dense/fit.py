"""A pose from where all pieces of a render lie in the photo, each near where the pose puts it.

Like ICP: a render is made at the pose, each piece takes the highest place of its score map within a few
pixels, the pose is fitted to all of them with a robust loss, and a render is made anew. Coarse to fine.
"""

from dataclasses import replace

import cv2
import numpy as np

from featuredb.render.renderer import Rendering
from ingest.register.frame.dense.confirmation import PictureConfirmation, confirm_pose
from ingest.register.frame.dense.pictures import oriented_gradients, pinhole_view
from ingest.register.frame.dense.score_maps import cut_templates, peaks, search_around
from ingest.register.frame.dense.search import refined, register_dense, sides
from ingest.register.frame.features.matching import NO_MATCHES, FrameMatches
from ingest.register.frame.features.search import FrameHypothesis, independent, unmatched
from ingest.register.frame.prior_fit import fitted_under_prior
from ingest.register.frame.verdict import DECISIVE_LOG_NFA
from ingest.register.frame.views import FrameViews
from ingest.register.frame_registration import FramePrior, RenderSource
from reloc.localise.options import PoseOptions
from reloc.localise.pose import refine_pose

_WINDOW_PX = 12  # radius of the score map against whose spread a place is judged
# Height of a place in standard deviations of its map. Low: the robust loss weighs them, and a piece that has
# structure along one direction only still says where it is across.
_MIN_SCORE = 1.5
_TOLERANCE_PX = 4.0  # of an inlier, in the render
_MAX_PIECES = 400  # per round
_PIECE_POINTS = 15.0  # so many scan points are across a piece, as far as the picture has room
_LEAST_ACROSS = 8  # pieces that are made larger still leave so many along the picture's longer side


def near_places(
    views: FrameViews, rendering: Rendering, source: RenderSource, piece_px: int, near_px: int
) -> FrameMatches:
    """Pieces of a render, and where in the photo they fit best near where the render's pose puts them.

    Args:
        rendering: made with the views' camera, shrunk.
    """
    templates = cut_templates(rendering, source, piece_px, _MAX_PIECES)
    size = (rendering.camera.width, rendering.camera.height)
    small = np.asarray(cv2.resize(views.gray, size, interpolation=cv2.INTER_AREA))
    photo = oriented_gradients(small, None)
    maps = search_around(templates, photo, rendering.camera, rendering.cam_from_local, _WINDOW_PX)
    if len(maps) == 0:
        return NO_MATCHES
    cut, size_px = _WINDOW_PX - near_px, 2 * near_px + 1
    places, scores = peaks(np.ascontiguousarray(maps.maps[:, cut : cut + size_px, cut : cut + size_px]))
    # A place on the rim has its top outside: the piece saw nothing here.
    good = (scores >= _MIN_SCORE) & (np.abs(places - near_px).max(axis=1) < near_px - 0.6)
    scale = np.array([views.camera.width / size[0], views.camera.height / size[1]])
    return FrameMatches(
        pixels=(maps.origin + cut + places)[good] * scale, points=np.asarray(maps.points_local)[good]
    )


_MIN_PLACES = 12  # twice what six parameters need
FINALISTS = 3  # their scores are often nearly equal; pieces on their own tell them apart
MAX_SIDE_PX = 1200  # beyond, pieces of 40 px are too small a part of the picture to have structure


def dense_hypotheses(views: FrameViews, prior: FramePrior, source: RenderSource) -> list[FrameHypothesis]:
    """The best few poses that dense templates find around the prior; no matches behind them yet."""
    found = register_dense(views, prior, source)
    return [
        replace(unmatched(pose.cam_from_local, views.camera, source), candidates=pose.pieces)
        for pose in found[:FINALISTS]
    ]


def dense_fitted(views: FrameViews, prior: FramePrior, start: FrameHypothesis) -> FrameHypothesis | None:
    """The pose fitted to all pieces near it, under the prior, coarse to fine; None with too few.

    Features that decide leave less than the coarse round takes up.
    """
    found: FrameHypothesis | None = start
    rounds = views.options.fit_rounds
    decided = start.kind == "features" and start.log_nfa >= DECISIVE_LOG_NFA
    for sizes in rounds[1:] if decided else rounds:
        found = found and _fit_round(views, prior, found, sizes)
    # A pose that is still on its way may look right already: the pieces that lie near have made it.
    for _ in range(views.options.more_rounds):
        before = found
        found = found and _fit_round(views, prior, found, rounds[-1])
        if before is None or found is None or _moved_px(views, before, found) < 0.2:
            break
    return found


def searched_again(views: FrameViews, prior: FramePrior, found: FrameHypothesis) -> FrameHypothesis | None:
    """The dense search's own maximum next to a pose that was fitted; None where there is none."""
    camera, pose = found.pose.camera, found.pose.cam_from_local
    view = pinhole_view(views.gray, camera, sides(camera, prior, views.cloud)[-1])
    near = refined(view, pose, prior, views.cloud, found.source)
    if near is None:
        return None
    return replace(found, kind="dense", pose=replace(found.pose, cam_from_local=near.cam_from_local))


def _fit_round(
    views: FrameViews, prior: FramePrior, start: FrameHypothesis, sizes: tuple[float, int, int]
) -> FrameHypothesis | None:
    spacing_px, piece_px, near_px = sizes
    side_px = views.side_px(spacing_px, MAX_SIDE_PX)
    renderings = views.renders([start.pose.cam_from_local], side_px)
    if not renderings:
        return None
    between_px = views.spacing_full_px * side_px / max(views.camera.width, views.camera.height)
    wanted_px = min(_PIECE_POINTS * between_px, side_px / _LEAST_ACROSS)
    piece_px = max(piece_px, 2 * round(0.5 * wanted_px))
    matches = near_places(views, renderings[0], start.source, piece_px, near_px)
    if len(matches) < _MIN_PLACES:
        return None
    settings = PoseOptions(tolerance_rel=_TOLERANCE_PX / side_px)
    pose = refine_pose(matches.pixels, matches.points, start.pose, settings)
    pose = fitted_under_prior(matches, pose, prior, settings)
    inliers = independent(views.camera, matches.take(pose.inliers))
    return replace(start, pose=pose, matches=matches, inliers=inliers)


def _moved_px(views: FrameViews, before: FrameHypothesis, after: FrameHypothesis) -> float:
    """How far the fit moved its matches in the picture, in the middle, pixels of the render."""
    here, there = (
        views.camera.project(found.pose.cam_from_local.act(after.matches.points)) for found in (before, after)
    )
    side_px = views.side_px(views.options.fit_rounds[-1][0], MAX_SIDE_PX)
    moved = float(np.median(np.linalg.norm(here - there, axis=1)))
    return moved * side_px / max(views.camera.width, views.camera.height)


def confirmed(views: FrameViews, found: FrameHypothesis) -> PictureConfirmation:
    """What the pictures say of a pose."""
    return confirm_pose(views, found.pose.camera, found.pose.cam_from_local, found.source)
