"""A map of street photos placed on a scan by its fronts, the ground and what it sees of roofs.

Search in plan, then points to planes of the solid that the scan shows: docs/measurements/ground-and-air.md.
"""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import rel_entr
from scipy.stats import binom

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.ground.scan_shape import CELL_M, ScanShape, SolidFit, fitted, laid, shape_of
from ingest.register.anchor.ground.search import SIZE_STEP, TURN_STEP, Geotags, PlanSearch
from ingest.register.anchor.ground.street_plan import StreetPlan, parts, street_plan
from ingest.register.anchor.start.from_ortho import PlanTry
from ingest.register.frame.dense.confirmation import JointEvidence
from ingest.register.outcome import Outcome

_LOG = logging.getLogger(__name__)

_LOG_RATE = 3.0  # one map of a thousand that lies elsewhere is placed wrongly
_RIVAL_RATE = 1e-3  # how often another place that is as good would agree in so many fewer blocks
_AGREE_M, _NEAR_M = 0.3, 1.0  # of a point from the solid: across its plane, and from what is known of it
_ABOVE_M = 1.0  # over the ground: the ground agrees everywhere
_PLACE_M = 3.0  # side of what counts as one place: what lies closer together errs together
_EYE_M, _EYE_SIGMA_M = 1.6, 0.3  # of people over the ground as a scan has it, in the median
_LOWEST_M, _HIGHEST_M = 0.5, 3.0  # and where a fit may leave it
_THROUGH = 0.5  # of the views go through buildings: nobody stands there
_NEAREST_M, _FURTHEST_M = 3.0, 100.0  # medians from which people take photos of fronts
_COARSE, _ASKED, _FINE = 400, 1500, 4000  # points of a fit, of a place's evidence, of the last fit
_COARSE_WIDTHS_M = (2.0, 2.0, 1.5, 1.5, 1.0, 1.0, 0.7, 0.5, 0.5, 0.5)
_FINE_WIDTHS_M = (1.5, 1.0, 0.7, 0.5, 0.5, 0.3, 0.3, 0.2, 0.2, 0.15, 0.15, 0.15)
_START_SIGMA = (0.1, 0.03, 0.03, 0.1)  # of size and angles of a start
_AGAIN_M, _AGAIN_SIZE = 2.0, 0.05  # from so far around the best place it is fitted again
_AROUND_M = 100.0  # of the geotags' middle: what people see from where they may be
_APART_M = 3.0  # of a map's points, in the median: another place
_ALIKE = 0.4  # logarithm: sizes that are compared point by point; a small map agrees within any wall
_ELSEWHERE_M = 8.0  # likewise: a place that shares nothing with the best
_ROUNDS = 3  # of photos left out and the fit
_TIED = 0.5  # of a photo's points that others see which stay
_LEAST_PHOTOS = 10  # of two maps of eight one was accepted outside its 99.9 % bound
_RIVALS = 20  # the best of other places that are compared one by one
_LEAST_TRIES = 20  # elsewhere: fewer do not tell what chance gives
_LIKE_SIZE = 0.5  # logarithm: sizes at which chance is alike; of a smaller map more agrees anywhere
_TAIL = 0.25  # share of the places elsewhere whose scores are taken for the tail of what chance gives
_TOGETHER = 2.5  # mean of such a tail, at least: the median of eight searches without a right place was 2.4
# Information of no eaves, over that of all points: 0.15 m, where a hundred points, of 0.1 m, err together.
_EAVES = 5e-3
_LEAST_SIGMA_M = 0.05  # of a point

GroundReason = Literal[
    "NO_SCAN",  # it shows nothing that stands
    "STRUCTURE",  # the map shows no fronts, or they agree no better than chance
    "TOO_FEW_FRAMES",  # of its photos lie on the scan
    "AMBIGUOUS",  # another place agrees nearly as well
]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundPlace(Outcome[GroundReason]):
    """Where a map lies, or why that is not known; `message` has words on the evidence where it is placed.

    Attributes:
        local_from_own: similarity. covariance: (7, 7) of its left perturbation.
        image_ids: of the photos that lie there. residual_rms_m: of the points that agree.
    """

    local_from_own: Sim3 | None = None
    covariance: FloatArray | None = None
    image_ids: tuple[int, ...] = ()
    residual_rms_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tried:
    """A fitted place, and which of the plan's points agree there: those above the ground count."""

    fit: SolidFit
    agrees: NDArray[np.bool_]
    above: NDArray[np.bool_]
    evidence: JointEvidence


