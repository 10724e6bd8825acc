"""Images of maps, asked like new photos by what their maps keep of them: observations with descriptors.

How two existing maps lie to each other where they overlap is measured so: images of one are localised in the
other, and the similarity then comes from the pixels in which both maps' points are seen.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import AnyMap
from ingest.colmap.bridge import Model
from ingest.growth.place.localised import in_frame, localise_photo
from ingest.growth.place.similarity_fit import agreed_similarity
from ingest.growth.values import LEAST_PHOTOS, LEAST_SHARED_POINTS, Edge, LocalisedPhoto
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea

# Observations with descriptors that an image needs to be asked, of which a third are inliers in a good one.
LEAST_FEATURES = 2 * LEAST_SHARED_POINTS
NEAR_M = 50.0  # images of maps around another one are asked whose camera is so far from it at most
MOST_IMAGES = 24  # that are asked of a map or around one, nearest first; more only sharpen what they say
_LEAST_POINTS = 2 * LEAST_SHARED_POINTS  # behind an overlap; fewer leave scale and tilt open


def observed_rows(any_map: AnyMap, image: MapImage, *, described: bool = True) -> NDArray[np.int64]:
    """Rows (n,) of a map's observations of one image, those with descriptors first, or alone; large first."""
    seen = any_map.observations
    rows = np.flatnonzero(seen.image_id == image.image_id)
    rows = rows[np.lexsort((-seen.scale[rows], ~seen.has_descriptor[rows]))]
    return rows[seen.has_descriptor[rows]] if described else rows


def features_and_points(
    any_map: AnyMap, image: MapImage, rows: NDArray[np.int64] | None = None
) -> tuple[Features, NDArray[np.int64]]:
    """`observed_rows` as features of that photo, and the rows (n,) of the points that they see."""
    seen, camera = any_map.observations, any_map.cameras[image.camera_id]
    rows = observed_rows(any_map, image) if rows is None else rows
    features = Features(
        xy=seen.xy[rows],
        scale=seen.scale[rows],
        angle=seen.angle[rows],
        response=np.linspace(1.0, 0.5, len(rows), dtype=np.float32),
        descriptors=seen.descriptors[rows],
        width=camera.width,
        height=camera.height,
        fingerprint=any_map.extractor_fingerprint,
    )
    return features, seen.point_index[rows]


def model_of(any_map: AnyMap, images: Sequence[MapImage], *, described: bool) -> Model:
    """Images of a map as a reconstruction in its frame; keypoints of an image are its `observed_rows`."""
    rows = [observed_rows(any_map, image, described=described) for image in images]
    counts = [len(own) for own in rows]
    photo_of = np.repeat(np.arange(len(images), dtype=np.int64), counts)
    points = any_map.observations.point_index[np.concatenate(rows)]
    used, point_of = np.unique(points, return_inverse=True)
    order = np.lexsort((photo_of, point_of))
    return Model(
        cameras=any_map.cameras,
        rows=np.arange(len(images), dtype=np.int64),
        camera_of=np.array([image.camera_id for image in images], dtype=np.int64),
        cam_from_sfm=tuple(image.cam_from_local for image in images),
        xyz=any_map.points_local()[used],
        point_of=point_of.reshape(-1)[order].astype(np.int64),
        photo_of=photo_of[order],
        keypoint_of=np.concatenate([np.arange(n, dtype=np.int64) for n in counts])[order],
    )


def measure_overlap(
    feature_map: FeatureMap, other: FeatureMap, *, images: Sequence[MapImage] | None = None
) -> Edge | str:
    """Images of `feature_map` localised in `other`, and the similarity that they agree upon; or why not.

    Without `images` those are asked that should see the other map by both placements.
    """
    if feature_map.extractor_fingerprint != other.extractor_fingerprint:
        return "descriptors of different extractors"
    if feature_map.height_datum != other.height_datum:
        return "heights of different datums"
    images = _images_near(feature_map, other) if images is None else images
    indexed = IndexedArea.of([other])
    asked = [localise_image(feature_map, image, [indexed]) for image in images]
    localised = {row: in_frame(photo, feature_map.frame) for row, photo in enumerate(asked) if photo}
    if len(localised) < LEAST_PHOTOS:
        return f"{len(localised)} of {len(images)} images are found, {LEAST_PHOTOS} are needed"
    model = model_of(feature_map, images, described=True)
    keypoints = [feature_map.observations.xy[observed_rows(feature_map, i)].astype(float) for i in images]
    found = agreed_similarity(model, localised, keypoints, [Sim3.identity()])
    if found is None:
        return "no image agrees with another"
    fit, agree, held = found
    # Without those carried into images that do not agree.
    points = len(np.unique(held.point_of[np.isin(held.photo_of, list(agree))]))
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
        rows = observed_rows(feature_map, image)
        if len(rows) >= LEAST_FEATURES:
            seen = own[feature_map.observations.point_index[rows]]
            inside = ((seen >= reach[0] - 5.0) & (seen <= reach[1] + 5.0)).all(axis=1).mean()
            distance = float(np.linalg.norm(np.median(seen, axis=0) - middle))
            found.append((-float(inside) + 1e-6 * distance, image.image_id, image))
    return [image for _, _, image in sorted(found, key=lambda e: e[:2])[:MOST_IMAGES]]
