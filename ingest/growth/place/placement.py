"""Step: a reconstruction without a place of its own is placed by the existing maps, or refused.

Photos localise by themselves; the similarity that most of them agree with is fitted to all pixels in which
they see existing points; then gates ask whether to believe it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.index.area import Area
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.gates import Gate
from ingest.growth.place.contradictions import center_variance_m2
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.place.parents import ParentOptions, edges_of, parents_covariance
from ingest.growth.place.similarity_fit import (
    FittedSimilarity,
    SimilarityFitOptions,
    agreeing_photos,
    fit_similarity,
    proposals,
    rank_proposals,
    tolerances_px,
)
from ingest.growth.place.visibility import ShownParts, VisibilityOptions, shown_parts
from ingest.growth.values import Edge, LocalisedPhoto, MapsPlacement
from ingest.photos.photo import Photo


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacementOptions:
    """When a placement is believed. `tools/growth_portions.py` prints the figures of real sets.

    Attributes:
        fit: how the similarity is found.
        min_agreeing: photos; one alone proves nothing.
        min_agreeing_share: of the localised photos. Every accepted pose is right with a probability
            above 0.95; a third wrong means that the reconstruction is, or that the place repeats itself.
        max_residual: median distance of centres beyond their own uncertainty, over the viewing distance.
            Models of few photos, bent and with a lens not their own, reached 0.4 %; a placement by a
            look-alike place shows in pixels long before.
        visibility: what a photo must show.
        max_blind: share of photos that show less of the existing points. Single ones are left out
            (`MapsPlacement.blind`).
        parents: when an existing map is one of them.
    """

    fit: SimilarityFitOptions = field(default_factory=SimilarityFitOptions)
    min_agreeing: int = 2
    min_agreeing_share: float = 0.66
    max_residual: float = 0.01
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    max_blind: float = 0.34
    parents: ParentOptions = field(default_factory=ParentOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SupportedPlacement:
    """A placement with what it rests on.

    Attributes:
        correspondences: all of the model's. fit: over those that agree; None where nothing fits.
        used: (m,) correspondences that agree with the placement.
    """

    placement: MapsPlacement
    correspondences: Correspondences
    fit: FittedSimilarity | None
    used: NDArray[np.bool_]


def place_by_maps(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    correspondences: Correspondences,
    photos: Sequence[Photo],
    areas: Sequence[Area],
    frame: LocalFrame,
    options: PlacementOptions,
) -> SupportedPlacement:
    """Place a model by the localisations of its photos.

    Args:
        model: with the lenses that it keeps.
        localised: by row of the photos, in `frame`. Rows that are not in the model are ignored.
        correspondences: of the model, in `frame`.
        photos: all new photos, for their positions.
        areas: that hold the existing maps.
    """
    own = {k: localised[r] for k, r in enumerate(model.rows.tolist()) if r in localised}
    ranked = rank_proposals(
        model, proposals(model, localised, correspondences, options.fit), correspondences, options.fit
    )
    found = None
    if ranked and len(ranked[0][1]) >= 1:
        found = _agreed(model, ranked[0][0], ranked[0][1], own, correspondences, options)
    if found is None:
        return _nowhere(model, own, correspondences, frame, options)
    fit, agree = found
    used = np.isin(correspondences.photo_of, list(agree)) | correspondences.carried
    used &= fit.errors_px < tolerances_px(model, correspondences, options.fit.tolerance_rel)
    maps = {m.map_id: m for area in areas for m in area.maps}
    edges = edges_of(model, fit, correspondences, used, options.parents, options.fit)
    if not edges:
        return _nowhere(model, own, correspondences, frame, options)
    on_earth = parents_covariance([(maps[e.map_id], e.shared_points) for e in edges], frame)
    sim, held = fit.local_from_sfm, correspondences.take(np.flatnonzero(used))
    shows = shown_parts(model, sim, held, areas, frame, options.visibility)
    blind = _blind(shows, agree, own.keys() - agree, options.visibility)
    asked = _ask(model, fit, agree, own, held, shows.existing, edges, photos, frame, on_earth, options)
    refusal = gates.first_refusal(asked)
    placement = MapsPlacement(
        reason=refusal.reason if refusal else None,
        message=refusal.message if refusal else f"placed by {', '.join(e.map_id for e in edges)}",
        frame=frame,
        local_from_sfm=fit.local_from_sfm,
        covariance_relative=fit.covariance,
        covariance=fit.covariance + on_earth,
        agreeing=tuple(int(model.rows[k]) for k in sorted(agree)),
        disagreeing=tuple(int(model.rows[k]) for k in sorted(set(own) - agree)),
        blind=tuple(int(model.rows[k]) for k in sorted(blind)),
        edges=edges,
        residual_rms_m=_rms(_center_offsets(model, fit.local_from_sfm, own, agree)),
        gates=asked,
    )
    return SupportedPlacement(placement=placement, correspondences=correspondences, fit=fit, used=used)


def _blind(shows: ShownParts, agree: set[int], disagree: set[int], options: VisibilityOptions) -> set[int]:
    """Photos that show too little of what they should; those that disagree are left out as such."""
    little = set(np.flatnonzero(shows.with_own < options.min_shown).tolist()) - disagree
    return little | {k for k in agree if shows.existing[k] < options.min_visible}


def _nowhere(
    model: Model,
    own: Mapping[int, LocalisedPhoto],
    correspondences: Correspondences,
    frame: LocalFrame,
    options: PlacementOptions,
) -> SupportedPlacement:
    """Nothing that photos agree upon, or no existing map that would hold them."""
    gate = gates.agreement(0, len(own), options.min_agreeing, options.min_agreeing_share)
    placement = MapsPlacement(
        reason=gate.reason,
        message=f"no placement: {gate.message}",
        frame=frame,
        disagreeing=tuple(int(model.rows[k]) for k in sorted(own)),
        gates=(gate,),
    )
    return SupportedPlacement(
        placement=placement,
        correspondences=correspondences,
        fit=None,
        used=np.zeros(len(correspondences), dtype=np.bool_),
    )


def _agreed(
    model: Model,
    start: Sim3,
    agree: NDArray[np.int64],
    own: Mapping[int, LocalisedPhoto],
    correspondences: Correspondences,
    options: PlacementOptions,
) -> tuple[FittedSimilarity, set[int]] | None:
    """The fit to the photos that agree with it, and these; None where no photo does."""
    tolerance = tolerances_px(model, correspondences, options.fit.tolerance_rel)
    chosen: set[int] = {int(k) for k in agree}
    sim, fit = start, None
    for _ in range(5):  # the set of photos settles in two or three rounds
        near = np.isin(correspondences.photo_of, list(chosen)) | correspondences.carried
        if fit is not None:
            near &= fit.errors_px < 2.0 * tolerance
        if near.sum() < 4:
            return None
        fit = fit_similarity(model, sim, correspondences, near, options.fit)
        sim = fit.local_from_sfm
        agreed = agreeing_photos(fit.errors_px, tolerance, correspondences, options.fit.least_share)
        again = {int(k) for k in agreed} & own.keys()
        if not again:
            return None
        if again == chosen:
            break
        chosen = again
    assert fit is not None
    return fit, chosen


def _center_offsets(
    model: Model, sim: Sim3, own: Mapping[int, LocalisedPhoto], agree: set[int]
) -> FloatArray:
    """(n, 3) metres, from the placed to the localised centres of the photos that agree."""
    return np.array(
        [own[k].cam_from_local.center - sim.act(model.cam_from_sfm[k].center) for k in sorted(agree)]
    ).reshape(-1, 3)


def _ask(
    model: Model,
    fit: FittedSimilarity,
    agree: set[int],
    own: Mapping[int, LocalisedPhoto],
    held: Correspondences,
    shows: FloatArray,
    edges: Sequence[Edge],
    photos: Sequence[Photo],
    frame: LocalFrame,
    on_earth: FloatArray,
    options: PlacementOptions,
) -> tuple[Gate, ...]:
    sim = fit.local_from_sfm
    centers = sim.act(model.centers())
    reach = (
        float(np.median(np.linalg.norm(held.points - centers[held.photo_of], axis=1))) if len(held) else 0.0
    )
    offsets_gps, spreads_gps = _against_positions(model, centers, photos, frame, fit.covariance + on_earth)
    return (
        gates.agreement(len(agree), len(own) - len(agree), options.min_agreeing, options.min_agreeing_share),
        gates.residuals(_typical_excess_m(model, sim, own, agree), reach, options.max_residual),
        gates.geotags(offsets_gps, spreads_gps, by=", ".join(e.map_id for e in edges)),
        gates.visibility(shows[np.isfinite(shows)], options.visibility.min_visible, options.max_blind),
    )


def _against_positions(
    model: Model, centers: FloatArray, photos: Sequence[Photo], frame: LocalFrame, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Horizontal offsets (n, 2) of the placed centres from the photos' positions, covariances (n, 2, 2).

    Heights of photos are rarely in a known datum.
    """
    offsets, spreads = [], []
    for center, row in zip(centers, model.rows.tolist(), strict=True):
        gps = photos[row].gps
        if gps is None:
            continue
        height = float(frame.geodetic_from_enu(center)[2])
        place = frame.enu_from_geodetic([gps.latitude_deg, gps.longitude_deg, height])
        jacobian = point_jacobian(center)[:2]
        offsets.append((center - place)[:2])
        spreads.append(jacobian @ covariance @ jacobian.T + np.eye(2) * gps.sigma_horizontal_m**2)
    return np.array(offsets).reshape(-1, 2), np.array(spreads).reshape(-1, 2, 2)


def _typical_excess_m(model: Model, sim: Sim3, own: Mapping[int, LocalisedPhoto], agree: set[int]) -> float:
    """Median distance of the localised centres from the placed ones beyond what they are uncertain by.

    Photos at the rim of a map are localised badly, which bends no model.
    """
    if not agree:
        return float("nan")
    squares = (_center_offsets(model, sim, own, agree) ** 2).sum(axis=1)
    own_m2 = np.array([center_variance_m2(own[k]) for k in sorted(agree)])
    return float(np.sqrt(np.median(np.maximum(squares - own_m2, 0.0))))


def _rms(offsets: FloatArray) -> float:
    """Root mean square length of (n, 3)."""
    return float(np.sqrt((offsets**2).sum(axis=1).mean())) if len(offsets) else float("nan")
