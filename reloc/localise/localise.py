"""One photo against indexed maps: a pose, or a reason why there is none.

The steps, in order: features; clusters of map images that may show the same; 2D-3D matches inside each
cluster; robust pose; matches guided by it; refinement; uncertainty; acceptance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.stage_clock import StageClock
from reloc.localise.acceptance import confidence, prior_tells, verdict
from reloc.localise.answer import make_answer
from reloc.localise.candidates import IndexedArea, usable_areas
from reloc.localise.lens_prior import seen_by_a_map
from reloc.localise.options import LocaliseOptions
from reloc.localise.pose import PoseUncertainty, pose_uncertainty
from reloc.localise.prior import contradicts_prior, distance_from, weakened
from reloc.localise.result import (
    LocaliseRequest,
    LocaliseResult,
    OwnPosition,
    PositionRole,
    Reason,
    RunnerUp,
)
from reloc.localise.rivals import runner_up
from reloc.localise.search import PoseCandidate, Search, pairs, search


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localised:
    """A result with what it was made of, for callers that go on from there.

    Attributes:
        best: the believed pose with its matches and area; None exactly where the result has no pose.
        uncertainty: of that pose, measured part only, in the area's axes.
    """

    result: LocaliseResult
    best: PoseCandidate | None = None
    uncertainty: PoseUncertainty | None = None


def localise(
    gray: NDArray[np.uint8],
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions | None = None,
    snapshot: int = 0,
) -> LocaliseResult:
    """Pose of a photo.

    Args:
        gray: (h, w) uint8, pixels as stored in the file.
        areas: the indexed maps to search; those of another extractor than the options' are left out.
        snapshot: version of the database that the areas come from, passed through.

    Raises:
        IncompatibleExtractorError: there are areas, and all of them are of another extractor.
        ImageError: the image is not (h, w) uint8 or tiny.
        InvalidValueError: the request's camera is of another image size.
    """
    options = options or LocaliseOptions()
    areas = usable_areas(areas, options.extractor.fingerprint)
    clock = StageClock()
    features = extract(gray, options.extractor)
    clock.lap("features")
    return _localised(features, request, areas, options, snapshot, clock).result


def localise_features(
    features: Features,
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions | None = None,
) -> Localised:
    """`localise` of a photo whose features are there already, strongest and best spread first.

    Raises:
        IncompatibleExtractorError: there are areas, and all of them are of another extractor.
        InvalidValueError: the request's camera is of another image size.
    """
    options = options or LocaliseOptions()
    areas = usable_areas(areas, options.extractor.fingerprint)
    return _localised(features, request, areas, options, 0, StageClock())


def _localised(
    features: Features,
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions,
    snapshot: int,
    clock: StageClock,
) -> Localised:
    def ask(asked: LocaliseRequest) -> Localised:
        found = search(features, asked, areas, options, clock)
        localised = _decide(found, features, asked, options, snapshot)
        clock.lap("answer")
        return localised

    localised = ask(request)
    if request.own_position is not None and request.prior is None:
        localised = _with_own_position(localised, request, ask, options)
    return replace(localised, result=replace(localised.result, timings_ms=clock.milliseconds()))


def _with_own_position(
    everywhere: Localised,
    request: LocaliseRequest,
    ask: Callable[[LocaliseRequest], Localised],
    options: LocaliseOptions,
) -> Localised:
    """The answer that the photo's own position allows, which may be that of another town.

    All places compete without it first. Where that gives no answer, one near the position is believed, unless
    much more spoke for a place elsewhere. Where it gives one elsewhere, that stays, or is ambiguous if the
    photo fits near its position about as well.
    """
    assert request.own_position is not None
    position, first = weakened(request.own_position), everywhere.result

    def said(chosen: Localised, role: PositionRole) -> Localised:
        pose = chosen.result.pose
        own = OwnPosition(role=role, distance_m=None if pose is None else distance_from(pose, position))
        return replace(chosen, result=replace(chosen.result, own_position=own))

    if first.pose is not None and contradicts_prior(first.pose, position) is None:
        return said(everywhere, "agrees")
    near = ask(replace(request, prior=position, own_position=None))
    fits = near.best is not None and near.result.inliers >= options.acceptance.rival_share * first.inliers
    if everywhere.best is None:
        return said(near, "decided") if fits else said(everywhere, "no_help")
    if not fits:
        return said(everywhere, "contradicted")
    assert near.best is not None
    rival = runner_up(everywhere.best, [near.best])
    if rival is None:  # the same place, on either side of the limit
        return said(everywhere, "agrees")
    refused = replace(
        first,
        reason="AMBIGUOUS",
        detail=f"the photo fits a place far from its own position with {first.inliers} inliers, and one "
        f"there with {near.result.inliers}",
        pose=None,
        confidence=0.0,
        runner_up=rival,
    )
    return said(Localised(result=refused), "contradicted")


def _decide(
    found: Search,
    features: Features,
    request: LocaliseRequest,
    options: LocaliseOptions,
    snapshot: int,
) -> Localised:
    evidence = found.candidates[0].evidence if found.candidates else None
    answered = partial(
        LocaliseResult, features=len(features), matches=found.matches, snapshot=snapshot, evidence=evidence
    )

    def refuse(reason: Reason, detail: str, inliers: int = 0, rival: RunnerUp | None = None) -> Localised:
        result = answered(reason=reason, detail=detail, inliers=inliers, runner_up=rival)
        return Localised(result=result)

    if found.reason is not None:
        return refuse(found.reason, found.detail)
    if not found.candidates:
        return refuse("TOO_FEW_INLIERS", f"no pose agrees with the {found.matches} matches")
    best = found.candidates[0]
    rival = runner_up(best, found.candidates[1:])
    refusal = verdict(
        best.evidence,
        rival.inliers if rival else 0,
        options.acceptance,
        told_by_prior=prior_tells(request.prior, options.acceptance),
    )
    if refusal is not None:
        return refuse(refusal[0], refusal[1], best.evidence.inliers, rival)
    pixels, points = pairs(features, best.area, best.matches)
    rows = best.matches.point[best.rows]
    inliers = (pixels[best.rows], points[best.rows], best.area.point_covariance[rows])
    uncertainty = pose_uncertainty(*inliers, best.pose, options.pose)
    told = request.camera if request.camera_is_exact else None
    lent = None
    if told is None and best.pose.lens_prior is None:
        lent_by = LensUncertainty.of_provenance(best.main_map.provenance)
        seen = None if lent_by is None else seen_by_a_map(best.pose.camera, lent_by)
        if seen is not None and seen[0].model == best.pose.camera.model:
            pose = replace(best.pose, camera=seen[0], lens_prior=seen[1])
            lent = pose_uncertainty(*inliers, pose, options.pose)
    answer = make_answer(
        best.area, best.pose, uncertainty, pixels[best.rows], rows, request.want_inliers, told, lent
    )
    against = contradicts_prior(answer, request.prior)
    if against is not None:
        return refuse("CONTRADICTS_PRIOR", against, best.evidence.inliers, rival)
    result = answered(
        reason=None,
        detail=f"{best.evidence.inliers} inliers of {found.matches} matches",
        pose=answer,
        confidence=confidence(best.evidence, rival.inliers if rival else 0),
        inliers=best.evidence.inliers,
        runner_up=rival,
    )
    return Localised(result=result, best=best, uncertainty=uncertainty)
