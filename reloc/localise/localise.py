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
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.maps.feature_map import GeoPrior
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.stage_clock import StageClock
from reloc.localise.acceptance import confidence, prior_tells, verdict
from reloc.localise.answer import make_answer, placement_covariance
from reloc.localise.candidates import IndexedArea, usable_areas
from reloc.localise.lens_prior import QueryLensPrior, seen_by_a_map
from reloc.localise.options import LocaliseOptions
from reloc.localise.pose import PoseUncertainty, pose_uncertainty, refined_as_part
from reloc.localise.result import LocalisedPose, LocaliseRequest, LocaliseResult
from reloc.localise.search import PoseCandidate, pairs, search
from reloc.wire.query import OwnPositionUse, PositionRole, Reason, RunnerUpPose

# Chi-square with two degrees of freedom is above this once in 10,000 answers if the prior's sigma is honest.
_CHI_SQUARE_LIMIT = 18.42

_OF_PART = "; the picture's lens is not that of a whole photo, as where it was cropped or zoomed"

# Phones between houses are off by tens of metres, whatever accuracy they write into a photo.
_OWN_POSITION_SIGMA_M = 20.0


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
    size: tuple[int, int] | None = None,
) -> LocaliseResult:
    """Pose of a photo.

    Args:
        gray: (h, w) uint8, pixels as stored in the file.
        size: width and height of the photo, where `gray` is smaller, as for `extract`.
        areas: the indexed maps to search; those of another extractor than the options' are left out.
        snapshot: version of the database that the areas come from, passed through.

    Raises:
        IncompatibleExtractorError: there are areas, and all of them are of another extractor.
        ImageError: the image is not (h, w) uint8 or tiny.
        InvalidValueError: the request's camera is of another image size.
    """
    options, clock = options or LocaliseOptions(), StageClock()
    areas = usable_areas(areas, options.extractor.fingerprint)
    features = extract(gray, options.extractor, size)
    clock.lap("features")
    return localise_features(features, request, areas, options, snapshot, clock).result


def localise_features(
    features: Features,
    request: LocaliseRequest,
    areas: Sequence[IndexedArea],
    options: LocaliseOptions | None = None,
    snapshot: int = 0,
    clock: StageClock | None = None,
) -> Localised:
    """`localise` of a photo whose features are there already, strongest and best spread first.

    Raises:
        IncompatibleExtractorError: there are areas, and all of them are of another extractor.
        InvalidValueError: the request's camera is of another image size.
    """
    settings, timed = options or LocaliseOptions(), clock or StageClock()
    usable = usable_areas(areas, settings.extractor.fingerprint)

    def ask(asked: LocaliseRequest) -> Localised:
        localised = _decide(
            search(features, asked, usable, settings, timed), features, asked, settings, snapshot
        )
        timed.lap("answer")
        return localised

    localised = ask(request)
    if request.own_position is not None and request.prior is None:
        localised = _with_own_position(localised, request, ask, settings)
    return replace(localised, result=replace(localised.result, timings_ms=timed.milliseconds()))


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
    # Not believed more closely than phones deserve.
    sigma_m = max(request.own_position.sigma_horizontal_m, _OWN_POSITION_SIGMA_M)
    position, first = replace(request.own_position, sigma_horizontal_m=sigma_m), everywhere.result

    def said(chosen: Localised, role: PositionRole) -> Localised:
        pose = chosen.result.pose
        away_m = None if pose is None else float(np.linalg.norm(_offset(pose, position)))
        own = OwnPositionUse(role=role, distance_m=away_m)
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
    found: tuple[list[PoseCandidate], int, tuple[Reason, str] | None],  # of `search`
    features: Features,
    request: LocaliseRequest,
    options: LocaliseOptions,
    snapshot: int,
) -> Localised:
    candidates, matches, nothing = found
    evidence = candidates[0].evidence if candidates else None
    answered = partial(
        LocaliseResult, features=len(features), matches=matches, snapshot=snapshot, evidence=evidence
    )

    def refuse(reason: Reason, detail: str, inliers: int = 0, rival: RunnerUpPose | None = None) -> Localised:
        result = answered(reason=reason, detail=detail, inliers=inliers, runner_up=rival)
        return Localised(result=result)

    if nothing is not None:
        return refuse(*nothing)
    best, *others = candidates
    rival = runner_up(best, others)
    refusal = verdict(
        best.evidence,
        rival.inliers if rival else 0,
        options.acceptance,
        told_by_prior=prior_tells(request.prior, options.acceptance),
    )
    if refusal is not None:
        return refuse(refusal[0], refusal[1], best.evidence.inliers, rival)
    pixels, points = pairs(features, best.area, best.matches)
    told = request.camera if request.camera_is_exact else None
    seen = _lens_as_seen(best) if told is None and best.pose.lens_prior is None else None
    known = best.pose.lens_prior or (seen and seen[1])
    part = None
    if known and best.pose.camera_source != "request" and not best.pose.part and request.film is None:
        part = refined_as_part(pixels, points, best.pose, known, options.pose)
    if part is not None:
        best, seen = replace(best, pose=part, rows=best.rows[part.inliers[best.rows]]), None
    rows = best.matches.point[best.rows]
    inliers = (pixels[best.rows], points[best.rows], best.area.point_covariance(rows))
    uncertainty = pose_uncertainty(*inliers, best.pose, options.pose)
    lent = None
    if seen is not None:
        pose = replace(best.pose, camera=seen[0], lens_prior=seen[1])
        lent = pose_uncertainty(*inliers, pose, options.pose)
    answer = make_answer(
        best.area, best.pose, uncertainty, pixels[best.rows], rows, request.want_inliers, told, lent
    )
    against = contradicts_prior(answer, request.prior)
    if against is not None:
        return refuse("CONTRADICTS_PRIOR", against, best.evidence.inliers, rival)
    cut = _OF_PART if part or best.pose.part else ""
    result = answered(
        reason=None,
        detail=f"{best.evidence.inliers} inliers of {matches} matches{cut}",
        pose=answer,
        confidence=confidence(best.evidence, rival.inliers if rival else 0),
        inliers=best.evidence.inliers,
        runner_up=rival,
    )
    return Localised(result=result, best=best, uncertainty=uncertainty)


