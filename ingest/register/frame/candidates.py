"""The pose that is to be judged: of all that features and dense templates find, the one that the pictures
confirm most.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

from featuredb.stage_clock import StageClock
from ingest.register.frame.dense.confirmation import PictureConfirmation
from ingest.register.frame.dense.fit import confirmed, dense_fitted, dense_hypotheses, searched_again
from ingest.register.frame.features.search import FrameHypothesis, fan_groups, prior_group, search, star_group
from ingest.register.frame.prior_fit import loosened
from ingest.register.frame.sources import available_sources, searched_sources
from ingest.register.frame.verdict import DECISIVE_LOG_NFA, SURE_CONFIRMATION_LOG_NFA, beyond_doubt
from ingest.register.frame.views import FrameViews
from ingest.register.frame_registration import FramePrior

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


def best_candidate(views: FrameViews, prior: FramePrior, clock: StageClock) -> Judged | None:
    """The first pose that is beyond doubt, or of all found the one that the pictures confirm most."""
    judged: list[Judged] = []
    loose = loosened(prior)
    for start in _starts(views, prior, clock):
        with clock.stage("compare sources"):
            begun = by_agreement(views, start)
        if start.kind == "dense" and begun.confirmation.log_nfa < _PROMISING_LOG_NFA:
            continue
        judged.append(polished(views, loose, begun.found, clock))
        if beyond_doubt(start.log_nfa, judged[-1].confirmation):
            return judged[-1]
    best = max(judged, key=lambda j: j.confirmation.log_nfa, default=None)
    return best and _looked_again(views, prior, best, clock)


def _looked_again(views: FrameViews, prior: FramePrior, judged: Judged, clock: StageClock) -> Judged:
    """A pose that is nearly confirmed, searched and fitted in turns: each leaves the other's dead ends."""
    best, start = judged, judged.found
    for _ in range(_MORE_LOOKS):
        if best.confirmation.confirmed or best.confirmation.log_nfa < _PROMISING_LOG_NFA:
            break
        with clock.stage("look again"):
            near = searched_again(views, prior, start)
        if near is None:
            break
        again = polished(views, loosened(prior), near, clock)
        best, start = max(best, again, key=lambda j: j.confirmation.log_nfa), again.found
    return best


def _starts(views: FrameViews, prior: FramePrior, clock: StageClock) -> Iterator[FrameHypothesis]:
    """Poses to begin with, made as they are asked for: by source, features first, then dense templates.

    Features of colours at the prior's own view come before the star around it: often they decide.
    """
    if views.cloud.rgb is not None:
        with clock.stage("search prior's view"):
            found = search(views, [prior_group(views, prior)], "rgb")
        if found is not None and found.log_nfa >= DECISIVE_LOG_NFA:
            yield found
    with clock.stage("render star"):
        groups = [star_group(views, prior), *fan_groups(views, prior)]
    for source in searched_sources(views.cloud):
        with clock.stage(f"search {source} features"):
            found = search(views, groups, source)
        if found is not None and found.log_nfa >= _MIN_LOG_NFA:
            yield found
        with clock.stage(f"search {source} dense"):
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


def polished(views: FrameViews, prior: FramePrior, found: FrameHypothesis, clock: StageClock) -> Judged:
    """Fitted to pieces of a render, and shown to the pictures."""
    with clock.stage("fit"):
        fitted = dense_fitted(views, prior, found, views.options.dense_fit) or found
    with clock.stage("confirm"):
        return Judged(found=fitted, confirmation=confirmed(views, fitted))
