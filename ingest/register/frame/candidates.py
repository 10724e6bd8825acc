"""The pose that is to be judged, which pictures confirm most of all that features and dense templates find,
and how well they agree at other places.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame.dense.confirmation import PictureConfirmation, confirm_pose
from ingest.register.frame.dense.fit import (
    FINALISTS,
    confirmed,
    dense_fitted,
    dense_hypotheses,
    searched_again,
)
from ingest.register.frame.dense.search import REACH_SIGMA, register_dense
from ingest.register.frame.features.search import FrameHypothesis, prior_group, search, star_groups
from ingest.register.frame.prior_fit import loosened
from ingest.register.frame.verdict import DECISIVE_LOG_NFA, SURE_CONFIRMATION_LOG_NFA, beyond_doubt
from ingest.register.frame.views import (
    FrameViews,
    available_sources,
    first_look,
    searched_sources,
    turned_about_vertical,
)
from ingest.register.frame_registration import FramePrior, RenderSource

_MIN_LOG_NFA = 2.0  # a pose with less evidence among the features' matches is not looked into
# A pose of the dense search with less evidence of the pictures is not fitted. Before the fit right ones had
# 0.6 and more, of those at wrong places one in ten.
_PROMISING_LOG_NFA = 0.5
# So many times at most the best pose is searched and fitted again, where it is not confirmed, but has that
# much evidence.
_MORE_LOOKS = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """A fitted pose with what the pictures say of it."""

    found: FrameHypothesis
    confirmation: PictureConfirmation


def best_candidate(views: FrameViews, prior: FramePrior) -> Judged | None:
    """The first pose that is beyond doubt, or of all found the one that the pictures confirm most."""
    judged: list[Judged] = []
    loose = loosened(prior)
    for start in _starts(views, prior):
        with views.clock.stage("compare sources"):
            begun = by_agreement(views, start)
        if start.kind == "dense" and begun.confirmation.log_nfa < _PROMISING_LOG_NFA:
            continue
        judged.append(polished(views, loose, begun.found))
        if beyond_doubt(start.log_nfa, judged[-1].confirmation):
            return judged[-1]
    best = max(judged, key=lambda j: j.confirmation.log_nfa, default=None)
    return best and _looked_again(views, prior, best)


def _looked_again(views: FrameViews, prior: FramePrior, judged: Judged) -> Judged:
    """A pose that is nearly confirmed, searched and fitted in turns: each leaves the other's dead ends."""
    best, start = judged, judged.found
    for _ in range(_MORE_LOOKS):
        if best.confirmation.confirmed or best.confirmation.log_nfa < _PROMISING_LOG_NFA:
            break
        with views.clock.stage("look again"):
            near = searched_again(views, prior, start)
        if near is None:
            break
        again = polished(views, loosened(prior), near)
        best, start = max(best, again, key=lambda j: j.confirmation.log_nfa), again.found
    return best


def _starts(views: FrameViews, prior: FramePrior) -> Iterator[FrameHypothesis]:
    """Poses to begin with, made as they are asked for: by source, features first, then dense templates.

    Features of colours at the prior's own view come before the star around it: often they decide.
    """
    if views.cloud.rgb is not None:
        with views.clock.stage("search prior's view"):
            found = search(views, [prior_group(views, prior.cam_from_local)], "rgb")
        if found is not None and found.log_nfa >= DECISIVE_LOG_NFA:
            yield found
    with views.clock.stage("render star"):
        groups = list(star_groups(views, prior))
    for source in searched_sources(views.cloud):
        with views.clock.stage(f"search {source} features"):
            found = search(views, groups, source)
        if found is not None and found.log_nfa >= _MIN_LOG_NFA:
            yield found
        with views.clock.stage(f"search {source} dense"):
            dense = dense_hypotheses(views, prior, source)
        yield from dense


