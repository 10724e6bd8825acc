"""One state of a map, laid out for searching in the map's own frame.

A segment is derived from a map and never changes: it can be made again at any time, and kept. Only points
that carry descriptors are in it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.view_cones import view_cones
from featuredb.index.descriptor_index import DescriptorCodes
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import full_covariances

_LOWER = np.tril_indices(3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class Segment:
    """Arrays of p points and i images, by convention read-only; lengths in metres, in the map's local frame.

    Attributes:
        origin: (1, 3) float64, in the middle of the points.
        points: (p, 3) float32, from there; of a map 10 km wide they are rounded by half a millimetre.
        point_row: (p,) int32, row in the map's MapPoints, ascending.
        covariance_root: (p, 6) float16, metres: lower triangles L of covariances L @ L.T, row by row.
        view_direction: (p, 3) float16, mean unit vector from the point to the cameras that saw it.
        view_spread: (p,) float16, radians between that mean and the outermost view.
        view_distance: (p,) float16, between the nearest and the farthest of those cameras, in the middle.
        descriptors: (p, 128) uint8, mean RootSIFT of the track, length 512.
        lists, codes: (p,) int16 and (p, 16) uint8, of the descriptors (DescriptorCodes).
        image_id, image_camera: (i,) int32, as in MapImage.
        image_pose: (i, 3, 4) float64, rotation and translation of MapImage.cam_from_local.
        image_covariance: (i, 6, 6) float64, MapImage.covariance; NaN where there is none.
        image_start: (i + 1,) int64, slices of see_point for each image.
        see_point: (s,) uint16 of up to 65,536 points, else int32, points that the image sees, ascending.
        image_center: (i, 3) float64, camera centres.
        image_scene: (i, 3) float64, median of the points that the image sees.
        image_reach: (i,) float64, median distance of those points from the camera.
        shared_start, shared_image, shared_count: (i + 1,) int64, (c,) and (c,) int32: rows of a matrix of
            how many points images share, as scipy.sparse.csr_array has it.
    """

    origin: FloatArray
    points: NDArray[np.float32]
    point_row: NDArray[np.int32]
    covariance_root: NDArray[np.float16]
    view_direction: NDArray[np.float16]
    view_spread: NDArray[np.float16]
    view_distance: NDArray[np.float16]
    descriptors: NDArray[np.uint8]
    lists: NDArray[np.int16]
    codes: NDArray[np.uint8]
    image_id: NDArray[np.int32]
    image_camera: NDArray[np.int32]
    image_pose: FloatArray
    image_covariance: FloatArray
    image_start: NDArray[np.int64]
    see_point: NDArray[np.uint16] | NDArray[np.int32]
    image_center: FloatArray
    image_scene: FloatArray
    image_reach: FloatArray
    shared_start: NDArray[np.int64]
    shared_image: NDArray[np.int32]
    shared_count: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.points)


def row_type(points: int) -> np.dtype[Any]:
    """Of Segment.see_point."""
    return np.dtype("<u2" if points <= 1 << 16 else "<i4")


def full_roots(lower: NDArray[np.float16]) -> FloatArray:
    """(n, 3, 3) lower triangles of Segment.covariance_root (n, 6)."""
    full = np.zeros((len(lower), 3, 3))
    full[:, _LOWER[0], _LOWER[1]] = lower
    return full


def segment_of(feature_map: FeatureMap) -> Segment:
    """The map's points with descriptors and its images, laid out."""
    observations = feature_map.observations
    keep = np.flatnonzero(observations.has_descriptor)
    rows, see_point = np.unique(observations.point_index[keep], return_inverse=True)
    points = feature_map.points_local()[rows]
    origin = np.median(points, axis=0, keepdims=True) if len(points) else np.zeros((1, 3))
    see_image = feature_map.image_rows(observations.image_id[keep])
    images = feature_map.images
    poses = [image.cam_from_local for image in images]
    centers = np.array([pose.center for pose in poses]).reshape(-1, 3)
    cones = view_cones(points, centers, see_point, see_image)
    distance = np.linalg.norm(centers[see_image] - points[see_point], axis=1)
    near, far = np.full(len(rows), np.inf), np.zeros(len(rows))
    np.minimum.at(near, see_point, distance)
    np.maximum.at(far, see_point, distance)
    order = np.lexsort((see_point, see_image))
    see_image, see_point = see_image[order], see_point[order]
    start = np.searchsorted(see_image, np.arange(len(centers) + 1))
    scene, reach = centers.copy(), np.zeros(len(centers))
    for i in range(len(centers)):
        seen = points[see_point[start[i] : start[i + 1]]]
        if len(seen):
            scene[i] = np.median(seen, axis=0)
            reach[i] = np.median(np.linalg.norm(seen - centers[i], axis=1))
    descriptors = _mean_descriptors(observations.descriptors[keep][order], see_point, len(rows))
    codes = DescriptorCodes.of(descriptors)
    shared = _shared(see_image, see_point, len(centers), len(rows))
    return Segment(
        origin=origin,
        points=(points - origin).astype(np.float32),
        point_row=rows.astype(np.int32),
        covariance_root=_halved(_roots(feature_map.points.covariance[rows])),
        view_direction=cones.direction.astype(np.float16),
        view_spread=cones.spread.astype(np.float16),
        view_distance=_halved(0.5 * (near + far)),
        descriptors=descriptors,
        lists=codes.lists,
        codes=codes.codes,
        image_id=np.array([image.image_id for image in images], dtype=np.int32),
        image_camera=np.array([image.camera_id for image in images], dtype=np.int32),
        image_pose=np.array([np.column_stack([p.rotation, p.translation]) for p in poses]).reshape(-1, 3, 4),
        image_covariance=np.array(
            [np.full((6, 6), np.nan) if image.covariance is None else image.covariance for image in images]
        ).reshape(-1, 6, 6),
        image_start=start.astype(np.int64),
        see_point=see_point.astype(row_type(len(rows))),
        image_center=centers,
        image_scene=scene,
        image_reach=reach,
        shared_start=shared.indptr.astype(np.int64),
        shared_image=shared.indices.astype(np.int32),
        shared_count=shared.data.astype(np.int32),
    )