def place_on_outlines(unplaced: UnplacedMap, cloud: PointCloud) -> GroundPlace:
    """Place a map of street photos on all of a scan, or else the first of its parts that lies somewhere."""
    whole: GroundPlace | None = None
    for number, part in enumerate(parts(unplaced, _LEAST_PHOTOS), start=1):
        found = _place(part, cloud, number * (number + 1))  # the inverses of these add up to one
        if found.reason is None:
            return found
        whole = whole or found
    assert whole is not None
    return whole


def _place(unplaced: UnplacedMap, cloud: PointCloud, tests: int) -> GroundPlace:
    """Place it as a whole; `tests`: so many times more may chance deceive."""
    tags = geotags_of(unplaced, cloud)
    around = None if tags is None else tags.around(_AROUND_M)
    plan, shape = street_plan(unplaced), shape_of(cloud, around)
    if plan is None:
        return GroundPlace(reason="STRUCTURE", message="it shows no fronts")
    if shape is None or not len(shape.walls):
        return GroundPlace(reason="NO_SCAN", message="the scan shows no fronts")
    there = _tried(plan, shape, PlanSearch(shape), tags)
    if len(there) < _LEAST_TRIES:
        return GroundPlace(reason="STRUCTURE", message="it fits hardly anywhere on the scan")
    return _judged(unplaced, plan, shape, tags, there, tests)


def geotags_of(unplaced: UnplacedMap, cloud: PointCloud) -> Geotags | None:
    """Where the map's photos say they were taken; None where fewer than two do."""
    told = [(k, image.gps) for k, image in enumerate(unplaced.images) if image.gps is not None]
    if len(told) < 2:
        return None
    geodetic = np.array([(tag.latitude_deg, tag.longitude_deg, cloud.frame.height_m) for _, tag in told])
    return Geotags(
        rows=np.array([k for k, _ in told]),
        xy=cloud.frame.enu_from_geodetic(geodetic)[:, :2],
        sigma_m=np.array([max(tag.sigma_horizontal_m, 5.0) for _, tag in told]),
    )


def _tried(plan: StreetPlan, shape: ScanShape, search: PlanSearch, tags: Geotags | None) -> list[_Tried]:
    sizes = np.exp(np.arange(np.log(_NEAREST_M), np.log(_FURTHEST_M), SIZE_STEP)) / plan.distance
    turns = np.arange(0.0, 2.0 * np.pi, TURN_STEP)
    rows = np.random.default_rng(0).permutation(len(plan.points))[:_COARSE]
    found = search.tries(plan, sizes.tolist(), turns.tolist(), tags)
    fits = [_fitted(plan, shape, _start(plan, shape, one), rows, _COARSE_WIDTHS_M) for one in found]
    asked = np.random.default_rng(0).permutation(len(plan.points))[:_ASKED]
    return [_asked(shape, laid(shape, plan.points[asked], fit.local_from_own, fit.eaves_m)) for fit in fits]


def _eyes_m(centers: FloatArray, shape: ScanShape, sim: Sim3) -> float:
    """How high over the ground cameras (n, 3) are, in the median."""
    placed = sim.act(centers)
    return float(np.median(placed[:, 2] - shape.ground[shape.cells(placed[:, :2])]))


def _through(plan: StreetPlan, shape: ScanShape, sim: Sim3) -> float:
    """Share of the views that would go through buildings."""
    level = np.zeros((len(plan.free), 1))
    ends = (sim.act(np.hstack([plan.free[:, part], level]))[:, :2] for part in (slice(2), slice(2, 4)))
    return shape.through(np.hstack([*ends]))


def _chance(there: Sequence[_Tried]) -> FloatArray:
    """(n,) share of a map's places that agrees by chance, at the size of each of the tries."""
    size = np.log([one.fit.local_from_own.scale for one in there])
    alike = np.exp(-0.5 * np.square((size[:, None] - size) / _LIKE_SIZE))
    agreeing = np.array([one.evidence.agreeing for one in there])
    places = np.array([one.evidence.places for one in there], dtype=np.float64)
    return np.asarray(alike @ agreeing / np.maximum(alike @ places, 1.0))