def by_agreement(views: FrameViews, found: FrameHypothesis) -> Judged:
    """The pose with the source that agrees best with the photo there, whichever it was found by."""
    own = Judged(found=found, confirmation=confirmed(views, found))
    if found.log_nfa >= DECISIVE_LOG_NFA:
        return own
    others = [
        replace(found, source=source) for source in available_sources(views.cloud) if source != found.source
    ]
    judged = [own, *(Judged(found=other, confirmation=confirmed(views, other)) for other in others)]
    # Relief shows what stands and nothing of the ground: it is asked instead of others only beyond doubt.
    sure = SURE_CONFIRMATION_LOG_NFA
    heard = [j for j in judged if j is own or j.found.source != "shaded" or j.confirmation.log_nfa >= sure]
    return max(heard, key=lambda j: j.confirmation.log_nfa)


def polished(views: FrameViews, prior: FramePrior, found: FrameHypothesis) -> Judged:
    """Fitted to pieces of a render, and shown to the pictures."""
    with views.clock.stage("fit"):
        fitted = dense_fitted(views, prior, found) or found
    with views.clock.stage("confirm"):
        return Judged(found=fitted, confirmation=confirmed(views, fitted))


# How well a photo agrees with the scan where it was not taken (docs/measurements/registration.md, "Verdict").

_APART = 1.2  # of the search's reach: the other search is not to find the place that is judged
_SAME_VIEW = 0.25  # two poses that put the picture's middle nearer than this share of its width are one
_COVER_BESIDE = 0.5  # of what the photo's own prior sees; over less there is less to agree with
_KNOWN_HEADING_DEG = 30.0  # with a heading so sure a photo is not upside down


def agreement_elsewhere(
    views: FrameViews, prior: FramePrior, pose: Rigid3, source: RenderSource, max_places: int, enough: float
) -> tuple[int, float]:
    """The strongest agreement at wrong places: how many were searched, and the largest evidence (0 for none).

    Searches the photo beside `pose`, at no more than `max_places` places, until `enough` is reached.
    """
    most, count = 0.0, 0
    for other in _priors_beside(views, prior, pose):
        if count == max_places or most >= enough:
            break
        count += 1
        for candidate in register_dense(views, other, source)[:FINALISTS]:
            there = candidate.cam_from_local
            if other.cam_from_local.angle_to_deg(pose) < 90.0 and _same_view(views, there, pose):
                continue
            most = max(most, confirm_pose(views, views.camera, there, source).log_nfa)
    return count, most


def _priors_beside(views: FrameViews, prior: FramePrior, pose: Rigid3) -> Iterator[FramePrior]:
    """The prior moved out of reach of the pose, to four sides, and turned round, where the scan is seen."""
    reach = REACH_SIGMA * (prior.sigma_horizontal_m + views.look.depth_m * np.radians(prior.sigma_tilt_deg))
    right = np.array([*prior.cam_from_local.rotation[0, :2], 0.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 0.1 else right / np.linalg.norm(right)
    ahead = np.array([-right[1], right[0], 0.0])
    rotation = prior.cam_from_local.rotation
    for side in (right, ahead, -right, -ahead):
        center = pose.center + _APART * reach * side
        moved = replace(prior, cam_from_local=Rigid3.from_center(rotation, center))
        look = first_look(views.cloud, views.camera, moved.cam_from_local)
        if look is not None and look.cover >= _COVER_BESIDE * views.look.cover:
            yield moved
    if prior.sigma_heading_deg <= _KNOWN_HEADING_DEG:
        yield replace(prior, cam_from_local=turned_about_vertical(prior.cam_from_local, 180.0))


def _same_view(views: FrameViews, pose: Rigid3, other: Rigid3) -> bool:
    """Whether two poses show about the same piece of ground."""
    camera, depth_m = views.camera, views.look.depth_m
    ray = camera.unproject(np.array([[camera.width / 2.0, camera.height / 2.0]]))[0]
    middle = depth_m * np.array([*ray, 1.0])
    apart_m = np.linalg.norm(pose.inverse().act(middle) - other.inverse().act(middle))
    return bool(apart_m < _SAME_VIEW * depth_m * camera.width / camera.focal_px)
