"""From a reconstruction of new photos to a map that existing maps have placed, or to the reason why not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.lineage import GROWTH
from ingest.colmap_anchored import Anchored
from ingest.colmap_bridge import Model
from ingest.growth import gates
from ingest.growth.anchors import Anchors, find_anchors
from ingest.growth.drift import (
    DriftOptions,
    LensKnowledge,
    bending_variance_m2,
    center_covariances,
    photo_covariances,
)
from ingest.growth.links import firmness
from ingest.growth.localised import LocaliseEachOptions, in_frame, with_lens
from ingest.growth.map_graph import drift_m, places_of
from ingest.growth.model_parts import only_photos, with_existing, without_photos
from ingest.growth.parents import drift_covariance, edges_of, map_agreements
from ingest.growth.placement import Held, PlacementOptions, place_by_maps
from ingest.growth.refine import RefineOptions, adopt_lenses, exif_focals, refine_with_maps
from ingest.growth.similarity_fit import Fit, fit_similarity
from ingest.growth.values import FeaturesOf, GrownMap, LocalisedPhoto, MapsPlacement, Refused
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.photo import Photo
from reloc.candidates import IndexedArea

# Reasons of photos that nothing holds well enough, and of those that hang on others by little.
LOOSE, WEAK_LINK = "DRIFT_BUDGET", "WEAK_LINK"


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowOptions:
    """From a reconstruction to a map.

    Attributes:
        min_held_share: of the anchors that agree with the placement, the share that still fits once poses,
            lenses and new points have been adjusted to them; on real sets above 0.9. Less means that the
            reconstruction cannot be bent to what the existing maps say.
        min_link: `firmness` that photos need which are not localised themselves. In the simulated community a
            block of seven photos, tied to a look-alike hall 78 m from theirs, had 0.04; right photos 0.14 and
            more.
        max_photo_bound_m: photos that may be further off (95 %), against the existing points and with what
            their lens leaves open, are left out: a photo hangs on its neighbours by a corner sometimes.
        max_rounds: of leaving such photos out; the others are adjusted without them.
        localise: how poses are found again with the lenses of the reconstruction.
        drift: how far the refined reconstruction may bend beyond what holds it.
        maps: what goes into the map; the height datum is that of the parents. Points of two photos carry
            descriptors: a handful of photos has hardly longer tracks, and the next photo needs them to be
            localised.
    """

    placement: PlacementOptions = field(default_factory=PlacementOptions)
    refine: RefineOptions = field(default_factory=RefineOptions)
    localise: LocaliseEachOptions = field(default_factory=LocaliseEachOptions)
    min_held_share: float = 0.5
    min_link: float = 0.08
    max_photo_bound_m: float = 0.5
    max_rounds: int = 4
    drift: DriftOptions = field(default_factory=DriftOptions)
    maps: MapOptions = field(default_factory=lambda: MapOptions(min_track_length=2))


def grow_component(
    model: Model,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: MapIdentity,
    options: GrowOptions | None = None,
    needed: Sequence[int] = (),
) -> GrownMap | Refused:
    """Place a reconstruction by the existing maps, refine it with their points held fixed, build its map.

    Photos whose own localisation contradicts the placement are left out of the map.

    Args:
        model: a connected reconstruction; its rows are rows of `photos`.
        localised: new photos that the maps localise, by row; others than the model's are ignored.
        areas: of the active maps, as `localised` had them.
        identity: of the new map.
        needed: rows of photos without which there is nothing to add.
    """
    options = options or GrowOptions()
    rows = tuple(int(r) for r in model.rows)
    mine = {r: localised[r] for r in rows if r in localised}
    if not mine:
        return Refused(
            reason="NOT_LOCALISED", message=f"none of {len(rows)} photos is localised by a map", rows=rows
        )
    frame, near = _meeting_place(mine, areas)
    mine = {r: in_frame(photo, frame) for r, photo in mine.items()}
    keypoints = [features_of(r).features.xy.astype(np.float64) for r in rows]
    focals = exif_focals(model, photos)
    model, constant = adopt_lenses(model, mine, keypoints, focals, options.refine)
    lenses = dict(zip(rows, model.camera_of.tolist(), strict=True))
    mine = {r: with_lens(p, model.cameras[lenses[r]], options.localise) for r, p in mine.items()}
    anchors = find_anchors(model, mine, dict(zip(rows, keypoints, strict=True)))
    held = place_by_maps(model, mine, anchors, photos, near, frame, options.placement)
    placement = held.placement
    if placement.reason is not None or placement.local_from_sfm is None:
        return Refused(
            reason=placement.reason or "", message=placement.message, rows=rows, gates=placement.gates
        )
    if needed and set(needed) <= set(placement.disagreeing):
        return Refused(
            reason="PHOTOS_DISAGREE",
            message="the new photos contradict the placement that photos of existing maps give them",
            rows=rows,
            gates=placement.gates,
        )
    assert held.fit is not None
    known = LensKnowledge(adopted=constant, by_exif=focals)
    outside = [rows.index(r) for r in placement.disagreeing]
    firm = firmness(without_photos(model, outside), [rows.index(r) for r in placement.agreeing])
    weak = [int(k) for k in np.flatnonzero(firm < options.min_link) if k not in outside]
    left_out = {
        rows[k]: (
            WEAK_LINK,
            f"{100 * firm[k]:.1f} % of its points tie the photo to those that are localised, "
            f"{100 * options.min_link:.0f} % needed: look-alike places tie photos so",
        )
        for k in weak
    }
    outside += weak
    for _ in range(options.max_rounds):
        good = anchors.take(np.flatnonzero(held.used & ~np.isin(anchors.photo_of, outside)))
        adjusted, fixed, sharp = refine_with_maps(
            without_photos(model, outside),
            placement.local_from_sfm,
            good,
            constant,
            keypoints,
            focals,
            options.refine,
        )
        gate = gates.held_share(adjusted.fixed_kept, options.min_held_share)
        if not gate.passes:
            break
        spread = photo_covariances(
            adjusted.model, keypoints, fixed, adjusted.fixed_kept, known, options.drift
        )
        loose = {
            k: message
            for k, message in loose_photos(adjusted.model, spread, options.max_photo_bound_m).items()
            if k not in outside
        }
        left_out |= {rows[k]: (LOOSE, message) for k, message in loose.items()}
        outside += sorted(loose)
        if not loose or len(outside) > len(rows) - 2:
            break
    placement = replace(placement, gates=(*placement.gates, gate))
    if not gate.passes:
        return Refused(reason=gate.reason, message=gate.message, rows=rows, gates=placement.gates)
    if loose:
        return Refused(
            reason=LOOSE,
            message=f"hardly a photo is held well enough: {next(iter(loose.values()))}",
            rows=rows,
            gates=placement.gates,
        )
    kept = good.take(sharp)
    placement, fit = _settled(placement, adjusted, kept, options.placement)
    bending_m2 = bending_variance_m2(adjusted.model, fit.covariance, spread)
    placement = widened(placement, bending_m2)
    complete = with_existing(adjusted, fixed, kept, placement.parents)
    inside = [k for k in range(len(rows)) if k not in outside]
    complete = only_photos(complete, inside)
    more = {"bending_m": float(np.sqrt(bending_m2))}
    grown = assemble(complete, placement, held, photos, features_of, near, identity, options, more)
    if isinstance(grown, Refused):
        return grown
    return replace(grown, feature_map=_with_covariances(grown.feature_map, spread[inside]), left_out=left_out)


def _settled(
    placement: MapsPlacement, adjusted: Anchored, anchors: Anchors, options: PlacementOptions
) -> tuple[MapsPlacement, Fit]:
    """The placement with the covariances of the refined model, and their fit.

    Until then the reconstruction was bent as it came, and its residuals said more of that than of where it
    lies. What photos lack beyond the similarity is added to it afterwards.
    """
    model, used = adjusted.model, adjusted.fixed_kept
    fit = fit_similarity(model, Sim3.identity(), anchors, used, options.fit)
    edges = edges_of(model, fit, anchors, used, options.parents, options.fit)
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
    ), fit


def loose_photos(model: Model, spread: FloatArray, max_bound_m: float) -> dict[int, str]:
    """Photos that may be further off than the bound (95 %) against the existing points, and why.

    Args:
        spread: of `photo_covariances`; photos that see nothing any more are loose, unless none was asked.
    """
    if not np.isfinite(spread).any():
        return {}
    bounds = np.full(len(spread), np.inf)
    seen = np.isfinite(spread[:, 0, 0])
    centers = center_covariances(model, spread)[seen]
    bounds[seen] = 1.96 * np.sqrt(np.maximum(np.linalg.eigvalsh(centers)[:, -1], 0.0))
    return {
        int(
            k
        ): f"the photo may be {bounds[k]:.2f} m off where it hangs on the others, {max_bound_m:.2f} m are "
        "allowed"
        for k in np.flatnonzero(bounds > max_bound_m)
    }


def _with_covariances(feature_map: FeatureMap, spread: FloatArray) -> FeatureMap:
    """The map whose images know what their lenses leave open; as they were where nothing is known."""
    images = tuple(
        replace(image, covariance=own) if np.isfinite(own).all() else image
        for image, own in zip(feature_map.images, spread, strict=True)
    )
    return replace(feature_map, images=images)


def _meeting_place(
    localised: Mapping[int, LocalisedPhoto], areas: Sequence[IndexedArea]
) -> tuple[LocalFrame, list[Area]]:
    """The frame of the area with most inliers, and the areas whose heights have the same datum."""
    inliers: dict[LocalFrame, int] = {}
    for photo in localised.values():
        inliers[photo.frame] = inliers.get(photo.frame, 0) + len(photo.pixels)
    frame = max(inliers, key=lambda f: inliers[f])
    main = next(a.area for a in areas if a.area.frame == frame)
    datum = main.maps[0].height_datum
    return frame, [a.area for a in areas if a.area.maps[0].height_datum == datum]


def widened(placement: MapsPlacement, bending_m2: float) -> MapsPlacement:
    """The placement with its covariance relative to the existing maps widened by what bending adds."""
    assert placement.covariance is not None
    assert placement.covariance_relative is not None
    wider = placement.covariance_relative + np.diag([0.0] * 4 + [bending_m2] * 3)
    on_earth = placement.covariance - placement.covariance_relative
    return replace(placement, covariance_relative=wider, covariance=wider + on_earth)


def assemble(
    model: Model,
    placement: MapsPlacement,
    held: Held,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    areas: Sequence[Area],
    identity: MapIdentity,
    options: GrowOptions,
    more: Mapping[str, Any] | None = None,
) -> GrownMap | Refused:
    """The map of a refined model, with what growth knows about it as evidence.

    Args:
        model: in metres, in the placement's frame.
        more: further evidence of growth.
    """
    maps = {m.map_id: m for area in areas for m in area.maps}
    parents = [(maps[e.map_id], e.shared_points) for e in placement.edges]
    assert placement.covariance is not None
    assert placement.covariance_relative is not None
    to_anchors = placement.covariance_relative + drift_covariance(parents, placement.frame)
    rows = tuple(int(r) for r in model.rows)
    chosen = [photos[r] for r in rows]
    feature_map = build_map(
        model,
        Placement(
            method="map",
            local_from_sfm=Sim3.identity(),  # the model is in metres, in the frame, since its refinement
            covariance=placement.covariance,
            residual_rms_m=placement.residual_rms_m,
        ),
        placement.frame,
        chosen,
        [features_of(r) for r in rows],
        identity,
        replace(options.maps, height_datum=parents[0][0].height_datum),
    )
    if feature_map is None:
        return Refused(
            reason="NO_POINTS",
            message="no point is placed well enough: the photos' rays are parallel",
            rows=rows,
            gates=placement.gates,
        )
    agreements = map_agreements(placement, held.anchors.take(np.flatnonzero(held.used)))
    growth = {
        "drift_m": drift_m(to_anchors, places_of(feature_map)),
        "steps": 1 + max(_steps(m) for m, _ in parents),
        "anchors": sorted({a for m, _ in parents for a in _anchors_of(m)}),
        "covariance_relative": to_anchors.ravel().tolist(),
        "edges": [
            {
                "map_id": e.map_id,
                "parent_from_new": e.parent_from_new.log().tolist(),
                "covariance": e.covariance.ravel().tolist(),
                "shared_points": e.shared_points,
                "photos": e.photos,
            }
            for e in placement.edges
        ],
        "agreeing_photos": [photos[r].name for r in placement.agreeing],
        "disagreeing_photos": [photos[r].name for r in placement.disagreeing],
        "agreements": [
            {
                "maps": [a.map_a, a.map_b],
                "distance_m": a.distance_m,
                "sigma_m": a.sigma_m,
                "sigmas": a.sigmas,
                "text": str(a),
            }
            for a in agreements
        ],
        "gates": placement.figures(),
        **(more or {}),
    }
    grown = replace(
        feature_map,
        status="quarantined",
        generation=1 + max(m.generation for m, _ in parents),
        parents=placement.parents,
        placement=replace(feature_map.placement, evidence={GROWTH: growth}),
    )
    return GrownMap(feature_map=grown, placement=placement, model=model, agreements=agreements)


def _steps(feature_map: FeatureMap) -> int:
    return int(feature_map.placement.evidence.get(GROWTH, {}).get("steps", 0))


def _anchors_of(feature_map: FeatureMap) -> list[str]:
    named = feature_map.placement.evidence.get(GROWTH, {}).get("anchors")
    return list(named) if named else [feature_map.map_id]