def _lens_as_seen(found: PoseCandidate) -> tuple[Camera, QueryLensPrior] | None:
    """The lens that the map has lent, and how well the map knows it; None where the map does not say."""
    known = LensUncertainty.of_provenance(found.main_map.provenance)
    seen = None if known is None else seen_by_a_map(found.pose.camera, known)
    return seen if seen is not None and seen[0].model == found.pose.camera.model else None


def _offset(answer: LocalisedPose, prior: GeoPrior) -> FloatArray:
    """(2,) metres from the camera to the prior, along true east and north."""
    height = answer.geopose.height_m
    place = answer.frame.enu_from_geodetic(np.array([prior.latitude_deg, prior.longitude_deg, height]))
    to_true = answer.frame.true_enu_from_enu(answer.cam_from_local.center)
    return np.asarray((to_true @ (place - answer.cam_from_local.center))[:2], dtype=np.float64)


def contradicts_prior(answer: LocalisedPose, prior: GeoPrior | None) -> str | None:
    """A sentence with the figures if the answer is too far from the prior for both to be right, else None.

    Horizontal only: heights of photos are rarely in a known datum.
    """
    if prior is None:
        return None
    offset = _offset(answer, prior)
    covariance = answer.covariance[3:5, 3:5] + np.eye(2) * prior.sigma_horizontal_m**2
    chi_square = float(offset @ np.linalg.solve(covariance, offset))
    if chi_square <= _CHI_SQUARE_LIMIT:
        return None
    return (
        f"the pose lies {np.linalg.norm(offset):.1f} m from the prior, whose standard deviation is "
        f"{prior.sigma_horizontal_m:.1f} m; chi-square {chi_square:.1f}, limit {_CHI_SQUARE_LIMIT}"
    )


def runner_up(best: PoseCandidate, others: list[PoseCandidate]) -> RunnerUpPose | None:
    """The pose of another place with most inliers.

    Another place is further than 2 m or 5 degrees from the winner. Where two maps gave the poses, three
    standard deviations of their placements come on top: two maps of one place, each placed by GPS, show it
    metres apart. Heights of different datums are not compared.
    """
    winner = best.pose.cam_from_local
    found: list[RunnerUpPose] = []
    for other in others:
        pose = _in_frame_of(best.area, other)
        offset = pose.center - winner.center
        if best.main_map.height_datum != other.main_map.height_datum:
            offset[2] = 0.0
        distance_m = float(np.linalg.norm(offset))
        angle_deg = pose.angle_to_deg(winner)
        apart_m, apart_deg = 2.0, 5.0
        if best.main_map.map_id != other.main_map.map_id:
            placed = placement_covariance(best.area, best.main_map, winner.center) + placement_covariance(
                other.area, other.main_map, other.pose.cam_from_local.center
            )
            apart_m += 3.0 * float(np.sqrt(np.linalg.eigvalsh(placed[3:, 3:])[-1]))
            apart_deg += 3.0 * float(np.degrees(np.sqrt(np.linalg.eigvalsh(placed[:3, :3])[-1])))
        inliers = _support_beside(best, other)
        if inliers and (distance_m > apart_m or angle_deg > apart_deg):
            lat, lon, _ = best.area.frame.geodetic_from_enu(pose.center).tolist()
            found.append(
                RunnerUpPose(inliers=inliers, distance_m=distance_m, angle_deg=angle_deg, lat=lat, lon=lon)
            )
    return max(found, key=lambda rival: rival.inliers, default=None)


def _support_beside(best: PoseCandidate, other: PoseCandidate) -> int:
    """Inliers of the other pose that are not inliers of the best one as well.

    Where a photo leaves the pose soft, as a flat place does with an unknown lens, a second estimate comes to
    lie metres away on the very same matches: it speaks of the covariance, not of another place.
    """
    if best.area is not other.area:
        return other.evidence.inliers
    theirs, ours = (  # one number for each inlier's pair of feature and point
        of.matches.feature[of.rows] * len(of.area.points) + of.matches.point[of.rows] for of in (other, best)
    )
    return int(np.count_nonzero(~np.isin(theirs, ours)))


def _in_frame_of(area: Area, candidate: PoseCandidate) -> Rigid3:
    if candidate.area is area:
        return candidate.pose.cam_from_local
    return candidate.pose.cam_from_local @ candidate.area.frame.enu_from(area.frame)
