"""From a reconstruction of new photos to a map that existing maps have placed, or to the reason why not.

Localised photos that no reconstruction holds form groups, which then are reconstructions like any other. Each
of them was placed by matches with existing points. Matches between two of them are something else: if their
geometry, estimated without any pose, fits the two poses, two independent statements agree.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from featuredb.maps.error_modes import without_modes
from featuredb.maps.feature_map import FeatureMap, Placement
from ingest.colmap.anchored import FixedPoints, Lenses, adjust_anchored, pixel_scale, triangulate_posed
from ingest.colmap.bridge import Model, SfmPhoto, TwoView
from ingest.fingerprint import digest
from ingest.growth import gates
from ingest.growth.place.localised import in_frame, with_lens
from ingest.growth.place.placement import parents_covariance, place_by_maps
from ingest.growth.place.refine import Refinement, adopt_lenses, refine_placed
from ingest.growth.values import (
    DRIFT_BUDGET_M,
    LEAST_PHOTOS,
    TOLERANCE_PX,
    GrowthPhotos,
    LocalisedPhoto,
    Refused,
    tied_together,
)
from ingest.map_builder import MapIdentity, MapOptions, build_map
from ingest.photos.photo import Photo
from ingest.sfm.links import connected_parts, keep_photos
from ingest.sfm.pairs import Pair
from reloc.localise.candidates import IndexedArea
from reloc.localise.pose import reprojection_errors

# Part of the id of every map that is named by its photos; raised when the same photos would give another map.
_VERSION = "grown-1"
# Photos of a point that carries descriptors: a handful of photos has hardly longer tracks, and the next photo
# needs them to be localised.
_LEAST_TRACK = 2
# What a reconstruction is refused for whose photos are at several places. Not CONTRADICTS_GPS: to cut until
# the geotags of a part agree is to choose the photos of whoever lies. Of a block copied elsewhere, half of
# whose tags were at its twin, the parts with those tags were left over, small enough for one forged photo to
# confirm them: twelve photos promoted 277 m off.
AT_SEVERAL_PLACES = ("PHOTOS_DISAGREE", "CONTRADICTS", "NOT_VISIBLE")
# Median between the rays. Below, any two photos from one spot fit, and two copies of one picture.
_LEAST_ANGLE_DEG = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrownMap(Refinement):
    """A refined reconstruction and its map, ready to be committed in quarantine."""

    feature_map: FeatureMap
    covariance_relative: FloatArray  # (7, 7) of its place, relative to the anchors


def grow_component(
    model: Model,
    new: GrowthPhotos,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: MapIdentity | None,
    max_bound_m: float = DRIFT_BUDGET_M,
) -> GrownMap | Refused:
    """Place a reconstruction by the existing maps, refine it with their points held fixed, build its map.

    The map has no evidence of growth until `graph.map_graph.with_drift`.

    Args:
        model: a connected reconstruction of new photos.
        localised: those that the maps localise, by row; others than the model's are ignored.
        areas: of the active maps, as `localised` had them.
        identity: of the map; None: it is named by the photos that were tried.
        max_bound_m: photos that may be further off (95 %) are left out.
    """
    rows = model.rows.tolist()
    own = {k: localised[r] for k, r in enumerate(rows) if r in localised}
    if not own:
        return Refused(reason="NOT_LOCALISED", message=f"none of {len(rows)} photos is localised by a map")
    frame, near = _meeting_place(own, areas)
    keypoints = [new.features_of(r).features.xy.astype(np.float64) for r in rows]
    model, lenses = adopt_lenses(model, new.photos, near, keypoints)
    cameras = [model.cameras[c] for c in model.camera_of.tolist()]
    own = {k: with_lens(in_frame(photo, frame), cameras[k]) for k, photo in own.items()}
    placement = place_by_maps(model, own, keypoints, new.photos, near, frame)
    if isinstance(placement, Refused):
        return placement
    refusal = next((gate for gate in placement.gates if not gate.passes), None)
    if refusal is not None:
        return Refused(reason=refusal.reason, message=refusal.message, gates=placement.gates)
    refined = refine_placed(model, placement, own, keypoints, lenses, max_bound_m)
    if isinstance(refined, Refused):
        return refined
    return _assembled(refined, new, near, identity or _named([new.photos[r] for r in rows]))


def _meeting_place(
    localised: Mapping[int, LocalisedPhoto], areas: Sequence[IndexedArea]
) -> tuple[LocalFrame, list[Area]]:
    """The frame of the area with most inliers; this area and then others whose heights have its datum."""
    inliers: Counter[LocalFrame] = Counter()
    for photo in localised.values():
        inliers[photo.frame] += len(photo.pixels)
    frame = inliers.most_common(1)[0][0]
    datum = next(a.area for a in areas if a.area.frame == frame).maps[0].height_datum
    near = [a.area for a in areas if a.area.maps[0].height_datum == datum]
    return frame, sorted(near, key=lambda area: area.frame != frame)


def _assembled(
    refined: Refinement, new: GrowthPhotos, areas: Sequence[Area], identity: MapIdentity
) -> GrownMap | Refused:
    """The map of a refined model."""
    model, placement, edges = refined.model, refined.placement, refined.placement.edges
    maps = {m.map_id: m for area in areas for m in area.maps}
    parents = [maps[edge.map_id] for edge in edges]
    on_earth = placement.covariance + parents_covariance(edges, areas, placement.frame)
    relative = placement.covariance + parents_covariance(edges, areas, placement.frame, relative=True)
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
        [new.photos[r] for r in rows],
        [new.features_of(r) for r in rows],
        identity,
        MapOptions(min_track_length=_LEAST_TRACK, height_datum=parents[0].height_datum),
    )
    if feature_map is None:
        message = "no point is placed well enough: the photos' rays are parallel"
        return Refused(reason="NO_POINTS", message=message, gates=placement.gates)
    images = tuple(  # they know what their lenses leave open; as they were where nothing is known
        replace(image, covariance=own) if np.isfinite(own).all() else image
        for image, own in zip(feature_map.images, refined.spread.poses, strict=True)
    )
    grown = replace(
        feature_map,
        status="quarantined",
        generation=1 + max(m.generation for m in parents),
        parents=tuple(m.map_id for m in parents),
        images=images,
        provenance=without_modes(feature_map.provenance),
    )
    as_refined = {f.name: getattr(refined, f.name) for f in fields(refined)}
    return GrownMap(feature_map=grown, covariance_relative=relative, **as_refined)


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


def lone_groups(
    localised: Mapping[int, LocalisedPhoto], new: GrowthPhotos
) -> tuple[list[Model], dict[int, str]]:
    """Groups among localised photos that no reconstruction holds, and for those in none the reason.

    A group's model is of its matches alone, with the lenses of the localisations.

    Args:
        localised: the lone photos by row, those of one camera with one lens.
        new: with the geometry of overlaps, in which no pose takes part.
    """
    if not localised:
        return [], {}
    frame = next(iter(localised.values())).frame
    photos = {r: in_frame(p, frame) for r, p in sorted(localised.items())}
    geometries: dict[Pair, TwoView] = {}
    for a, b in sorted(pair for pair in new.overlaps if photos.keys() >= set(pair)):
        view = new.geometry_of((a, b))
        pixels = [new.features_of(r).features.xy[view.inliers[:, k]] for k, r in enumerate((a, b))]
        if poses_fit(photos[a], photos[b], pixels[0].astype(np.float64), pixels[1].astype(np.float64)):
            geometries[a, b] = view
    alone = photos.keys() - set(chain(*geometries))
    groups: list[Model] = []
    group_of = np.array(tied_together(list(photos), geometries))
    for group in np.unique(group_of):
        rows = np.array(list(photos))[group_of == group].tolist()
        if len(rows) >= 2:
            own = {pair: view for pair, view in geometries.items() if pair[0] in rows}
            groups.append(_triangulated({r: photos[r] for r in rows}, own, new))
    return groups, dict.fromkeys(alone, "ALONE: no other photo confirms its pose")


def poses_fit(a: LocalisedPhoto, b: LocalisedPhoto, pixels_a: FloatArray, pixels_b: FloatArray) -> bool:
    """Whether the verified matches of two photos, pixels (m, 2) of each, bear out the poses in one frame."""
    points, angle = intersections((a, b), (pixels_a, pixels_b))
    fits = np.ones(len(points), dtype=np.bool_)
    for photo, pixels in ((a, pixels_a), (b, pixels_b)):
        errors = reprojection_errors(pixels, points, photo.camera, photo.cam_from_local)
        fits &= errors < TOLERANCE_PX * pixel_scale(photo.camera)
    enough = fits.sum() >= gates.AGREEING_SHARE * len(fits)
    return bool(enough and np.degrees(np.median(angle[fits])) >= _LEAST_ANGLE_DEG)


def intersections(
    photos: tuple[LocalisedPhoto, LocalisedPhoto], pixels: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Midpoints (m, 3) of the shortest lines between the rays of pixel pairs, and the rays' angles (rad)."""
    poses, rays = [photo.cam_from_local for photo in photos], []
    for photo, pose, xy in zip(photos, poses, pixels, strict=True):
        # A pixel that the lens does not reach has the optical axis for its ray.
        ray = np.column_stack([np.nan_to_num(photo.camera.unproject(xy)), np.ones(len(xy))]) @ pose.rotation
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    base = poses[1].center - poses[0].center
    cosine = np.einsum("mi,mi->m", *rays)
    sine2 = np.maximum(1.0 - cosine**2, 1e-12)
    along = [ray @ base for ray in rays]
    depths = ((along[0] - cosine * along[1]) / sine2, (cosine * along[0] - along[1]) / sine2)
    ends = [p.center + d[:, None] * ray for p, d, ray in zip(poses, depths, rays, strict=True)]
    return 0.5 * (ends[0] + ends[1]), np.arccos(np.clip(cosine, -1.0, 1.0))


def _triangulated(
    photos: Mapping[int, LocalisedPhoto], geometries: Mapping[Pair, TwoView], new: GrowthPhotos
) -> Model:
    """A model of the group, from the localisations' poses adjusted to its verified matches alone.

    Whether it still fits the localisations is asked when it is placed, as of any reconstruction.
    """
    rows, cameras = list(photos), list(dict.fromkeys(photo.camera for photo in photos.values()))
    sfm = []
    for r, photo in photos.items():
        camera_row, xy = cameras.index(photo.camera), new.features_of(r).features.xy
        sfm.append(SfmPhoto(name=str(r), camera_row=camera_row, keypoints=xy))
    views = {(rows.index(a), rows.index(b)): view for (a, b), view in geometries.items()}
    model = triangulate_posed(cameras, sfm, [photo.cam_from_local for photo in photos.values()], views)
    keypoints = [sfm[int(k)].keypoints.astype(np.float64) for k in model.rows]
    lenses = Lenses(held=range(len(model.cameras)))
    free = adjust_anchored(model, keypoints, FixedPoints.none(), lenses).model
    return replace(free, rows=np.array([rows[int(k)] for k in model.rows], dtype=np.int64))