def _roots(upper: NDArray[np.float32]) -> FloatArray:
    """(n, 6) lower triangles of MapPoints.covariance (n, 6), which may have no extent in some direction.

    One that is no number says nothing: it is as wide as half precision can say.
    """
    known = np.isfinite(upper).all(axis=1, keepdims=True)
    unknown = 1e10 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], np.float32)
    values, axes = np.linalg.eigh(full_covariances(np.where(known, upper, unknown)))
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    lower = np.swapaxes(np.linalg.qr(np.swapaxes(root, 1, 2), mode="r"), 1, 2)
    return np.asarray(lower[:, _LOWER[0], _LOWER[1]])


def _halved(metres: FloatArray) -> NDArray[np.float16]:
    """In half precision; what is larger than that holds becomes the largest it holds, 65 km."""
    most = float(np.finfo(np.float16).max)
    return np.clip(metres, -most, most).astype(np.float16)


def _shared(
    see_image: NDArray[np.intp], see_point: NDArray[np.intp], images: int, points: int
) -> sparse.csr_array:
    """(images, images) how many points two images share; one that an image sees twice is one."""
    sees = sparse.csr_array(
        (np.ones(len(see_image), dtype=np.int32), (see_image, see_point)), shape=(images, max(points, 1))
    )
    sees.data[:] = 1
    return sparse.csr_array(sees @ sees.T)


def _mean_descriptors(
    descriptors: NDArray[np.uint8], point: NDArray[np.intp], count: int
) -> NDArray[np.uint8]:
    """Mean descriptor of each track, brought back to length 512 and 8 bits."""
    matrix = sparse.csr_array(
        (np.ones(len(point), np.float32), (point, np.arange(len(point)))), shape=(count, len(point))
    )
    total = np.asarray(matrix @ descriptors.astype(np.float32)).reshape(count, descriptors.shape[1])
    norm = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.clip(np.rint(total * (512.0 / norm)), 0, 255), dtype=np.uint8)
