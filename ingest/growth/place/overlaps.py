"""How two existing maps lie to each other where they overlap, measured by images of one in the other.

What a map keeps of its images, observations with descriptors, is localised against the other map as if they
were new photos; the similarity then comes from the pixels in which both maps' points are seen.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.growth.map_images import LEAST_FEATURES, MOST_IMAGES, features_and_points, model_of
from ingest.growth.place.localised import in_frame, localise_photo
from ingest.growth.place.similarity_fit import agreed_similarity, find_correspondences
from ingest.growth.values import LEAST_PHOTOS, LEAST_SHARED_POINTS, Edge, LocalisedPhoto, Refused
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea

_LEAST_POINTS = 2 * LEAST_SHARED_POINTS  # behind an overlap; fewer leave scale and tilt open


def measure_overlap(
    feature_map: FeatureMap, other: FeatureMap, *, images: Sequence[MapImage] | None = None
) -> Edge | Refused:
    """Images of `feature_map` localised in `other`, and the similarity that they agree upon.

    Args:
        images: those that are asked; None: the ones that should see the other map by both placements.

    Returns:
        The overlap; refused for NO_OVERLAP, FEW_IMAGES or FEW_POINTS.
    """
    if feature_map.extractor_fingerprint != other.extractor_fingerprint:
        return Refused(reason="NO_OVERLAP", message="descriptors of different extractors")
    if feature_map.height_datum != other.height_datum:
        return Refused(reason="NO_OVERLAP", message="heights of different datums")
    images = _images_near(feature_map, other) if images is None else images
    indexed = IndexedArea.of([other])
    localised: dict[int, LocalisedPhoto] = {}
    for row, image in enumerate(images):
        found = localise_image(feature_map, image, [indexed])
        if found is not None:
            localised[row] = in_frame(found, feature_map.frame)
    if len(localised) < LEAST_PHOTOS:
        return Refused(
            reason="FEW_IMAGES" if localised else "NO_OVERLAP",
            message=f"{len(localised)} of {len(images)} images of map {feature_map.map_id} are found in map "
            f"{other.map_id}, {LEAST_PHOTOS} are needed",
        )
    return _fitted(feature_map, other, images, localised)


def _fitted(
    feature_map: FeatureMap,
    other: FeatureMap,
    images: Sequence[MapImage],
    localised: Mapping[int, LocalisedPhoto],
) -> Edge | Refused:
    model = model_of(feature_map, feature_map.points_local(), images, described=True)
    keypoints = {
        r: features_and_points(feature_map, image)[0].xy.astype(float) for r, image in enumerate(images)
    }
    correspondences = find_correspondences(model, localised, keypoints)
    found = agreed_similarity(model, localised, correspondences, [Sim3.identity()])
    photos = 0 if found is None else len(found[1])
    if found is None or photos < LEAST_PHOTOS:
        return Refused(
            reason="FEW_IMAGES",
            message=f"{photos} images of map {feature_map.map_id} agree on how it lies to map "
            f"{other.map_id}, {LEAST_PHOTOS} are needed",
        )
    fit, _, used = found
    points = len(np.unique(correspondences.point_of[used]))
    if points < _LEAST_POINTS:
        return Refused(
            reason="FEW_POINTS",
            message=f"{points} points of maps {feature_map.map_id} and {other.map_id} agree, {_LEAST_POINTS} "
            "are needed",
        )
    return Edge(
        map_id=other.map_id,
        other_from_map=fit.local_from_sfm,
        covariance=fit.covariance,
        shared_points=points,
        photos=photos,
    )


def localise_image(
    feature_map: FeatureMap, image: MapImage, areas: Sequence[IndexedArea]
) -> LocalisedPhoto | None:
    """An image of a map in other maps, by what its map keeps of it."""
    features, _ = features_and_points(feature_map, image)
    camera = feature_map.cameras[image.camera_id]
    photo = Photo(name=image.name, path=Path(image.name), width=camera.width, height=camera.height)
    found = localise_photo(photo, features, areas, camera)
    return found if isinstance(found, LocalisedPhoto) else None


def _images_near(feature_map: FeatureMap, other: FeatureMap) -> list[MapImage]:
    """Images with enough features whose scene is nearest to the other map's points."""
    places, own = other.points_local(feature_map.frame), feature_map.points_local()
    if not len(places) or not len(own):
        return []
    middle, reach = np.median(places, axis=0), np.percentile(places, (2, 98), axis=0)
    found: list[tuple[float, int, MapImage]] = []
    for image in feature_map.images:
        _, points = features_and_points(feature_map, image)
        if len(points) >= LEAST_FEATURES:
            seen = own[points]
            inside = ((seen >= reach[0] - 5.0) & (seen <= reach[1] + 5.0)).all(axis=1).mean()
            distance = float(np.linalg.norm(np.median(seen, axis=0) - middle))
            found.append((-float(inside) + 1e-6 * distance, image.image_id, image))
    return [image for _, _, image in sorted(found, key=lambda e: e[:2])[:MOST_IMAGES]]
