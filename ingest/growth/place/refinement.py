"""Step: a placed reconstruction is refined, and photos that do not hold firmly enough are left out.

Photos are left out that contradict the placement before or after, that hang on the others by little, and that
may be further off than allowed; the others are adjusted without them, and say anew how sure they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.colmap.anchored import Anchored, Lenses
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.place.contradictions import ContradictionOptions, contradicting_photos
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.place.drift import (
    DriftOptions,
    PhotoSpread,
    bending_variance_m2,
    center_covariances,
    photo_covariances,
    shared_turn,
    turning_covariance,
)
from ingest.growth.place.parents import edges_of
from ingest.growth.place.placement import PlacementOptions, SupportedPlacement
from ingest.growth.place.refine import (
    RefineOptions,
    only_photos,
    refine_with_maps,
    with_existing,
    without_photos,
)
from ingest.growth.place.similarity_fit import FittedSimilarity, fit_similarity
from ingest.growth.values import LocalisedPhoto, MapsPlacement, Refused
from ingest.sfm.links import bottleneck_share

# Reasons of photos that nothing holds well enough, of those that hang on others by little, and of those that
# their own localisation has elsewhere.
LOOSE, WEAK_LINK, CONTRADICTS, BLIND = "DRIFT_BUDGET", "WEAK_LINK", "CONTRADICTS", "NOT_VISIBLE"
_SHOWS_LITTLE = "the photo shows too little of what existing maps say it should show from where it would be"
_ELSEWHERE = "the photo by itself sees existing points elsewhere than the others put it"


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementOptions:
    """Which photos of a placed reconstruction are kept.

    Attributes:
        refine: the adjustment.
        min_link: `bottleneck_share` that photos need which are not localised themselves. In simulated
            communities photos tied to look-alike halls, 68 and 78 m off, had 0.15 and 0.04; right photos
            nearly all 0.46 and more, single ones 0.14. Those wait, and are localised by themselves once their
            neighbours are in an active map.
        max_photo_bound_m: photos that may be further off (95 %), against the existing points and with what
            their lens leaves open, are left out: a photo hangs on its neighbours by a corner sometimes.
        max_rounds: of leaving such photos out; the others are adjusted without them.
        contradiction: when a photo's own localisation is elsewhere than the refined reconstruction has it.
        drift: how far the refined reconstruction may bend beyond what holds it.
    """

    refine: RefineOptions = field(default_factory=RefineOptions)
    min_link: float = 0.25
    max_photo_bound_m: float = 0.5
    max_rounds: int = 4
    contradiction: ContradictionOptions = field(default_factory=ContradictionOptions)
    drift: DriftOptions = field(default_factory=DriftOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """A refined reconstruction.

    Attributes:
        model: of the photos that are kept, in metres, in the placement's frame; existing points that at least
            two of them see are its own.
        placement: with the gates asked here and the covariances of the refined model.
        spread: of the photos that are kept.
        bending_m, turning_deg: what the photos' positions and the directions of its pieces lack beyond the
            similarity, one sigma along the worst axis.
        shared_turn: (7, 3) of `photo_spread.shared_turn`.
        left_out: photos that are not kept although they agree, by row, with reason and message.
    """

    model: Model
    placement: MapsPlacement
    spread: PhotoSpread
    bending_m: float
    turning_deg: float
    shared_turn: FloatArray
    left_out: Mapping[int, tuple[str, str]]

    def evidence(self) -> dict[str, Any]:
        """What a map's evidence of growth says of it."""
        return {
            "bending_m": self.bending_m,
            "turning_deg": self.turning_deg,
            "shared_turn": self.shared_turn.ravel().tolist(),
        }


