"""Several maps of one neighbourhood in one local frame, laid out for searching.

An area is derived from maps and can be rebuilt at any time. Only points that carry descriptors are
in it.
"""

import logging
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.errors import IncompatibleExtractorError, InvalidValueError
from featuredb.features.exif.read import is_of_film
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.view_cones import view_cones
from featuredb.maps.error_modes import ErrorModes
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.move import full_covariances

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Area:
    """Maps in one frame. All arrays are read-only by convention.

    Attributes:
        frame: local ENU frame of everything here.
        maps: the maps without their observations, which take most of the memory and which no answer needs;
            `point_map` and `image_map` index into it.
        points: (p, 3) float64, metres in `frame`.
        point_map: (p,) int32.
        point_row: (p,) int64, row in the map's MapPoints.
        point_covariance: (p, 3, 3) float64, square metres in `frame`, relative to the map's gauge.
        view_direction: (p, 3) float64, mean unit vector from the point to the cameras that saw it.
        view_spread_cos: (p,) float64, cosine of the angle between that mean and the outermost view.
        view_distance: (p, 2) float64, smallest and largest distance of those cameras, metres.
        descriptors: (p, 128) uint8, mean RootSIFT of the track, length 512.
        see_image, see_point: (s,) int32, "image sees point", sorted by image.
        image_start: (i + 1,) int64, slices of see_* per image.
        image_map: (i,) int32.
        image_center: (i, 3) float64, camera centres in `frame`.
        image_scene: (i, 3) float64, median of the points that the image sees.
        image_reach: (i,) float64, median distance of those points from the camera, metres.
        covisible: (i, i) sparse, numbers of shared points; between maps, of neighbouring places.
        extractor_fingerprint: of all descriptors.
        modes: (m,) joint errors of each map, None of those that keep none.
        searched: (m,) which maps take part in a search; the others are there as if they were not.
    """

    frame: LocalFrame
    maps: tuple[FeatureMap, ...]
    points: FloatArray
    point_map: NDArray[np.int32]
    point_row: NDArray[np.int64]
    point_covariance: FloatArray
    view_direction: FloatArray
    view_spread_cos: FloatArray
    view_distance: FloatArray
    descriptors: NDArray[np.uint8]
    see_image: NDArray[np.int32]
    see_point: NDArray[np.int32]
    image_start: NDArray[np.int64]
    image_map: NDArray[np.int32]
    image_center: FloatArray
    image_scene: FloatArray
    image_reach: FloatArray
    covisible: sparse.csr_array
    extractor_fingerprint: str
    modes: tuple[ErrorModes | None, ...]
    searched: NDArray[np.bool_]

    def only(self, map_ids: Collection[str]) -> "Area":
        """The same arrays, of which only these maps are searched; nothing is laid out anew."""
        return replace(self, searched=np.array([m.map_id in map_ids for m in self.maps]))

    def searched_points(self) -> NDArray[np.int64]:
        """Rows of the points of the maps that are searched."""
        return np.flatnonzero(self.searched[self.point_map])

    def searched_images(self) -> NDArray[np.bool_]:
        """(i,) which images are of the maps that are searched."""
        return np.asarray(self.searched[self.image_map], dtype=np.bool_)

    def points_of_images(self, images: NDArray[np.intp]) -> NDArray[np.int32]:
        """Rows of the points that any of these images sees, ascending, without repetition."""
        seen = np.zeros(len(self.points), dtype=np.bool_)
        for i in images:
            seen[self.see_point[self.image_start[i] : self.image_start[i + 1]]] = True
        return np.flatnonzero(seen).astype(np.int32)

    def camera_for_key(self, camera_key: str) -> Camera | None:
        """Intrinsics that the maps have for this EXIF key; of the one that took most images if several.

        Maps lend each other lenses, so that images of all of them count. A model of more parameters comes
        first: it was only taken where the images asked for it.
        """
        taken: Counter[Camera] = Counter()
        for feature_map in compress(self.maps, self.searched):
            images = Counter(image.camera_id for image in feature_map.images)
            for c, key in enumerate(feature_map.camera_keys[: len(feature_map.cameras)]):
                if key and key == camera_key:
                    taken[feature_map.cameras[c]] += images[c]
        return max(taken, key=lambda camera: (len(camera.params), taken[camera]), default=None)

    def cameras_of_film(self, film: str) -> list[Camera]:
        """Intrinsics that the maps have of a film's shots, each once; `film`: `film_lens.unnamed_model`."""
        found: dict[Camera, None] = {}
        for feature_map in compress(self.maps, self.searched):
            for camera, key in zip(feature_map.cameras, feature_map.camera_keys, strict=False):
                if is_of_film(key, film):
                    found[camera] = None
        return list(found)


