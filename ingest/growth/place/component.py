"""From a reconstruction of new photos to a map that existing maps have placed, or to the reason why not."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from featuredb.maps.error_modes import without_modes
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.lineage import GROWTH
from ingest.colmap.bridge import Model
from ingest.growth.map_places import drift_m, places_of
from ingest.growth.place.correspondences import Correspondences, find_correspondences
from ingest.growth.place.localised import LocaliseEachOptions, in_frame, with_lens
from ingest.growth.place.parents import drift_covariance, map_agreements
from ingest.growth.place.placement import PlacementOptions, SupportedPlacement, place_by_maps
from ingest.growth.place.refine import adopt_lenses
from ingest.growth.place.refinement import RefinementOptions, refine_placed
from ingest.growth.values import FeaturesOf, GrownMap, LocalisedPhoto, MapsPlacement, Refused
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.photos.photo import Photo
from ingest.sfm.links import connected_parts, keep_photos
from reloc.localise.candidates import IndexedArea

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowOptions:
    """From a reconstruction to a map.

    Attributes:
        placement, refinement: the steps.
        localise: how poses are found again with the lenses of the reconstruction.
        maps: what goes into the map; the height datum is that of the parents. Points of two photos carry
            descriptors: a handful of photos has hardly longer tracks, and the next photo needs them to be
            localised.
    """

    placement: PlacementOptions = field(default_factory=PlacementOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    localise: LocaliseEachOptions = field(default_factory=LocaliseEachOptions)
    maps: MapOptions = field(default_factory=lambda: MapOptions(min_track_length=2))


def grow_component(
    model: Model,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: MapIdentity,
    options: GrowOptions | None = None,
) -> GrownMap | Refused:
    """Place a reconstruction by the existing maps, refine it with their points held fixed, build its map.

    Photos whose own localisation contradicts the placement are left out of the map.

    Args:
        model: a connected reconstruction; its rows are rows of `photos`.
        localised: new photos that the maps localise, by row; others than the model's are ignored.
        areas: of the active maps, as `localised` had them.
        identity: of the new map.

    Returns:
        The map, or a refusal. What no step foresaw is a refusal, too (FAILED): it costs this reconstruction
        and not the others of the run, nor the next run.
    """
    try:
        return _grown(model, photos, features_of, localised, areas, identity, options or GrowOptions())
    except (ArithmeticError, LookupError, RuntimeError, ValueError) as error:
        rows = tuple(int(r) for r in model.rows)
        _LOG.exception("a reconstruction of %d photos (%s ...)", len(rows), photos[rows[0]].name)
        text = f"{type(error).__name__}: {error}; the log tells where. Please report it"
        return Refused(reason="FAILED", message=text, rows=rows)


def _grown(
    model: Model,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: MapIdentity,
    options: GrowOptions,
) -> GrownMap | Refused:
    rows = tuple(int(r) for r in model.rows)
    mine = {r: localised[r] for r in rows if r in localised}
    if not mine:
        return Refused(
            reason="NOT_LOCALISED", message=f"none of {len(rows)} photos is localised by a map", rows=rows
        )
    frame, near = _meeting_place(mine, areas)
    mine = {r: in_frame(photo, frame) for r, photo in mine.items()}
    keypoints = [features_of(r).features.xy.astype(np.float64) for r in rows]
    model, lenses = adopt_lenses(model, mine, photos, near, keypoints, options.refinement.refine)
    mine, correspondences, held = _placed(model, mine, keypoints, photos, near, frame, options)
    placement = held.placement
    if placement.reason is not None or placement.local_from_sfm is None:
        return Refused(
            reason=placement.reason or "", message=placement.message, rows=rows, gates=placement.gates
        )
    refined = refine_placed(
        model, held, correspondences, mine, keypoints, lenses, options.placement, options.refinement
    )
    if isinstance(refined, Refused):
        return refined
    final, more = refined.placement, refined.evidence()
    grown = assemble(refined.model, final, held, photos, features_of, near, identity, options, more)
    if isinstance(grown, Refused):
        return grown
    return replace(
        grown,
        feature_map=_with_covariances(grown.feature_map, refined.spread.poses),
        left_out=refined.left_out,
    )


def _placed(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    keypoints: Sequence[FloatArray],
    photos: Sequence[Photo],
    areas: Sequence[Area],
    frame: LocalFrame,
    options: GrowOptions,
) -> tuple[dict[int, LocalisedPhoto], Correspondences, SupportedPlacement]:
    """The photos' own poses by the model's lenses, all correspondences, and the placement."""
    rows = model.rows.tolist()
    camera_of = dict(zip(rows, model.camera_of.tolist(), strict=True))
    mine = {r: with_lens(p, model.cameras[camera_of[r]], options.localise) for r, p in localised.items()}
    correspondences = find_correspondences(model, mine, dict(zip(rows, keypoints, strict=True)))
    return (
        mine,
        correspondences,
        place_by_maps(model, mine, correspondences, photos, areas, frame, options.placement),
    )


def _with_covariances(feature_map: FeatureMap, spread: FloatArray) -> FeatureMap:
    """The map whose images know what their lenses leave open; as they were where nothing is known."""
    images = tuple(
        replace(image, covariance=own) if np.isfinite(own).all() else image
        for image, own in zip(feature_map.images, spread, strict=True)
    )
    return replace(feature_map, images=images, provenance=without_modes(feature_map.provenance))


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


def assemble(
    model: Model,
    placement: MapsPlacement,
    held: SupportedPlacement,
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
    agreements = map_agreements(placement, held.correspondences.take(np.flatnonzero(held.used)))
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


# What a reconstruction is refused for whose photos are at several places. Not CONTRADICTS_GPS: to cut until
# the geotags of a part agree is to choose the photos of whoever lies. Of a block copied elsewhere, half of
# whose tags were at its twin, the parts with those tags were left over, small enough for one forged photo to
# confirm them: twelve photos promoted 277 m off.
AT_SEVERAL_PLACES = ("PHOTOS_DISAGREE", "RESIDUALS", "NOT_VISIBLE")
_LEAST_PHOTOS = 3


def split(model: Model, links: Sequence[float]) -> tuple[float, list[Model]] | None:
    """The parts of a reconstruction at the weakest of the links at which it falls apart, and that link.

    Photos that hang on nothing any more are in no part: they are localised by themselves, or wait.
    """
    for level in links:
        parts = connected_parts(model, level)
        if len(parts) > 1:
            kept = [
                keep_photos(model, rows, least=_LEAST_PHOTOS) for rows in parts if len(rows) >= _LEAST_PHOTOS
            ]
            return level, [part for part in kept if part is not None]
    return None