def refine_placed(
    model: Model,
    held: SupportedPlacement,
    correspondences: Correspondences,
    localised: Mapping[int, LocalisedPhoto],
    keypoints: Sequence[FloatArray],
    lenses: Lenses,
    placing: PlacementOptions,
    options: RefinementOptions,
) -> Refinement | Refused:
    """Refine an accepted placement with the existing points held fixed.

    Args:
        localised: the model's photos that the existing maps localise, by row.
        keypoints: pixels of all features of the model's photos, in the order of its rows.
        placing: how the similarity was fitted, and when it is believed.
    """
    placement = held.placement
    assert placement.local_from_sfm is not None
    assert held.fit is not None
    rows = tuple(int(r) for r in model.rows)
    outside = [rows.index(r) for r in (*placement.disagreeing, *placement.blind)]
    holding = [rows.index(r) for r in placement.agreeing if r not in placement.blind]
    weak = weak_photos(model, outside, holding, options.min_link)
    left_out = dict.fromkeys(placement.disagreeing, (CONTRADICTS, _ELSEWHERE))
    left_out |= dict.fromkeys(placement.blind, (BLIND, _SHOWS_LITTLE))
    left_out |= {rows[k]: (WEAK_LINK, message) for k, message in weak.items()}
    outside += sorted(weak)
    for _ in range(options.max_rounds):
        good = correspondences.take(np.flatnonzero(held.used & ~np.isin(correspondences.photo_of, outside)))
        adjusted, fixed, sharp = refine_with_maps(
            without_photos(model, outside),
            placement.local_from_sfm,
            good,
            lenses,
            keypoints,
            options.refine,
        )
        spread = photo_covariances(
            adjusted.model,
            keypoints,
            fixed,
            adjusted.fixed_kept,
            lenses,
            options.refine.adjust,
            options.drift,
        )
        held_pixels = good.take(sharp)
        fit = fit_similarity(adjusted.model, Sim3.identity(), held_pixels, adjusted.fixed_kept, placing.fit)
        inside = {rows.index(r): localised[r] for r in placement.agreeing if rows.index(r) not in outside}
        against = contradicting_photos(
            adjusted.model, inside, spread.poses, (held.fit, fit), options.contradiction
        )
        loose = {
            k: message
            for k, message in loose_photos(adjusted.model, spread.poses, options.max_photo_bound_m).items()
            if k not in outside and k not in against
        }
        left_out |= {rows[k]: (CONTRADICTS, message) for k, message in against.items()}
        left_out |= {rows[k]: (LOOSE, message) for k, message in loose.items()}
        outside += sorted({**against, **loose})
        if not (against or loose) or len(outside) > len(rows) - 2:
            break
    if loose:
        message = f"hardly a photo is held well enough: {next(iter(loose.values()))}"
        return _refused(LOOSE, message, rows, placement)
    if against:
        message = f"photos contradict the others again and again: {next(iter(against.values()))}"
        return _refused(CONTRADICTS, message, rows, placement)
    asked = _with_fit(placement, adjusted, held_pixels, fit, placing)
    whole = with_existing(adjusted, fixed, held_pixels, asked.parents)
    for k in sorted(set(range(len(rows))) - set(outside) - set(whole.photo_of.tolist())):
        left_out[rows[k]] = LOOSE, "the photo shows nothing that another photo of the map shows as well"
        outside.append(k)
    asked = _agreeing_still(asked, outside, left_out, rows)
    gate = gates.agreement(
        len(asked.agreeing), len(asked.disagreeing), placing.min_agreeing, placing.min_agreeing_share
    )
    if not gate.passes:
        return _refused(gate.reason, f"once refined, {gate.message}", rows, asked)
    turning = turning_covariance(adjusted.model, fit.covariance, spread)
    bending_m2 = bending_variance_m2(adjusted.model, fit.covariance + turning, spread.poses)
    kept = [k for k in range(len(rows)) if k not in outside]
    return Refinement(
        model=only_photos(whole, kept),
        placement=_widened(asked, turning + np.diag([0.0] * 4 + [bending_m2] * 3)),
        spread=spread.of(kept),
        bending_m=float(np.sqrt(bending_m2)),
        turning_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(turning[1:4, 1:4])[-1]))),
        shared_turn=shared_turn(adjusted.model, spread),
        left_out=left_out,
    )


def _agreeing_still(
    placement: MapsPlacement,
    outside: Sequence[int],
    left_out: Mapping[int, tuple[str, str]],
    rows: tuple[int, ...],
) -> MapsPlacement:
    """The placement with the photos that agree once it is refined, and with those that contradict it then."""
    against = {r for r, (reason, _) in left_out.items() if reason == CONTRADICTS}
    return replace(
        placement,
        agreeing=tuple(r for r in placement.agreeing if rows.index(r) not in outside),
        disagreeing=tuple(sorted({*placement.disagreeing, *against})),
    )


def _refused(reason: str, message: str, rows: tuple[int, ...], placement: MapsPlacement) -> Refused:
    return Refused(reason=reason, message=message, rows=rows, gates=placement.gates)


def _with_fit(
    placement: MapsPlacement,
    adjusted: Anchored,
    correspondences: Correspondences,
    fit: FittedSimilarity,
    options: PlacementOptions,
) -> MapsPlacement:
    """The placement with the covariances of the refined model's fit.

    Until then the reconstruction was bent as it came, and its residuals said more of that than of where it
    lies. What photos lack beyond the similarity is added to it afterwards.
    """
    edges = edges_of(adjusted.model, fit, correspondences, adjusted.fixed_kept, options.parents, options.fit)
    if {e.map_id for e in edges} != set(placement.parents):  # a parent that hardly held: as it was
        edges = placement.edges
    assert placement.covariance is not None
    assert placement.covariance_relative is not None
    on_earth = placement.covariance - placement.covariance_relative
    return replace(
        placement,
        edges=edges,
        covariance_relative=fit.covariance,
        covariance=fit.covariance + on_earth,
    )


def _widened(placement: MapsPlacement, bending: FloatArray) -> MapsPlacement:
    """The placement with its covariance relative to the existing maps widened by what bending adds (7, 7)."""
    assert placement.covariance is not None
    assert placement.covariance_relative is not None
    wider = placement.covariance_relative + bending
    on_earth = placement.covariance - placement.covariance_relative
    return replace(placement, covariance_relative=wider, covariance=wider + on_earth)


def weak_photos(model: Model, outside: Sequence[int], held: Sequence[int], min_link: float) -> dict[int, str]:
    """Photos that hang on those that are held by too little, and how little.

    Args:
        outside: photos that do not count. held: photos that are localised and agree.
    """
    firm = bottleneck_share(model, held, outside)
    return {
        k: f"{100 * firm[k]:.1f} % of its points tie the photo to those that are localised, "
        f"{100 * min_link:.0f} % needed: look-alike places tie photos so"
        for k in np.flatnonzero(firm < min_link).tolist()
        if k not in outside
    }


def loose_photos(model: Model, spread: FloatArray, max_bound_m: float) -> dict[int, str]:
    """Photos that may be further off than the bound (95 %) against the existing points, and how far.

    Args:
        spread: (k, 6, 6) of `PhotoSpread`; photos that see nothing any more are loose, unless none was asked.
    """
    if not np.isfinite(spread).any():
        return {}
    bounds = np.full(len(spread), np.inf)
    seen = np.isfinite(spread[:, 0, 0])
    centers = center_covariances(model, spread)[seen]
    bounds[seen] = 1.96 * np.sqrt(np.maximum(np.linalg.eigvalsh(centers)[:, -1], 0.0))
    return {
        k: f"the photo may be {bounds[k]:.2f} m off, {max_bound_m:.2f} m are allowed"
        for k in np.flatnonzero(bounds > max_bound_m).tolist()
    }
