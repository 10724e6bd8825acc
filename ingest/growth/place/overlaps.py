"""How two existing maps lie to each other where they overlap, measured by images of one in the other.

What a map keeps of its images, observations with descriptors, is localised against the other map as if they
were new photos; the similarity then comes from the pixels in which both maps' points are seen.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.growth.map_images import LEAST_FEATURES, MOST_IMAGES, features_and_points, model_of
from ingest.growth.place.localised import in_frame, localise_photo
from ingest.growth.place.similarity_fit import agreed_similarity, find_correspondences
from ingest.growth.values import LEAST_PHOTOS, LEAST_SHARED_POINTS, Edge, LocalisedPhoto
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea

_LEAST_POINTS = 2 * LEAST_SHARED_POINTS  # behind an overlap; fewer leave scale and tilt open


def measure_overlap(
    feature_map: FeatureMap, other: FeatureMap, *, images: Sequence[MapImage] | None = None
) -> Edge | str:
    """Images of `feature_map` localised in `other`, and the similarity that they agree upon; or why not.

    Args:
        images: those that are asked; None: the ones that should see the other map by both placements.
    """
    if feature_map.extractor_fingerprint != other.extractor_fingerprint:
        return "descriptors of different extractors"
    if feature_map.height_datum != other.height_datum:
        return "heights of different datums"
    images = _images_near(feature_map, other) if images is None else images
    indexed = IndexedArea.of([other])
    localised: dict[int, LocalisedPhoto] = {}
    for row, image in enumerate(images):
        photo = localise_image(feature_map, image, [indexed])
        if photo is not None:
            localised[row] = in_frame(photo, feature_map.frame)
    if len(localised) < LEAST_PHOTOS:
        return f"{len(localised)} of {len(images)} images are found, {LEAST_PHOTOS} are needed"
    model = model_of(feature_map, feature_map.points_local(), images, described=True)
    keypoints = {
        r: features_and_points(feature_map, image)[0].xy.astype(float) for r, image in enumerate(images)
    }
    correspondences = find_correspondences(model, localised, keypoints)
    found = agreed_similarity(model, localised, correspondences, [Sim3.identity()])
    if found is None:
        return "no image agrees with another"
    fit, agree, used = found
    used &= np.isin(correspondences.photo_of, list(agree))  # and not those carried into images that do not
    points = len(np.unique(correspondences.point_of[used]))
    if len(agree) < LEAST_PHOTOS or points < _LEAST_POINTS:
        return f"{len(agree)} images and {points} points agree, {LEAST_PHOTOS} and {_LEAST_POINTS} are needed"
    return Edge(
        map_id=other.map_id,
        other_from_map=fit.local_from_sfm,
        covariance=fit.covariance,
        shared_points=points,
        photos=len(agree),
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