def build_area(maps: Sequence[FeatureMap], frame: LocalFrame | None = None) -> Area:
    """Lay the maps out in one frame (default: that of the map with most points).

    Raises:
        InvalidValueError: no maps.
        IncompatibleExtractorError: the maps' descriptors come from different extractors.
    """
    if not maps:
        raise InvalidValueError("build_area: expected at least one map, found none")
    fingerprints = sorted({m.extractor_fingerprint for m in maps})
    if len(fingerprints) > 1:
        raise IncompatibleExtractorError(
            f"build_area: maps of one area must share an extractor, found {fingerprints}; "
            "ingest the photos of one of them again"
        )
    frame = frame or max(maps, key=lambda m: len(m.points)).frame
    parts = [_lay_out(feature_map, frame) for feature_map in maps]
    points, images = ([len(part[name]) for part in parts] for name in ("points", "image_center"))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    see_image, see_point = (
        np.concatenate(
            [part[name] + offset for part, offset in zip(parts, np.cumsum([0, *counts]), strict=False)]
        ).astype(np.int32)
        for name, counts in (("see_image", images), ("see_point", points))
    )
    joined |= {"see_image": see_image, "see_point": see_point}
    image_map = _repeat(images)
    return Area(
        frame=frame,
        maps=tuple(replace(m, observations=m.observations.none()) for m in maps),
        **joined,
        point_map=_repeat(points),
        image_start=np.searchsorted(see_image, np.arange(len(image_map) + 1)).astype(np.int64),
        image_map=image_map,
        covisible=_covisibility(
            see_image, see_point, image_map, joined["image_scene"], joined["image_reach"]
        ),
        extractor_fingerprint=fingerprints[0],
        modes=tuple(_modes(feature_map) for feature_map in maps),
        searched=np.ones(len(maps), dtype=np.bool_),
    )


def _modes(feature_map: FeatureMap) -> ErrorModes | None:
    """None, too, where they are broken: answers then rest on the covariances of single images."""
    try:
        return ErrorModes.of_provenance(feature_map.provenance, len(feature_map.cameras))
    except InvalidValueError as error:
        _LOG.warning("map %s: %s", feature_map.map_id, error)
        return None


def _lay_out(feature_map: FeatureMap, frame: LocalFrame) -> dict[str, NDArray[Any]]:
    """One map's arrays by their names in Area, counted from zero."""
    area_from_map = frame.enu_from(feature_map.frame)
    observations = feature_map.observations
    keep = np.flatnonzero(observations.has_descriptor)
    rows, see_point = np.unique(observations.point_index[keep], return_inverse=True)
    points = feature_map.points_local(frame)[rows]
    see_image = feature_map.image_rows(observations.image_id[keep])
    centers = np.array([area_from_map.act(i.cam_from_local.center) for i in feature_map.images]).reshape(
        -1, 3
    )
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
    turn = area_from_map.rotation
    return {
        "points": points,
        "point_row": rows,
        "point_covariance": turn @ full_covariances(feature_map.points.covariance[rows]) @ turn.T,
        "view_direction": cones.direction,
        "view_spread_cos": cones.spread_cos,
        "view_distance": np.stack([near, far], axis=1),
        "descriptors": _mean_descriptors(observations.descriptors[keep][order], see_point, len(rows)),
        "see_image": see_image.astype(np.int32),
        "see_point": see_point.astype(np.int32),
        "image_center": centers,
        "image_scene": scene,
        "image_reach": reach,
    }


def _mean_descriptors(
    descriptors: NDArray[np.uint8], point: NDArray[np.intp], count: int
) -> NDArray[np.uint8]:
    """Mean descriptor of each track, brought back to length 512 and 8 bits."""
    total = _sum_by(point, descriptors.astype(np.float32), count)
    norm = np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.clip(np.rint(total * (512.0 / norm)), 0, 255), dtype=np.uint8)


def _sum_by(group: NDArray[np.intp], values: NDArray[np.floating], count: int) -> FloatArray:
    """Sums (count, k) of rows of values (n, k) by group number (n,)."""
    matrix = sparse.csr_array(
        (np.ones(len(group)), (group, np.arange(len(group)))), shape=(count, len(group))
    )
    return np.asarray(matrix @ values, dtype=np.float64).reshape(count, values.shape[1])


def _covisibility(
    see_image: NDArray[np.int32],
    see_point: NDArray[np.int32],
    image_map: NDArray[np.int32],
    image_scene: FloatArray,
    image_reach: FloatArray,
) -> sparse.csr_array:
    """Shared points between images; images of different maps count as sharing when they look at one place.

    Two maps share no points by construction. Images of different maps whose scenes' middles lie within
    half of the smaller reach of each other are taken to overlap.
    """
    count = len(image_map)
    sees = sparse.csr_array(
        (np.ones(len(see_image), dtype=np.int32), (see_image, see_point)),
        shape=(count, int(see_point.max()) + 1 if len(see_point) else 1),
    )
    sees.data[:] = 1  # a point that an image sees twice is one point
    shared = sparse.csr_array(sees @ sees.T)
    if len(np.unique(image_map)) < 2:
        return shared
    from scipy.spatial import cKDTree

    pairs = cKDTree(image_scene).query_pairs(0.5 * float(image_reach.max()), output_type="ndarray")
    a, b = pairs[:, 0], pairs[:, 1]
    gap = np.linalg.norm(image_scene[a] - image_scene[b], axis=1)
    near = (image_map[a] != image_map[b]) & (gap < 0.5 * np.minimum(image_reach[a], image_reach[b]))
    a, b = a[near], b[near]
    links = sparse.coo_array(
        (np.full(2 * len(a), 30, dtype=np.int32), (np.r_[a, b], np.r_[b, a])), shape=(count, count)
    )
    return sparse.csr_array(shared + links.tocsr())


def _repeat(counts: list[int]) -> NDArray[np.int32]:
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)