def _score(one: _Tried, rate: float) -> float:
    """Logarithm of how much likelier what agrees is at its own share than at what chance gives; 0 below."""
    places, agreeing = one.evidence.places, one.evidence.agreeing
    if agreeing <= rate * places:
        return 0.0
    return float(rel_entr(agreeing, rate * places) + rel_entr(places - agreeing, (1.0 - rate) * places))


def _start(plan: StreetPlan, shape: ScanShape, one: PlanTry) -> Sim3:
    """The plan there, its cameras at the eyes of people who stand on the scan's ground."""
    rotation = so3_exp([0.0, 0.0, one.turn])
    centers = one.size * plan.centers @ rotation.T + np.append(one.middle, 0.0)
    up = float(np.median(shape.ground[shape.cells(centers[:, :2])] + _EYE_M - centers[:, 2]))
    return Sim3(scale=one.size, rotation=rotation, translation=np.append(one.middle, up))


def _fitted(
    plan: StreetPlan, shape: ScanShape, start: Sim3, rows: NDArray[np.int64], widths: tuple[float, ...]
) -> SolidFit:
    known = [*(len(rows) * 0.1 / np.square(_START_SIGMA)), 1e-3, 1e-3, 1e-3, _EAVES * len(rows)]
    return fitted(shape, plan.points[rows], start, np.diag(known), widths)


def _asked(shape: ScanShape, fit: SolidFit) -> _Tried:
    placed = fit.placed
    agrees = (np.abs(fit.off_m) < _AGREE_M) & (fit.near_m < _NEAR_M)
    above = (placed[:, 2] - shape.ground[shape.cells(placed[:, :2])] > _ABOVE_M) & shape.inside(placed[:, :2])
    evidence = JointEvidence.of_cells(np.floor(placed[above] / _PLACE_M).astype(np.int64), agrees[above])
    return _Tried(fit=fit, agrees=agrees, above=above, evidence=evidence)


def _judged(
    unplaced: UnplacedMap,
    plan: StreetPlan,
    shape: ScanShape,
    tags: Geotags | None,
    there: Sequence[_Tried],
    tests: int,
) -> GroundPlace:
    """The photos that lie there, fitted, and whether another place explains them as well."""
    chance = _chance(there)
    eyes_m = np.array([_eyes_m(plan.centers, shape, one.fit.local_from_own) for one in there])
    seen = np.array([_through(plan, shape, one.fit.local_from_own) for one in there]) < _THROUGH
    stands = np.flatnonzero((eyes_m > _LOWEST_M) & (eyes_m < _HIGHEST_M) & seen)
    if not len(stands):
        words = "nowhere would its cameras be as high as people hold them, and see what they show"
        return GroundPlace(reason="STRUCTURE", message=words)
    there, chance = [there[k] for k in stands.tolist()], chance[stands]
    scores = np.array([_score(one, share) for one, share in zip(there, chance, strict=True)])
    scores -= 0.5 * np.square((eyes_m[stands] - _EYE_M) / _EYE_SIGMA_M)
    if tags is not None:
        scores += [tags.log_likelihood(one.fit.local_from_own.act(plan.centers)[:, :2]) for one in there]
    first = int(scores.argmax())
    rate = float(chance[first])
    final, kept = _settled(unplaced, plan, shape, there[first], rate)
    if kept.sum() < _LEAST_PHOTOS:
        few = f"{int(kept.sum())} of its photos lie on the scan"
        return GroundPlace(reason="TOO_FEW_FRAMES", message=few)
    sim = final.fit.local_from_own
    high_m = _eyes_m(plan.centers[kept], shape, sim)
    if not _LOWEST_M < high_m < _HIGHEST_M:
        words = (
            f"its cameras would be {high_m:.1f} m over the ground, {_LOWEST_M} to {_HIGHEST_M} m are usual"
        )
        return GroundPlace(reason="STRUCTURE", message=words)
    rows = _rows_seen(unplaced, plan, kept)
    there_m = (one.fit.local_from_own.act(plan.points[rows]) - sim.act(plan.points[rows]) for one in there)
    away = np.array([float(np.median(np.linalg.norm(off, axis=1))) for off in there_m])
    log_nfa = _log_nfa(scores[first], scores[away > _ELSEWHERE_M]) - float(np.log10(tests))
    apart = [one for one, far in zip(there, away, strict=True) if far > _APART_M]
    rival = _best_rival(plan, shape, rows, final.fit, apart, rate)
    figures = {"photos": int(kept.sum()), "of": len(kept), "rate": rate, "log_nfa": log_nfa, "rival": rival}
    words = (
        f"{int(kept.sum())} of {len(kept)} photos lie on the scan's outlines: "
        f"{final.evidence.agreeing:.0f} of {final.evidence.places} places agree"
    )
    covariance, rms_m = _covariance(final)
    found = GroundPlace(
        reason=None,
        message=words,
        local_from_own=sim @ plan.upright_from_own,
        covariance=covariance,
        image_ids=tuple(i.image_id for i, stays in zip(unplaced.images, kept, strict=True) if stays),
        residual_rms_m=rms_m,
        figures=figures | asdict(final.evidence),
    )
    if log_nfa < _LOG_RATE:
        return replace(found, reason="STRUCTURE", message=f"{words}, which chance gives, too")
    if rival > _RIVAL_RATE:
        return replace(found, reason="AMBIGUOUS", message=f"{words}, and nearly as many at another place")
    return found


