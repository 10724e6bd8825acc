"""How two existing maps lie to each other where they overlap, measured by images of one in the other.

What a map keeps of its images, observations with descriptors, is localised against the other map as if they
were new photos; the similarity then comes from the pixels in which both maps' points are seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.colmap.bridge import Model
from ingest.growth.map_images import features_and_points
from ingest.growth.place.correspondences import find_correspondences
from ingest.growth.place.localised import LocaliseEachOptions, in_frame, localise_photo
from ingest.growth.place.similarity_fit import (
    SimilarityFitOptions,
    agreeing_photos,
    fit_similarity,
    proposals,
    rank_proposals,
    tolerances_px,
)
from ingest.growth.values import LocalisedPhoto
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlapOptions:
    """How an overlap is measured.

    Attributes:
        max_images: of the one map, nearest to the other map's points first; more only sharpen it.
        min_features: observations with descriptors that an image needs.
        min_photos: images that must agree: one alone is never enough.
        min_points: matches behind them; fewer leave scale and tilt open.
    """

    max_images: int = 24
    min_features: int = 60
    min_photos: int = 3
    min_points: int = 60
    localise: LocaliseEachOptions = field(default_factory=LocaliseEachOptions)
    fit: SimilarityFitOptions = field(default_factory=SimilarityFitOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlap:
    """A measured overlap, or why there is none.

    Attributes:
        reason: None, or NO_OVERLAP, FEW_IMAGES, FEW_POINTS.
        other_from_map: carries what the map says to where the other says it; the map's own frame.
        covariance: (7, 7) of its left perturbation.
        shared_points, photos: that it rests on.
    """

    reason: str | None
    message: str
    other_from_map: Sim3 | None = None
    covariance: FloatArray | None = None
    shared_points: int = 0
    photos: int = 0


def measure_overlap(
    feature_map: FeatureMap,
    other: FeatureMap,
    options: OverlapOptions | None = None,
    *,
    images: Sequence[MapImage] | None = None,
) -> Overlap:
    """Images of `feature_map` localised in `other`, and the similarity that they agree upon.

    Args:
        images: those that are asked; None: the ones that should see the other map by both placements.
    """
    options = options or OverlapOptions()
    if feature_map.extractor_fingerprint != other.extractor_fingerprint:
        return Overlap(reason="NO_OVERLAP", message="descriptors of different extractors")
    if feature_map.height_datum != other.height_datum:
        return Overlap(reason="NO_OVERLAP", message="heights of different datums")
    images = _images_near(feature_map, other, options) if images is None else images
    area = build_area([other])
    indexed = IndexedArea(area=area, index=build_index(area.descriptors))
    localised: dict[int, LocalisedPhoto] = {}
    for row, image in enumerate(images):
        found = _localised(feature_map, image, row, indexed, options)
        if found is not None:
            localised[row] = in_frame(found, feature_map.frame)
    if len(localised) < options.min_photos:
        return Overlap(
            reason="FEW_IMAGES" if localised else "NO_OVERLAP",
            message=f"{len(localised)} of {len(images)} images of map {feature_map.map_id} are found in map "
            f"{other.map_id}, {options.min_photos} are needed",
        )
    return _fitted(feature_map, other, images, localised, options)


def _fitted(
    feature_map: FeatureMap,
    other: FeatureMap,
    images: Sequence[MapImage],
    localised: dict[int, LocalisedPhoto],
    options: OverlapOptions,
) -> Overlap:
    model = model_of(feature_map, images)
    keypoints = {
        r: features_and_points(feature_map, image)[0].xy.astype(float) for r, image in enumerate(images)
    }
    correspondences = find_correspondences(model, localised, keypoints)
    ranked = rank_proposals(
        model,
        [Sim3.identity(), *proposals(model, localised, correspondences, options.fit)],
        correspondences,
        options.fit,
    )
    best, agree = ranked[0]
    if len(agree) < options.min_photos:
        return Overlap(
            reason="FEW_IMAGES",
            message=f"{len(agree)} images of map {feature_map.map_id} agree on how it lies to map "
            f"{other.map_id}, {options.min_photos} are needed",
        )
    fit = fit_similarity(model, best, correspondences, np.isin(correspondences.photo_of, agree), options.fit)
    tolerance = tolerances_px(model, correspondences, options.fit.tolerance_rel)
    agree = agreeing_photos(fit.errors_px, tolerance, correspondences, options.fit.least_share)
    near = np.isin(correspondences.photo_of, agree) & (fit.errors_px < tolerance)
    points = len(np.unique(correspondences.point_of[near]))
    if len(agree) < options.min_photos or points < options.min_points:
        return Overlap(
            reason="FEW_POINTS",
            message=f"{len(agree)} images and {points} points of maps {feature_map.map_id} and "
            f"{other.map_id} agree, {options.min_photos} and {options.min_points} are needed",
        )
    return Overlap(
        reason=None,
        message=f"{len(agree)} images and {points} points in common",
        other_from_map=fit.local_from_sfm,
        covariance=fit.covariance,
        shared_points=points,
        photos=len(agree),
    )


def model_of(feature_map: FeatureMap, images: Sequence[MapImage]) -> Model:
    """Some images of a map with the points that they see, as a reconstruction in the map's frame.

    Keypoints of an image are its features as `features_and_points` gives them.
    """
    point_of, photo_of, keypoint_of = [], [], []
    for row, image in enumerate(images):
        _, points = features_and_points(feature_map, image)
        point_of.append(points)
        photo_of.append(np.full(len(points), row, dtype=np.int64))
        keypoint_of.append(np.arange(len(points), dtype=np.int64))
    points, photos, keypoints = (np.concatenate(parts) for parts in (point_of, photo_of, keypoint_of))
    used, index = np.unique(points, return_inverse=True)
    order = np.lexsort((photos, index))
    return Model(
        cameras=feature_map.cameras,
        rows=np.arange(len(images), dtype=np.int64),
        camera_of=np.array([image.camera_id for image in images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in images),
        xyz=feature_map.points_local()[used],
        point_of=index.reshape(-1)[order].astype(np.int64),
        photo_of=photos[order],
        keypoint_of=keypoints[order],
    )


def localise_image(
    feature_map: FeatureMap,
    image: MapImage,
    row: int,
    areas: Sequence[IndexedArea],
    options: LocaliseEachOptions,
) -> LocalisedPhoto | None:
    """An image of a map in other maps, by what its map keeps of it."""
    features, _ = features_and_points(feature_map, image)
    camera = feature_map.cameras[image.camera_id]
    photo = Photo(name=image.name, path=Path(image.name), width=camera.width, height=camera.height)
    found = localise_photo(photo, row, features, areas, options, camera=camera)
    return found if isinstance(found, LocalisedPhoto) else None


def _localised(
    feature_map: FeatureMap, image: MapImage, row: int, indexed: IndexedArea, options: OverlapOptions
) -> LocalisedPhoto | None:
    return localise_image(feature_map, image, row, [indexed], options.localise)


def _images_near(feature_map: FeatureMap, other: FeatureMap, options: OverlapOptions) -> list[MapImage]:
    """Images with enough features whose scene is nearest to the other map's points."""
    places = other.points_local(feature_map.frame)
    own = feature_map.points_local()
    if not len(places) or not len(own):
        return []
    middle, reach = np.median(places, axis=0), np.percentile(places, (2, 98), axis=0)
    found: list[tuple[float, int, MapImage]] = []
    for image in feature_map.images:
        _, points = features_and_points(feature_map, image)
        if len(points) < options.min_features:
            continue
        seen = own[points]
        inside = ((seen >= reach[0] - 5.0) & (seen <= reach[1] + 5.0)).all(axis=1).mean()
        distance = float(np.linalg.norm(np.median(seen, axis=0) - middle))
        found.append((-float(inside) + 1e-6 * distance, image.image_id, image))
    return [image for _, _, image in sorted(found, key=lambda e: e[:2])[: options.max_images]]
