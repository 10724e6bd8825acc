"""Several maps as one reconstruction: all their photos, and their points joined where they are the same.

A photo may be in several maps, with other points of it in each: it is one photo here, and where two maps have
the same keypoint of it, they have the same point.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.colmap.bridge import Model
from ingest.growth.graph.joint.links import Links
from ingest.growth.values import tied_together


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapRows:
    """Where a map's images and observations are in the model.

    Attributes:
        photos: (i,) row of the model's photos of each image.
        photo_of, keypoint_of, point_of: (m,) of each observation: photo, its keypoint, the model's point.
    """

    photos: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    keypoint_of: NDArray[np.int64]
    point_of: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JoinedMaps:
    """The maps as one model, in metres, in one local frame.

    Attributes:
        keypoints: pixels (n, 2) of each photo of the model.
        known_focal_px: by camera, what the maps say of a focal length that EXIF has told: the median. From
            above, focal length and height hardly differ in the pixels, and maps do not keep EXIF's own.
        shared: (maps, maps) numbers of points that two maps have in common.
    """

    model: Model
    keypoints: tuple[FloatArray, ...]
    known_focal_px: Mapping[int, float]
    maps: tuple[MapRows, ...]
    shared: NDArray[np.int64]


def join_maps(maps: Sequence[FeatureMap], links: Links, frame: LocalFrame) -> JoinedMaps:
    """The maps as one reconstruction; photos, lenses and joined points are as the first map has them.

    Cameras with one EXIF key that tells a focal length, and those of one photo, are one.
    """
    photos = _Photos(maps, frame)
    photo_rows = photos.rows
    counts = [len(m.observations) for m in maps]
    ends = np.cumsum([0, *counts])
    photo_of = np.concatenate([_photo_of(m, rows) for m, rows in zip(maps, photo_rows, strict=True)])
    pixels = np.concatenate([m.observations.xy for m in maps]).astype(np.float64)
    keypoint_of, keypoints = _keypoints(photo_of, pixels, len(photos.poses))
    first_point = np.cumsum([0, *(len(m.points) for m in maps)])
    point_of = np.concatenate(
        [start + m.observations.point_index for start, m in zip(first_point, maps, strict=False)]
    )
    same = _same_points(links, first_point, point_of, photo_of, keypoint_of)
    used, number = np.unique(same[point_of], return_inverse=True)
    number = number.reshape(-1).astype(np.int64)
    seen = np.unique(np.stack([number, photo_of, keypoint_of], axis=1), axis=0)
    # A keypoint whose points could not be joined stays with the first of them.
    _, once = np.unique(seen[:, 1:], axis=0, return_index=True)
    seen = seen[np.sort(once)]
    model = Model(
        cameras=tuple(photos.cameras),
        rows=np.arange(len(photos.poses), dtype=np.int64),
        camera_of=np.array(photos.camera_of, dtype=np.int64),
        cam_from_sfm=tuple(photos.poses),
        xyz=np.concatenate([m.points_local(frame) for m in maps])[used],
        point_of=seen[:, 0],
        photo_of=seen[:, 1],
        keypoint_of=seen[:, 2],
    )
    rows = tuple(
        MapRows(
            photos=photo_rows[a],
            photo_of=photo_of[ends[a] : ends[a + 1]],
            keypoint_of=keypoint_of[ends[a] : ends[a + 1]],
            point_of=number[ends[a] : ends[a + 1]],
        )
        for a in range(len(maps))
    )
    has = np.zeros((len(model.xyz), len(maps)), dtype=np.int64)
    for a, part in enumerate(rows):
        has[part.point_of, a] = 1
    return JoinedMaps(
        model=model,
        keypoints=keypoints,
        known_focal_px=photos.known_focal_px(),
        maps=rows,
        shared=np.asarray(has.T @ has, dtype=np.int64),
    )


class _Photos:
    """Photos and cameras of all maps, each once; rows of the photos (i,) of each map's images."""

    def __init__(self, maps: Sequence[FeatureMap], frame: LocalFrame) -> None:
        self.poses: list[Rigid3] = []
        self.camera_of: list[int] = []
        self.cameras: list[Camera] = []
        self.rows: list[NDArray[np.int64]] = []
        self._focals_px: dict[int, list[float]] = {}
        same = _same_cameras(maps)
        photo_row: dict[tuple[str, ...], int] = {}
        camera_row: dict[int, int] = {}
        for feature_map in maps:
            to_frame = Sim3.from_rigid3(frame.enu_from(feature_map.frame))
            for image in feature_map.images:
                name, camera = _photo_name(feature_map, image), feature_map.cameras[image.camera_id]
                if name in photo_row:
                    continue
                photo_row[name] = len(self.poses)
                self.poses.append(to_frame.act_on_pose(image.cam_from_local))
                row = camera_row.setdefault(same[feature_map.map_id, image.camera_id], len(self.cameras))
                if row == len(self.cameras):
                    self.cameras.append(camera)
                self.camera_of.append(row)
                if _tells_focal(_key(feature_map, image.camera_id)):
                    self._focals_px.setdefault(row, []).append(camera.focal_px)
            mine = [photo_row[_photo_name(feature_map, image)] for image in feature_map.images]
            self.rows.append(np.array(mine, dtype=np.int64))

    def known_focal_px(self) -> dict[int, float]:
        return {row: float(np.median(focals)) for row, focals in self._focals_px.items()}


