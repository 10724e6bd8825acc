"""A part of a map that is a map itself: some of its images with what they see, some of its points.

Or all of it, with descriptors for some of its points.
"""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.maps.error_modes import ErrorModes
from featuredb.maps.unplaced_map import MapKind


def only_images(feature_map: MapKind, image_ids: Collection[int]) -> MapKind:
    """The map with some of its images, their cameras, observations and points.

    Image ids stay; cameras and points are numbered anew. Coordinates, covariances and reprojection errors of
    points stay what all images have made of them; `track_length` counts the images that are left.

    Args:
        image_ids: of the images that stay; points that fewer than two of them see are left out.

    Raises:
        InvalidValueError: an id that the map does not have, or broken `error_modes`.
    """
    wanted = set(image_ids)
    unknown = wanted - {image.image_id for image in feature_map.images}
    if unknown:
        raise InvalidValueError(
            f"FeatureMap {feature_map.map_id}: expected ids of its images, found {sorted(unknown)[:5]}"
        )
    images = [image for image in feature_map.images if image.image_id in wanted]
    if len(images) == len(feature_map.images):
        return feature_map
    cameras = sorted({image.camera_id for image in images})
    seen = feature_map.observations
    stays = np.isin(seen.image_id, np.array(sorted(wanted), dtype=np.int32))
    # How many images see each point; one that sees it twice counts once.
    sights = np.stack([seen.point_index[stays], seen.image_id[stays].astype(np.int64)], axis=1)
    views = np.bincount(np.unique(sights, axis=0)[:, 0], minlength=len(feature_map.points)).astype(np.int32)
    modes = ErrorModes.of_provenance(feature_map.provenance, len(feature_map.cameras))
    kept = {} if modes is None else modes.of(wanted, cameras).as_provenance()
    part = replace(
        feature_map,
        provenance=feature_map.provenance | kept,
        cameras=tuple(feature_map.cameras[c] for c in cameras),
        camera_keys=tuple(feature_map.camera_keys[c] for c in cameras) if feature_map.camera_keys else (),
        images=tuple(replace(image, camera_id=cameras.index(image.camera_id)) for image in images),
        points=replace(feature_map.points, track_length=views),
        observations=seen.take(stays),
    )
    return only_points(part, views >= 2)


def only_points(feature_map: MapKind, stays: NDArray[np.bool_]) -> MapKind:
    """The map with some of its points (n,) and their observations; points are numbered anew."""
    if stays.all():
        return feature_map
    new_row = np.cumsum(stays) - 1
    seen = feature_map.observations.take(stays[feature_map.observations.point_index])
    return replace(
        feature_map,
        points=feature_map.points.take(stays),
        observations=replace(seen, point_index=new_row[seen.point_index]),
    )


def answering_with(feature_map: MapKind, points: NDArray[np.bool_]) -> MapKind:
    """The map with descriptors for some of its points (n,) only."""
    seen = feature_map.observations
    keep = seen.has_descriptor & points[seen.point_index]
    descriptors = np.where(keep[:, None], seen.descriptors, np.uint8(0))
    return replace(feature_map, observations=replace(seen, has_descriptor=keep, descriptors=descriptors))
