"""Several maps of one neighbourhood in one local frame, laid out for searching.

An area is derived from maps and can be rebuilt at any time; what takes long of that is in their segments.
"""

import logging
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.errors import IncompatibleExtractorError, InvalidValueError
from featuredb.features.exif.read import is_of_film
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.descriptor_index import DescriptorCodes
from featuredb.index.segment import Segment, full_roots, segment_of
from featuredb.index.stacked import Moved, Stacked
from featuredb.maps.error_modes import ErrorModes
from featuredb.maps.feature_map import FeatureMap

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AreaImage:
    """What answers need of a map's image; as in MapImage, in the map's local frame."""

    image_id: int
    camera_id: int
    cam_from_local: Rigid3
    covariance: FloatArray | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, weakref_slot=True)
class Area:
    """Maps in one frame. All arrays are read-only by convention.

    Attributes:
        frame: local ENU frame of everything here.
        maps: the maps without images, points and observations, which the
            segments have (`FeatureMap.bare`); `map_of` and `image_map` index into it.
        segments: (m,) of the maps, whose arrays stay where they are, in mapped files for example.
        points, view_direction: those of the segments, row by row, in `frame`.
        point_start, image_start: (m + 1,) int64, rows where the points and images of each map begin.
        image_map: (i,) int32, ascending.
        image_sights: (i,) int64, of how many points each image has an observation, twice if it has two.
        covisible: (i, i) sparse, numbers of shared points; between maps, of neighbouring places.
        image_center, image_scene, image_reach: those of the segments, one after the other, in `frame`.
        point_row, covariance_root, view_spread, view_distance, descriptors, lists, code: those of the
            segments, row by row; covariances in the maps' own frames.
        lenses: by camera key the maps' cameras that have it: row of the map, camera, images that it took.
        extractor_fingerprint: of all descriptors.
        searched: (m,) which maps take part in a search; the others are there as if they were not.
    """

    frame: LocalFrame
    maps: tuple[FeatureMap, ...]
    segments: tuple[Segment, ...]
    points: Moved
    point_start: NDArray[np.int64]
    point_row: Stacked[np.int32]
    covariance_root: Stacked[np.float16]
    view_direction: Moved
    view_spread: Stacked[np.float16]
    view_distance: Stacked[np.float16]
    descriptors: Stacked[np.uint8]
    lists: Stacked[np.int16]
    code: Stacked[np.uint8]
    image_start: NDArray[np.int64]
    image_map: NDArray[np.int32]
    image_sights: NDArray[np.int64]
    image_center: FloatArray
    image_scene: FloatArray
    image_reach: FloatArray
    covisible: sparse.csr_array
    lenses: Mapping[str, Sequence[tuple[int, Camera, int]]]
    extractor_fingerprint: str
    searched: NDArray[np.bool_]

    def only(self, map_ids: Collection[str]) -> "Area":
        """The same arrays, of which only these maps are searched; nothing is laid out anew."""
        return replace(self, searched=np.array([m.map_id in map_ids for m in self.maps]))

    def searched_points(self) -> NDArray[np.int64]:
        """Rows of the points of the maps that are searched."""
        return np.flatnonzero(np.repeat(self.searched, np.diff(self.point_start)))

    def map_of(self, points: NDArray[np.integer]) -> NDArray[np.intp]:
        """Rows of the maps that points (k,) belong to."""
        return np.searchsorted(self.point_start, points, side="right") - 1

    def searched_images(self) -> NDArray[np.bool_]:
        """(i,) which images are of the maps that are searched."""
        return np.asarray(self.searched[self.image_map], dtype=np.bool_)

    def point_covariance(self, rows: NDArray[np.integer]) -> FloatArray:
        """(k, 3, 3) of points (k,), square metres in `frame`, relative to the map's gauge."""
        root = self.points.turns[self.map_of(rows)] @ full_roots(self.covariance_root[rows])
        return np.asarray(root @ np.swapaxes(root, 1, 2), dtype=np.float64)

    def codes(self, rows: NDArray[np.integer]) -> DescriptorCodes:
        """Of the descriptors of these points (k,)."""
        return DescriptorCodes(lists=self.lists[rows], codes=self.code[rows])

    def points_of_images(self, images: NDArray[np.intp]) -> NDArray[np.int32]:
        """Rows of the points that any of these images sees, ascending, without repetition."""
        found = [np.zeros(0, np.int32)]
        for number in np.unique(self.image_map[images]):
            segment = self.segments[number]
            marked = np.zeros(len(segment), dtype=np.bool_)
            for image in images[self.image_map[images] == number] - self.image_start[number]:
                marked[segment.see_point[slice(*segment.image_start[image : image + 2])]] = True
            found.append((np.flatnonzero(marked) + self.point_start[number]).astype(np.int32))
        return np.concatenate(found)

    def sums_over_sights(self, rows: NDArray[np.int64], of_point: FloatArray) -> FloatArray:
        """(i,) sums, over the points that each image sees, of what some points have.

        Args:
            rows: (k,) of points, ascending, without repetition. of_point: (k,).
        """
        sums = np.zeros(len(self.image_map))
        for number in np.unique(self.map_of(rows)):
            segment, start = self.segments[number], self.point_start[number : number + 2]
            mine = slice(*np.searchsorted(rows, start))
            own = np.zeros(len(segment))
            own[rows[mine] - start[0]] = of_point[mine]
            until = np.concatenate([[0.0], np.cumsum(own[segment.see_point])])
            sums[slice(*self.image_start[number : number + 2])] = np.diff(until[segment.image_start])
        return sums

    def images_that_see(self, rows: NDArray[np.integer]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Which images see some points, in pairs: rows of images, ascending, and positions in `rows`.

        Args:
            rows: (k,) of points, ascending, without repetition.
        """
        pairs = [(np.zeros(0, np.intp), np.zeros(0, np.intp))]
        for number in np.unique(self.map_of(rows)):
            segment = self.segments[number]
            seen = segment.see_point.astype(np.int64) + self.point_start[number]
            position = np.minimum(np.searchsorted(rows, seen), len(rows) - 1)
            hit = np.flatnonzero(rows[position] == seen)
            image = np.searchsorted(segment.image_start, hit, side="right") - 1 + self.image_start[number]
            pairs.append((image, position[hit]))
        return np.concatenate([image for image, _ in pairs]), np.concatenate([at for _, at in pairs])

    def image(self, row: int) -> "AreaImage":
        """One of the images, as its map has it."""
        number = int(self.image_map[row])
        segment = self.segments[number]
        own = row - int(self.image_start[number])
        pose, covariance = segment.image_pose[own], segment.image_covariance[own]
        return AreaImage(
            image_id=int(segment.image_id[own]),
            camera_id=int(segment.image_camera[own]),
            cam_from_local=Rigid3(rotation=pose[:, :3], translation=pose[:, 3]),
            covariance=None if np.isnan(covariance).any() else covariance,
        )

    def modes_of(self, number: int) -> ErrorModes | None:
        """Joint errors of a map; None where it keeps none.

        None, too, where they are broken: answers then rest on the covariances of single images.
        """
        feature_map = self.maps[number]
        try:
            return ErrorModes.of_provenance(feature_map.provenance, len(feature_map.cameras))
        except InvalidValueError as error:
            _LOG.warning("map %s: %s", feature_map.map_id, error)
            return None

    def camera_for_key(self, camera_key: str) -> Camera | None:
        """Intrinsics that the maps have for this EXIF key; of the one that took most images if several.

        Maps lend each other lenses, so that images of all of them count. A model of more parameters comes
        first: it was only taken where the images asked for it.
        """
        taken: Counter[Camera] = Counter()
        for row, camera, images in self.lenses.get(camera_key, ()):
            if self.searched[row]:
                taken[camera] += images
        return max(taken, key=lambda camera: (len(camera.params), taken[camera]), default=None)

    def cameras_of_film(self, film: str) -> list[Camera]:
        """Intrinsics that the maps have of a film's shots, each once; `film`: `film_lens.unnamed_model`."""
        found: dict[Camera, None] = {}
        for key, lenses in self.lenses.items():
            if is_of_film(key, film):
                found |= {camera: None for row, camera, _ in lenses if self.searched[row]}
        return list(found)


def build_area(maps: Sequence[FeatureMap], frame: LocalFrame | None = None) -> Area:
    """Lay the maps out in one frame (default: that of the map with most points).

    Raises:
        InvalidValueError: no maps.
        IncompatibleExtractorError: the maps' descriptors come from different extractors.
    """
    return join_segments([m.bare() for m in maps], [segment_of(m) for m in maps], frame)


def join_segments(
    maps: Sequence[FeatureMap], segments: Sequence[Segment], frame: LocalFrame | None = None
) -> Area:
    """The area of bare maps (`FeatureMap.bare`) and their segments.

    Raises:
        InvalidValueError, IncompatibleExtractorError: as `build_area`.
    """
    if not maps:
        raise InvalidValueError("build_area: expected at least one map, found none")
    fingerprints = sorted({m.extractor_fingerprint for m in maps})
    if len(fingerprints) > 1:
        raise IncompatibleExtractorError(
            f"build_area: maps of one area must share an extractor, found {fingerprints}; "
            "ingest the photos of one of them again"
        )
    frame = frame or maps[int(np.argmax([len(segment) for segment in segments]))].frame
    area_from_maps = [frame.enu_from(m.frame) for m in maps]
    parts = list(zip(area_from_maps, segments, strict=True))
    turns = np.array([move.rotation for move in area_from_maps])
    shifts = np.concatenate([move.act(segment.origin) for move, segment in parts])
    points = np.array([len(segment) for segment in segments])
    images = np.array([len(segment.image_center) for segment in segments])
    scene = np.concatenate([move.act(s.image_scene) for move, s in parts])
    reach = np.concatenate([s.image_reach for s in segments])
    image_map = np.repeat(np.arange(len(maps), dtype=np.int32), images)
    return Area(
        frame=frame,
        maps=tuple(maps),
        segments=tuple(segments),
        points=Moved(segments, "points", turns, shifts),
        point_start=np.cumsum([0, *points]),
        point_row=Stacked(segments, "point_row"),
        covariance_root=Stacked(segments, "covariance_root"),
        view_direction=Moved(segments, "view_direction", turns),
        view_spread=Stacked(segments, "view_spread"),
        view_distance=Stacked(segments, "view_distance"),
        descriptors=Stacked(segments, "descriptors"),
        lists=Stacked(segments, "lists"),
        code=Stacked(segments, "codes"),
        image_start=np.cumsum([0, *images]),
        image_map=image_map,
        image_sights=np.concatenate([np.diff(s.image_start) for s in segments]),
        image_center=np.concatenate([move.act(s.image_center) for move, s in parts]),
        image_scene=scene,
        image_reach=reach,
        covisible=_covisibility(segments, images, image_map, scene, reach),
        lenses=_lenses(maps, segments),
        extractor_fingerprint=fingerprints[0],
        searched=np.ones(len(maps), dtype=np.bool_),
    )


def _lenses(
    maps: Sequence[FeatureMap], segments: Sequence[Segment]
) -> dict[str, list[tuple[int, Camera, int]]]:
    lenses: dict[str, list[tuple[int, Camera, int]]] = {}
    for row, (feature_map, segment) in enumerate(zip(maps, segments, strict=True)):
        taken = np.bincount(segment.image_camera, minlength=len(feature_map.cameras))
        for camera, key, images in zip(feature_map.cameras, feature_map.camera_keys, taken, strict=False):
            if key:
                lenses.setdefault(key, []).append((row, camera, int(images)))
    return lenses


def _raised(parts: Sequence[NDArray[np.int32]], counts: NDArray[np.int64]) -> NDArray[np.int32]:
    """Row numbers of all parts, one after the other, each counted from the rows of those before it."""
    before = np.cumsum(counts) - counts
    return np.concatenate([part + np.int32(first) for part, first in zip(parts, before, strict=True)])


def _joined_starts(parts: Sequence[NDArray[np.int64]], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Starts of slices of all parts, and the end of the last, from those of each part and its length."""
    before = np.cumsum(counts) - counts
    starts = [part[:-1] + first for part, first in zip(parts, before, strict=True)]
    return np.concatenate([*starts, [counts.sum()]])


def _covisibility(
    segments: Sequence[Segment],
    images: NDArray[np.int64],
    image_map: NDArray[np.int32],
    image_scene: FloatArray,
    image_reach: FloatArray,
) -> sparse.csr_array:
    """Shared points between images; images of different maps count as sharing when they look at one place.

    Two maps share no points by construction. Images of different maps whose scenes' middles lie within
    half of the smaller reach of each other are taken to overlap.
    """
    count = len(image_map)
    starts = _joined_starts(
        [s.shared_start for s in segments], np.array([len(s.shared_image) for s in segments])
    )
    columns = _raised([s.shared_image for s in segments], images)
    values = np.concatenate([s.shared_count for s in segments])
    shared = sparse.csr_array((values, columns, starts), shape=(count, count))
    if len(segments) < 2:
        return shared
    from scipy.spatial import cKDTree

    # Each looks as far as its own reach: one that sees for kilometres does not make all of them look so far.
    found = cKDTree(image_scene).query_ball_point(image_scene, 0.5 * image_reach, return_sorted=False)
    a = np.repeat(np.arange(count), [len(others) for others in found])
    b = np.concatenate(found).astype(np.int64)
    gap = np.linalg.norm(image_scene[a] - image_scene[b], axis=1)
    near = (image_map[a] != image_map[b]) & (gap < 0.5 * np.minimum(image_reach[a], image_reach[b]))
    a, b = a[near], b[near]
    links = sparse.coo_array((np.full(len(a), 30, dtype=np.int32), (a, b)), shape=(count, count))
    return sparse.csr_array(shared + links.tocsr())