def _photo_name(feature_map: FeatureMap, image: MapImage) -> tuple[str, ...]:
    return ("", image.sha256) if image.sha256 else (feature_map.map_id, str(image.image_id))


def _key(feature_map: FeatureMap, camera_id: int) -> str:
    return feature_map.camera_keys[camera_id] if feature_map.camera_keys else ""


def _tells_focal(key: str) -> bool:
    """Whether an EXIF key (`featuredb.features.exif.read.camera_key`) has a focal length in it."""
    return re.search(r"\|f\d+(\||$)", key) is not None


def _same_cameras(maps: Sequence[FeatureMap]) -> dict[tuple[str, int], int]:
    """A number for each map's cameras; those of one EXIF key with focal length, or of one photo, have one."""
    nodes = [(m.map_id, c) for m in maps for c in range(len(m.cameras))]
    groups: dict[tuple[str, ...], list[tuple[str, int]]] = {}
    for feature_map in maps:
        for image in feature_map.images:
            node = feature_map.map_id, image.camera_id
            groups.setdefault(("photo", *_photo_name(feature_map, image)), []).append(node)
            key, camera = _key(feature_map, image.camera_id), feature_map.cameras[image.camera_id]
            if _tells_focal(key):
                groups.setdefault(("key", key, f"{camera.width}x{camera.height}"), []).append(node)
    pairs = [(group[0], other) for group in groups.values() for other in group]
    return dict(zip(nodes, tied_together(nodes, pairs), strict=True))


def _photo_of(feature_map: FeatureMap, photos: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of the photos for each observation of a map."""
    row_of = {image.image_id: int(row) for image, row in zip(feature_map.images, photos, strict=True)}
    return np.array([row_of[i] for i in feature_map.observations.image_id.tolist()], dtype=np.int64)


def _keypoints(
    photo_of: NDArray[np.int64], pixels: FloatArray, photos: int
) -> tuple[NDArray[np.int64], tuple[FloatArray, ...]]:
    """The keypoint (m,) of each observation, those of one pixel once, and each photo's pixels (n, 2)."""
    keypoint_of = np.zeros(len(photo_of), dtype=np.int64)
    keypoints = []
    for k in range(photos):
        mine = np.flatnonzero(photo_of == k)
        distinct, index = np.unique(pixels[mine], axis=0, return_inverse=True)
        keypoint_of[mine] = index.reshape(-1)
        keypoints.append(distinct.reshape(-1, 2))
    return keypoint_of, tuple(keypoints)


def _same_points(
    links: Links,
    first_point: NDArray[np.int64],
    point_of: NDArray[np.int64],
    photo_of: NDArray[np.int64],
    keypoint_of: NDArray[np.int64],
) -> NDArray[np.int64]:
    """For every point of all maps the lowest that is the same; no photo sees one point at two pixels."""
    a, b = _of_one_keypoint(point_of, photo_of, keypoint_of)
    a = np.concatenate([a, first_point[links.map_a] + links.point_a])
    b = np.concatenate([b, first_point[links.map_b] + links.point_b])
    rows = np.flatnonzero(np.isin(point_of, np.concatenate([a, b])))
    seen: dict[int, dict[int, int]] = {}
    for row in rows.tolist():
        seen.setdefault(int(point_of[row]), {})[int(photo_of[row])] = int(keypoint_of[row])
    parent = list(range(int(first_point[-1])))

    def root(point: int) -> int:
        while parent[point] != point:
            parent[point] = parent[parent[point]]
            point = parent[point]
        return point

    for one, other in zip(a.tolist(), b.tolist(), strict=True):
        low, high = sorted((root(one), root(other)))
        if low == high or low not in seen or high not in seen:
            continue
        if all(seen[high].get(photo, keypoint) == keypoint for photo, keypoint in seen[low].items()):
            parent[high] = low
            seen[low] |= seen.pop(high)
    return np.array([root(point) for point in range(len(parent))], dtype=np.int64)


def _of_one_keypoint(
    point_of: NDArray[np.int64], photo_of: NDArray[np.int64], keypoint_of: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of points that one keypoint sees."""
    order = np.lexsort((point_of, keypoint_of, photo_of))
    photo, keypoint, point = photo_of[order], keypoint_of[order], point_of[order]
    next_same = (photo[1:] == photo[:-1]) & (keypoint[1:] == keypoint[:-1]) & (point[1:] != point[:-1])
    rows = np.flatnonzero(next_same)
    return point[rows], point[rows + 1]


def observed_pixels(joined: JoinedMaps, model: Model) -> FloatArray:
    """(m, 2) of the model's observations."""
    pixels = np.zeros((len(model.point_of), 2))
    for k, keypoints in enumerate(joined.keypoints):
        mine = model.photo_of == k
        pixels[mine] = keypoints[model.keypoint_of[mine]]
    return pixels