def _settled(
    unplaced: UnplacedMap, plan: StreetPlan, shape: ScanShape, best: _Tried, rate: float
) -> tuple[_Tried, NDArray[np.bool_]]:
    """The finest fit from the best place, and which photos lie there."""
    kept = np.ones(len(unplaced.images), dtype=bool)
    final = _best_around(plan, shape, best, rate)
    sim = final.fit.local_from_own
    for _ in range(_ROUNDS):
        rows = _rows_seen(unplaced, plan, kept)
        if len(rows) < _COARSE // 10:
            break
        final = _asked(shape, _fitted(plan, shape, sim, rows, _FINE_WIDTHS_M))
        sim = final.fit.local_from_own
        kept = _lie_there(unplaced, plan, shape, final.fit, rate)
    return final, kept


def _log_nfa(best: float, elsewhere: FloatArray) -> float:
    """-log10 of how many of so many places elsewhere would agree as well.

    The tail of logarithms of likelihoods is exponential, of mean 1 where all places of a map agree by
    themselves, and of more as those of one wall agree together: a mean that its members tell no better than
    so many can (Lomax).
    """
    if len(elsewhere) < _LEAST_TRIES:
        return 0.0
    start = float(np.quantile(elsewhere, 1.0 - _TAIL))
    tail = elsewhere[elsewhere >= start] - start
    mean = max(float(tail.mean()), _TOGETHER)
    further = max(best - start, 0.0) / (len(tail) * mean)
    return float(len(tail) * np.log10(1.0 + further) - np.log10(len(tail)))


def _best_around(plan: StreetPlan, shape: ScanShape, best: _Tried, rate: float) -> _Tried:
    """The best of fits from around a place: along a street it may have caught on a wrong corner."""
    rows = np.random.default_rng(1).permutation(len(plan.points))[: 2 * _COARSE]
    sim = best.fit.local_from_own
    starts = [sim]
    for turn in np.arange(8) * np.pi / 4:
        shift = _AGAIN_M * np.array([np.cos(turn), np.sin(turn), 0.0])
        starts.append(Sim3.shift(shift) @ sim)
    for size in (-_AGAIN_SIZE, _AGAIN_SIZE):
        starts.append(Sim3.exp([size, *[0.0] * 6]).about(best.fit.middle) @ sim)
    tried = [_asked(shape, _fitted(plan, shape, start, rows, _COARSE_WIDTHS_M)) for start in starts]
    return max(tried, key=lambda one: _score(one, rate))


