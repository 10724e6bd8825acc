"""Step: a reconstruction without a place of its own is placed by the existing maps, or refused.

Photos localise by themselves; the similarity that most of them agree with is fitted to all pixels in which
they see existing points; then gates ask whether to believe it. `tools/growth_portions.py` prints the figures
of real sets.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.lineage import GROWTH
from featuredb.maps.move import covariance_in_frame
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.place.contradictions import center_variance_m2
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.place.similarity_fit import (
    FittedSimilarity,
    agreeing_photos,
    best_proposal,
    fit_similarity,
    tolerances_px,
)
from ingest.growth.place.visibility import LEAST_SHOWN, shown_parts
from ingest.growth.values import LEAST_SHARED_POINTS, Edge, LocalisedPhoto, MapsPlacement
from ingest.photos.photo import Photo

_LEAST_PHOTOS = 2  # of the new ones that must see an existing map for it to be a parent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SupportedPlacement:
    """A placement with what it rests on.

    Attributes:
        fit: over the correspondences that agree; None where nothing fits.
        used: (m,) correspondences that agree with the placement.
    """

    placement: MapsPlacement
    fit: FittedSimilarity | None
    used: NDArray[np.bool_]


def place_by_maps(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    correspondences: Correspondences,
    photos: Sequence[Photo],
    areas: Sequence[Area],
    frame: LocalFrame,
) -> SupportedPlacement:
    """Place a model by the localisations of its photos.

    Args:
        model: with the lenses that it keeps.
        localised: of the model's photos, by row of the photos, in `frame`; so are the correspondences.
        photos: all new photos, for their positions.
        areas: that hold the existing maps.
    """
    own = {k: localised[r] for k, r in enumerate(model.rows.tolist()) if r in localised}
    found = _agreed(model, own, correspondences)
    edges: tuple[Edge, ...] = ()
    if found is not None:
        fit, agree = found
        used = np.isin(correspondences.photo_of, list(agree)) | correspondences.carried
        used &= fit.errors_px < tolerances_px(model, correspondences)
        edges = edges_of(model, fit, correspondences, used)
    if found is None or not edges:
        return _nowhere(model, own, frame, len(correspondences))
    maps = {m.map_id: m for area in areas for m in area.maps}
    on_earth = parents_covariance([(maps[e.map_id], e.shared_points) for e in edges], frame)
    sim, held = fit.local_from_sfm, correspondences.take(np.flatnonzero(used))
    existing, with_own = shown_parts(model, sim, held, areas, frame)
    disagree = own.keys() - agree
    # Those that disagree are left out as such.
    blind = set(np.flatnonzero(with_own < LEAST_SHOWN).tolist()) - disagree
    blind |= {k for k in agree if existing[k] < gates.LEAST_VISIBLE}
    centers, offsets = sim.act(model.centers()), _center_offsets(model, sim, own, agree)
    reach = float(np.median(np.linalg.norm(held.points - centers[held.photo_of], axis=1)))
    positions = _against_positions(model, centers, photos, frame, fit.covariance + on_earth)
    parents = ", ".join(e.map_id for e in edges)
    asked = (
        gates.agreement(len(agree), len(disagree)),
        gates.residuals(_typical_excess_m(offsets, [own[k] for k in sorted(agree)]), reach),
        gates.geotags(*positions, by=parents),
        gates.visibility(existing[np.isfinite(existing)]),
    )
    refusal = gates.first_refusal(asked)
    placement = MapsPlacement(
        reason=refusal.reason if refusal else None,
        message=refusal.message if refusal else f"placed by {parents}",
        frame=frame,
        local_from_sfm=sim,
        covariance_relative=fit.covariance,
        on_earth=on_earth,
        agreeing=_rows(model, agree),
        disagreeing=_rows(model, disagree),
        blind=_rows(model, blind),
        edges=edges,
        residual_rms_m=float(np.sqrt((offsets**2).sum(axis=1).mean())),
        gates=asked,
    )
    return SupportedPlacement(placement=placement, fit=fit, used=used)


def _rows(model: Model, photos: Collection[int]) -> tuple[int, ...]:
    return tuple(int(model.rows[k]) for k in sorted(photos))


def _nowhere(model: Model, own: Collection[int], frame: LocalFrame, count: int) -> SupportedPlacement:
    """Nothing that photos agree upon, or no existing map that would hold them."""
    gate = gates.agreement(0, len(own))
    placement = MapsPlacement(
        reason=gate.reason,
        message=f"no placement: {gate.message}",
        frame=frame,
        disagreeing=_rows(model, own),
        gates=(gate,),
    )
    return SupportedPlacement(placement=placement, fit=None, used=np.zeros(count, dtype=np.bool_))


def _agreed(
    model: Model, own: Mapping[int, LocalisedPhoto], correspondences: Correspondences
) -> tuple[FittedSimilarity, set[int]] | None:
    """The fit to the photos that agree with it, and these; None where no photo does."""
    best = best_proposal(model, own, correspondences)
    if best is None or not len(best[1]):
        return None
    tolerance = tolerances_px(model, correspondences)
    sim, chosen, fit = best[0], set(best[1].tolist()), None
    for _ in range(5):  # the set of photos settles in two or three rounds
        near = np.isin(correspondences.photo_of, list(chosen)) | correspondences.carried
        if fit is not None:
            near &= fit.errors_px < 2.0 * tolerance
        if near.sum() < 4:
            return None
        fit = fit_similarity(model, sim, correspondences, near)
        sim = fit.local_from_sfm
        again = set(agreeing_photos(fit.errors_px, tolerance, correspondences).tolist()) & own.keys()
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


def _typical_excess_m(offsets: FloatArray, photos: Sequence[LocalisedPhoto]) -> float:
    """Median distance of the localised centres from the placed ones beyond what they are uncertain by.

    Photos at the rim of a map are localised badly, which bends no model.
    """
    own_m2 = np.array([center_variance_m2(photo) for photo in photos])
    return float(np.sqrt(np.median(np.maximum((offsets**2).sum(axis=1) - own_m2, 0.0))))


def edges_of(
    model: Model, fit: FittedSimilarity, correspondences: Correspondences, used: NDArray[np.bool_]
) -> tuple[Edge, ...]:
    """How each existing map holds the model, by its own points alone where they suffice."""
    found: list[Edge] = []
    for m, map_id in enumerate(correspondences.map_ids):
        mine = used & (correspondences.map_of == m)
        points = len(np.unique(correspondences.point_of[mine]))
        photos = len(np.unique(correspondences.photo_of[mine]))
        if points < LEAST_SHARED_POINTS or photos < _LEAST_PHOTOS:
            continue
        alone = fit_similarity(model, fit.local_from_sfm, correspondences, mine)
        found.append(
            Edge(
                map_id=map_id,
                other_from_map=alone.local_from_sfm @ fit.local_from_sfm.inverse(),
                covariance=alone.covariance,
                shared_points=points,
                photos=photos,
            )
        )
    return tuple(sorted(found, key=lambda e: (-e.shared_points, e.map_id)))


def parents_covariance(
    parents: Sequence[tuple[FeatureMap, int]], frame: LocalFrame, *, relative: bool = False
) -> FloatArray:
    """(7, 7) of the parents' placements in `frame`, weighted by the shared points that each comes with.

    The mean of covariances bounds that of a mean from above however the parents' errors are correlated:
    parents that came of one anchor err alike.

    Args:
        relative: to their anchors, nothing for anchors; else on Earth.
    """
    total = sum(weight for _, weight in parents)
    covariance = np.zeros((7, 7))
    for feature_map, weight in parents:
        own: Any = feature_map.placement.covariance
        if relative:
            own = feature_map.placement.evidence.get(GROWTH, {}).get("covariance_relative", np.zeros(49))
        own = np.asarray(own, dtype=np.float64).reshape(7, 7)
        covariance += weight / total * covariance_in_frame(own, feature_map.frame, frame)
    return covariance


def map_agreements(placement: MapsPlacement, held: Correspondences) -> tuple[str, ...]:
    """How well each pair of parents agrees, as the new map that overlaps both sees it: in the middle of it.

    Args:
        held: correspondences that agree with the placement.
    """
    found: list[str] = []
    for i, a in enumerate(placement.edges):
        for b in placement.edges[i + 1 :]:
            a_from_b = a.other_from_map @ b.other_from_map.inverse()
            adjoint = a_from_b.adjoint()
            covariance = a.covariance + adjoint @ b.covariance @ adjoint.T
            both = np.isin(held.map_of, [held.map_ids.index(a.map_id), held.map_ids.index(b.map_id)])
            middle = held.points[both].mean(axis=0)
            offset, jacobian = a_from_b.act(middle) - middle, point_jacobian(middle)
            sigmas = float(np.sqrt(offset @ np.linalg.solve(jacobian @ covariance @ jacobian.T, offset)))
            found.append(
                f"maps {a.map_id} and {b.map_id} differ by {np.linalg.norm(offset):.2f} m here, "
                f"{sigmas:.1f} sigma"
            )
    return tuple(found)
