"""From a reconstruction of new photos to a map that existing maps have placed, or to the reason why not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from featuredb.maps.error_modes import without_modes
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.maps.lineage import GROWTH
from ingest.colmap.bridge import Model
from ingest.fingerprint import digest
from ingest.growth import gates
from ingest.growth.place.localised import in_frame, with_lens
from ingest.growth.place.placement import parents_covariance, place_by_maps
from ingest.growth.place.refine import Refinement, adopt_lenses, refine_placed
from ingest.growth.place.similarity_fit import find_correspondences
from ingest.growth.values import DRIFT_BUDGET_M, LEAST_PHOTOS, FeaturesOf, LocalisedPhoto, Refused
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.photos.photo import Photo
from ingest.sfm.links import connected_parts, keep_photos
from reloc.localise.candidates import IndexedArea

# Part of the id of every map that is named by its photos; raised when the same photos would give another map.
_VERSION = "grown-1"
# Points of two photos carry descriptors: a handful of photos has hardly longer tracks, and the next photo
# needs them to be localised.
_MAPS = MapOptions(min_track_length=2)
# What a reconstruction is refused for whose photos are at several places. Not CONTRADICTS_GPS: to cut until
# the geotags of a part agree is to choose the photos of whoever lies. Of a block copied elsewhere, half of
# whose tags were at its twin, the parts with those tags were left over, small enough for one forged photo to
# confirm them: twelve photos promoted 277 m off.
AT_SEVERAL_PLACES = ("PHOTOS_DISAGREE", "CONTRADICTS", "NOT_VISIBLE")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrownMap(Refinement):
    """A refined reconstruction and its map, ready to be committed in quarantine."""

    feature_map: FeatureMap


def grow_component(
    model: Model,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: MapIdentity | None,
    max_bound_m: float = DRIFT_BUDGET_M,
) -> GrownMap | Refused:
    """Place a reconstruction by the existing maps, refine it with their points held fixed, build its map.

    Photos whose own localisation contradicts the placement are left out of the map.

    Args:
        model: a connected reconstruction; its rows are rows of `photos`.
        localised: new photos that the maps localise, by row; others than the model's are ignored.
        areas: of the active maps, as `localised` had them.
        identity: of the map; None: it is named by the photos that were tried, so that the same ones give the
            same map.
        max_bound_m: photos that may be further off (95 %) are left out.
    """
    rows = model.rows.tolist()
    mine = {r: localised[r] for r in rows if r in localised}
    if not mine:
        return Refused(reason="NOT_LOCALISED", message=f"none of {len(rows)} photos is localised by a map")
    frame, near = _meeting_place(mine, areas)
    mine = {r: in_frame(photo, frame) for r, photo in mine.items()}
    keypoints = [features_of(r).features.xy.astype(np.float64) for r in rows]
    model, lenses = adopt_lenses(model, photos, near, keypoints)
    camera_of = dict(zip(rows, model.camera_of.tolist(), strict=True))
    mine = {r: with_lens(photo, model.cameras[camera_of[r]]) for r, photo in mine.items()}
    correspondences = find_correspondences(model, mine, keypoints)
    placement = place_by_maps(model, mine, correspondences, photos, near, frame)
    if isinstance(placement, Refused):
        return placement
    refusal = gates.first_refusal(placement.gates)
    if refusal is not None:
        return Refused(reason=refusal.reason, message=refusal.message, gates=placement.gates)
    refined = refine_placed(model, placement, correspondences, mine, keypoints, lenses, max_bound_m)
    if isinstance(refined, Refused):
        return refined
    named = identity or _named([photos[r] for r in rows])
    return _assembled(refined, photos, features_of, near, named)


def _meeting_place(
    localised: Mapping[int, LocalisedPhoto], areas: Sequence[IndexedArea]
) -> tuple[LocalFrame, list[Area]]:
    """The frame of the area with most inliers; this area and then others whose heights have its datum."""
    inliers: dict[LocalFrame, int] = {}
    for photo in localised.values():
        inliers[photo.frame] = inliers.get(photo.frame, 0) + len(photo.pixels)
    frame = max(inliers, key=lambda f: inliers[f])
    datum = next(a.area for a in areas if a.area.frame == frame).maps[0].height_datum
    near = [a.area for a in areas if a.area.maps[0].height_datum == datum]
    return frame, sorted(near, key=lambda area: area.frame != frame)


def _assembled(
    refined: Refinement,
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    areas: Sequence[Area],
    identity: MapIdentity,
) -> GrownMap | Refused:
    """The map of a refined model, with what growth knows of it as evidence."""
    model, placement = refined.model, refined.placement
    maps = {m.map_id: m for area in areas for m in area.maps}
    parents = [(maps[e.map_id], e.shared_points) for e in placement.edges]
    on_earth, to_anchors = (
        placement.covariance + parents_covariance(parents, placement.frame, relative=relative)
        for relative in (False, True)
    )
    rows = model.rows.tolist()
    feature_map = build_map(
        model,
        Placement(
            method="map",
            local_from_sfm=Sim3.identity(),  # the model is in metres, in the frame, since its refinement
            covariance=on_earth,
            residual_rms_m=placement.residual_rms_m,
        ),
        placement.frame,
        [photos[r] for r in rows],
        [features_of(r) for r in rows],
        identity,
        replace(_MAPS, height_datum=parents[0][0].height_datum),
    )
    if feature_map is None:
        message = "no point is placed well enough: the photos' rays are parallel"
        return Refused(reason="NO_POINTS", message=message, gates=placement.gates)
    growth = {"covariance_relative": to_anchors.ravel().tolist(), "gates": gates.figures(placement.gates)}
    images = tuple(  # they know what their lenses leave open; as they were where nothing is known
        replace(image, covariance=own) if np.isfinite(own).all() else image
        for image, own in zip(feature_map.images, refined.poses, strict=True)
    )
    grown = replace(
        feature_map,
        status="quarantined",
        generation=1 + max(m.generation for m, _ in parents),
        parents=tuple(m.map_id for m, _ in parents),
        placement=replace(feature_map.placement, evidence={GROWTH: growth}),
        images=images,
        provenance=without_modes(feature_map.provenance),
    )
    return GrownMap(feature_map=grown, **{f.name: getattr(refined, f.name) for f in fields(refined)})


def _named(photos: Sequence[Photo]) -> MapIdentity:
    """A map is named by its photos: the same photos give the same map."""
    key = digest(_VERSION, *sorted(p.sha256 for p in photos))[:20]
    return MapIdentity(
        map_id=f"g{key}",
        name=f"grown {key[:6]}",
        source="growth",
        licence=", ".join(sorted({p.licence for p in photos if p.licence})),
        provenance={"version": _VERSION, "photos": len(photos)},
    )


def split(model: Model, links: Sequence[float]) -> tuple[float, list[Model]]:
    """The weakest of the links at which a reconstruction falls apart, and its parts; 0 where it does not.

    Photos that hang on nothing any more are in no part: they are localised by themselves, or wait.
    """
    for level in links:
        parts = connected_parts(model, level)
        if len(parts) > 1:
            kept = [keep_photos(model, rows, least=LEAST_PHOTOS) for rows in parts]
            return level, [part for part in kept if part is not None]
    return 0.0, []
