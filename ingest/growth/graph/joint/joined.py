"""Several maps as one reconstruction: all their photos, and their points joined where they are the same.

Which points are, photos tell: what a map keeps of its images, observations with descriptors, is asked of the
other maps as a query would be. A photo may be in several maps, with other points of it in each: it is one
photo here, and where two maps have the same keypoint of it, they have the same point.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage
from ingest.colmap.bridge import Model
from ingest.growth.map_images import features_and_points
from ingest.growth.place.localised import in_frame
from ingest.growth.place.overlaps import indexed_area, localise_image
from ingest.growth.values import tied_together
from ingest.register.block import block_of_map

_LEAST_FEATURES = 30  # observations with descriptors that an image needs to be asked
# How far the others may have an image from where its own map has it, over its median viewing distance. Maps
# of six photos are off by some 3 %; a street further on is another place.
_MOST_SHIFT = 0.1
_LEAST_SHARE = 0.5  # of the votes on both points that name a pair


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Links:
    """Points of different maps that are the same.

    Attributes:
        pairs: (k, 4) map and row of its points of the one and of the other, the lower map first.
        heard: number of images that were localised in other maps where their own has them.
        elsewhere: names of those that were localised elsewhere: they show a place that looks alike.
        elsewhere_m: how far, their median.
    """

    pairs: NDArray[np.int64]
    heard: int
    elsewhere: tuple[str, ...]
    elsewhere_m: float = 0.0


def find_links(maps: Sequence[FeatureMap]) -> Links:
    """Links between any two of the maps; they have one extractor and one height datum."""
    found: list[NDArray[np.int64]] = []
    heard, elsewhere = 0, dict[str, float]()
    for a, feature_map in enumerate(maps):
        index = {m.map_id: b for b, m in enumerate(maps)}
        indexed = indexed_area(*(m for m in maps if m is not feature_map))
        for row, image in enumerate(feature_map.images):
            _, points = features_and_points(feature_map, image)
            if len(points) < _LEAST_FEATURES:
                continue
            photo = localise_image(feature_map, image, row, [indexed])
            if photo is None:
                continue
            center = image.cam_from_local.center
            there = in_frame(photo, feature_map.frame).cam_from_local.center
            reach = float(np.median(np.linalg.norm(feature_map.points_local()[points] - center, axis=1)))
            shift = float(np.linalg.norm(there - center))
            if shift > _MOST_SHIFT * max(reach, 1e-9):
                elsewhere[image.name] = shift
                continue
            heard += 1
            b = np.array([index[m] for m in photo.map_ids], dtype=np.int64)[photo.map_of]
            own = points[photo.feature_rows]
            quads = np.stack([np.full(len(b), a), own, b, photo.point_of], axis=1)
            swap = b < a
            quads[swap] = quads[swap][:, [2, 3, 0, 1]]
            found.append(quads)
    return Links(
        pairs=_voted(np.concatenate([np.zeros((0, 4), np.int64), *found])),
        heard=heard,
        elsewhere=tuple(elsewhere),
        elsewhere_m=float(np.median(list(elsewhere.values()))) if elsewhere else 0.0,
    )


def _voted(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pairs (k, 4) that most of the images that have a say name, on both sides, most votes first."""
    pairs, votes = np.unique(quads, axis=0, return_counts=True)
    sure = np.ones(len(pairs), dtype=np.bool_)
    for key in (pairs[:, [0, 1, 2]], pairs[:, [2, 3, 0]]):
        number = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
        sure &= votes > _LEAST_SHARE * np.bincount(number, weights=votes)[number]
    return pairs[sure][np.argsort(-votes[sure], kind="stable")]


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


def join_maps(maps: Sequence[FeatureMap], links: Links) -> JoinedMaps:
    """The maps as one reconstruction in the first one's frame, which lends photos, lenses and joined points.

    Cameras with one EXIF key that tells a focal length, and those of one photo, are one.
    """
    frame, same = maps[0].frame, _same_cameras(maps)
    poses: list[Rigid3] = []
    cameras: list[Camera] = []
    camera_of: list[int] = []
    focals_px: dict[int, list[float]] = {}
    photo_row: dict[tuple[str, ...], int] = {}
    camera_row: dict[int, int] = {}
    for feature_map in maps:
        to_frame = Sim3.from_rigid3(frame.enu_from(feature_map.frame))
        for image in feature_map.images:
            name, camera = _photo_name(feature_map, image), feature_map.cameras[image.camera_id]
            if name in photo_row:
                continue
            photo_row[name] = len(poses)
            poses.append(to_frame.act_on_pose(image.cam_from_local))
            row = camera_row.setdefault(same[feature_map.map_id, image.camera_id], len(cameras))
            if row == len(cameras):
                cameras.append(camera)
            camera_of.append(row)
            if _tells_focal(_key(feature_map, image.camera_id)):
                focals_px.setdefault(row, []).append(camera.focal_px)
    photos = [np.array([photo_row[_photo_name(m, image)] for image in m.images]) for m in maps]
    blocks = [block_of_map(m) for m in maps]
    photo_of = np.concatenate([rows[block.photo_of] for rows, block in zip(photos, blocks, strict=True)])
    keypoint_of, keypoints = _keypoints(photo_of, np.concatenate([block.xy for block in blocks]), len(poses))
    first_point = np.cumsum([0, *(len(block.xyz) for block in blocks)])
    point_of = np.concatenate([block.point_of + k for k, block in zip(first_point, blocks, strict=False)])
    same_point = _same_points(links, first_point, point_of, photo_of, keypoint_of)
    used, number = np.unique(same_point[point_of], return_inverse=True)
    number = number.reshape(-1).astype(np.int64)
    seen = np.unique(np.stack([number, photo_of, keypoint_of], axis=1), axis=0)
    # A keypoint whose points could not be joined stays with the first of them.
    _, once = np.unique(seen[:, 1:], axis=0, return_index=True)
    seen = seen[np.sort(once)]
    model = Model(
        cameras=tuple(cameras),
        rows=np.arange(len(poses), dtype=np.int64),
        camera_of=np.array(camera_of, dtype=np.int64),
        cam_from_sfm=tuple(poses),
        xyz=np.concatenate([m.points_local(frame) for m in maps])[used],
        point_of=seen[:, 0],
        photo_of=seen[:, 1],
        keypoint_of=seen[:, 2],
    )
    ends = np.cumsum([len(block.xy) for block in blocks])[:-1]
    columns = zip(
        photos, *(np.split(column, ends) for column in (photo_of, keypoint_of, number)), strict=True
    )
    rows = tuple(MapRows(photos=p, photo_of=of, keypoint_of=key, point_of=at) for p, of, key, at in columns)
    has = np.zeros((len(model.xyz), len(maps)), dtype=np.int64)
    for a, part in enumerate(rows):
        has[part.point_of, a] = 1
    return JoinedMaps(
        model=model,
        keypoints=keypoints,
        known_focal_px={row: float(np.median(focals)) for row, focals in focals_px.items()},
        maps=rows,
        shared=np.asarray(has.T @ has, dtype=np.int64),
    )


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
    order = np.lexsort((point_of, keypoint_of, photo_of))
    photo, keypoint, point = photo_of[order], keypoint_of[order], point_of[order]
    # Of two points that one keypoint sees.
    again = (photo[1:] == photo[:-1]) & (keypoint[1:] == keypoint[:-1]) & (point[1:] != point[:-1])
    map_a, point_a, map_b, point_b = links.pairs.T
    a = np.concatenate([point[:-1][again], first_point[map_a] + point_a])
    b = np.concatenate([point[1:][again], first_point[map_b] + point_b])
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