def _rows_seen(unplaced: UnplacedMap, plan: StreetPlan, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the plan's points that photos see which stay."""
    observations = unplaced.observations
    stays = kept[unplaced.image_rows(observations.image_id)]
    seen = np.zeros(len(unplaced.points.xyz), dtype=bool)
    seen[observations.point_index[stays]] = True
    rows = np.flatnonzero(seen[plan.rows])
    return np.asarray(np.random.default_rng(0).permutation(rows)[:_FINE], dtype=np.int64)


def _lie_there(
    unplaced: UnplacedMap, plan: StreetPlan, shape: ScanShape, fit: SolidFit, rate: float
) -> NDArray[np.bool_]:
    """Which photos lie where the fit puts them: their points agree, and others that stay see them."""
    asked = _asked(shape, laid(shape, plan.points, fit.local_from_own, fit.eaves_m))
    point_of = np.full(len(unplaced.points.xyz), -1)
    point_of[plan.rows] = np.arange(len(plan.rows))
    observations = unplaced.observations
    row, image = point_of[observations.point_index], unplaced.image_rows(observations.image_id)
    row, image = row[row >= 0], image[row >= 0]
    counted = asked.above[row]
    count = np.bincount(image[counted], minlength=len(unplaced.images))
    agreeing = np.bincount(image[counted], asked.agrees[row[counted]], minlength=len(unplaced.images))
    share = agreeing / np.maximum(count, 1)
    usual = float(np.average(share, weights=share * count)) if agreeing.sum() > 0 else 0.0
    stays = (share >= 0.5 * (usual + rate)) & (count > 0)
    seen = np.maximum(np.bincount(image, minlength=len(stays)), 1)
    while stays.any():
        views = np.bincount(row[stays[image]], minlength=len(plan.rows))
        others = views[row] - stays[image] >= 1
        tied = np.bincount(image, others, minlength=len(stays)) / seen
        left = stays & (tied >= _TIED)
        if (left == stays).all():
            break
        stays = left
    return stays


def _best_rival(
    plan: StreetPlan,
    shape: ScanShape,
    rows: NDArray[np.int64],
    fit: SolidFit,
    apart: Sequence[_Tried],
    rate: float,
) -> float:
    """`_rival_p` of the best of the places apart from a fit that are of about its size; 0 without any."""
    size = fit.local_from_own.scale
    sized = [one for one in apart if abs(np.log(one.fit.local_from_own.scale / size)) < _ALIKE]
    best = sorted(sized, key=lambda one: _score(one, rate))[-_RIVALS:]
    return max((_rival_p(plan, shape, rows, fit, one.fit) for one in best), default=0.0)


def _rival_p(
    plan: StreetPlan, shape: ScanShape, rows: NDArray[np.int64], fit: SolidFit, other: SolidFit
) -> float:
    """How often a place as good as another would agree in so many more blocks of the map."""
    own, rival = (
        _asked(shape, laid(shape, plan.points[rows], of.local_from_own, of.eaves_m)) for of in (fit, other)
    )
    counted = own.above
    block = np.floor(own.fit.placed[counted] / _PLACE_M).astype(np.int64)
    group = np.unique(block, axis=0, return_inverse=True)[1].reshape(-1)
    more = np.bincount(group, own.agrees[counted]) - np.bincount(group, (rival.agrees & rival.above)[counted])
    size = np.bincount(group)
    wins, losses = int((more > 0.25 * size).sum()), int((more < -0.25 * size).sum())
    return float(binom.sf(wins - 1, wins + losses, 0.5)) if wins + losses else 1.0


def _covariance(final: _Tried) -> tuple[FloatArray, float]:
    """(7, 7) of the left perturbation: neighbours err together, all within a cell."""
    fit, agrees = final.fit, final.agrees
    rms_m = float(np.sqrt(np.mean(np.square(fit.off_m[agrees])))) if agrees.any() else _AGREE_M
    blocks = len(np.unique(np.floor(fit.placed[agrees] / _PLACE_M).astype(np.int64), axis=0))
    factor = max(1.0, np.count_nonzero(agrees) / max(blocks, 1))
    inverse = np.linalg.inv(fit.normal + np.diag([1e-6] * 7 + [_EAVES * len(fit.placed)]))[:7, :7]
    covariance = factor * max(rms_m, _LEAST_SIGMA_M) ** 2 * inverse
    covariance[4:, 4:] += np.eye(3) * CELL_M**2 / 12.0
    return Sim3.shift(fit.middle).carried(covariance), rms_m
