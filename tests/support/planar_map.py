"""A real, small map with exact truth: tilted views of one flat, textured field.

Points are keypoints of the views intersected with the plane, so map and truth need no reconstruction.
"""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement

EPSG = 32632
EASTING, NORTHING, HEIGHT = 456_800.0, 5_429_300.0, 120.0
CAMERA = Camera(model="PINHOLE", width=640, height=480, params=(600.0, 600.0, 320.0, 240.0))
_TEXEL_M = 0.08
_SIDE_M = 120.0
_OPTIONS = ExtractorOptions(max_features=1500)


@cache
def field_texture(seed: int) -> NDArray[np.uint8]:
    """Noise of several scales, (n, n) uint8, read-only; row 0 is the field's north edge, 0.08 m a texel."""
    rng = np.random.default_rng(seed)
    side = round(_SIDE_M / _TEXEL_M)
    total = np.zeros((side, side), dtype=np.float32)
    for cell, weight in ((64, 1.0), (24, 1.0), (10, 1.0), (4, 0.7)):
        coarse = rng.standard_normal((side // cell + 2,) * 2).astype(np.float32)
        total += weight * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(128 + 45 * total, 0, 255).astype(np.uint8)
    texture.setflags(write=False)
    return texture


def view(east: float, north: float, up: float, tilt_deg: float, heading_deg: float) -> Rigid3:
    """cam_from_local of a camera that looks down, tilted forward, image top towards the heading."""
    tilt, heading = np.radians(tilt_deg), np.radians(heading_deg)
    forward = np.array([np.sin(heading), np.cos(heading), 0.0])
    right = np.array([np.cos(heading), -np.sin(heading), 0.0])
    axis = np.cos(tilt) * np.array([0.0, 0.0, -1.0]) + np.sin(tilt) * forward
    rotation = np.stack([right, np.cross(axis, right), axis])
    return Rigid3(rotation=rotation, translation=-rotation @ np.array([east, north, up]))


def render(texture: NDArray[np.uint8], cam_from_local: Rigid3, seed: int = 0) -> NDArray[np.uint8]:
    """Photo (480, 640) uint8 of the field by CAMERA, with a little noise."""
    local_from_texel = np.array([[_TEXEL_M, 0, -_SIDE_M / 2], [0, -_TEXEL_M, _SIDE_M / 2], [0, 0, 1.0]])
    k = np.array([[600.0, 0, 320.0], [0, 600.0, 240.0], [0, 0, 1]])
    r, t = cam_from_local.rotation, cam_from_local.translation
    image_from_texel = k @ np.column_stack([r[:, 0], r[:, 1], t]) @ local_from_texel
    # OpenCV counts pixel centres from 0, the camera and the texture from 0.5.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    cv_homography = np.linalg.inv(half) @ image_from_texel @ half
    image = cv2.warpPerspective(texture, cv_homography, (640, 480), flags=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def planar_map(
    texture_seed: int = 1, *, map_id: str = "field", east_m: float = 0.0, fingerprint: str | None = None
) -> FeatureMap:
    """The map of a field whose middle lies `east_m` east of (EASTING, NORTHING), made from nine views."""
    frame = LocalFrame.from_utm(EASTING + east_m, NORTHING, HEIGHT, EPSG)
    texture = field_texture(texture_seed)
    poses, found = _seen(texture.tobytes(), texture.shape)
    ground = [_on_ground(f.xy, pose) for f, pose in zip(found, poses, strict=True)]
    points, rows = _tracks(ground, [f.scale for f in found])
    point_index = np.concatenate(rows)
    image_id = np.concatenate([np.full(len(r), i) for i, r in enumerate(rows)])
    keep = point_index >= 0
    length = np.bincount(point_index[keep], minlength=len(points))
    long = length >= 3
    new_index = np.cumsum(long) - 1
    keep &= np.where(point_index >= 0, long[point_index], False)
    count = int(long.sum())
    stack = {name: np.concatenate([getattr(f, name) for f in found])[keep] for name in _PER_KEYPOINT}
    return FeatureMap(
        map_id=map_id,
        name=f"{map_id} (flat)",
        epsg=EPSG,
        height_datum="ellipsoidal",
        frame=frame,
        cameras=(CAMERA,),
        images=tuple(
            MapImage(image_id=i, name=f"{i}.png", sha256=f"{i:064x}", camera_id=0, cam_from_local=pose)
            for i, pose in enumerate(poses)
        ),
        points=MapPoints(
            utm=frame.utm_from_enu(np.column_stack([points[long], np.zeros(count)]), EPSG),
            rgb=np.full((count, 3), 128, dtype=np.uint8),
            track_length=length[long].astype(np.int32),
            error_px=np.full(count, 0.5, dtype=np.float32),
            covariance=np.tile(np.array([1e-3, 0, 0, 1e-3, 0, 1e-3], dtype=np.float32), (count, 1)),
        ),
        observations=MapObservations(
            point_index=new_index[point_index[keep]].astype(np.int64),
            image_id=image_id[keep].astype(np.int32),
            has_descriptor=np.ones(int(keep.sum()), dtype=bool),
            **stack,
        ),
        placement=Placement(
            method="gcp",
            local_from_sfm=Sim3.identity(),
            covariance=np.diag([1e-10] * 4 + [1e-4] * 3),
            residual_rms_m=0.01,
        ),
        extractor_fingerprint=fingerprint or _OPTIONS.fingerprint,
    )


@cache  # seconds, and many tests begin with the field of one seed
def _seen(content: bytes, shape: tuple[int, ...]) -> tuple[tuple[Rigid3, ...], tuple[Features, ...]]:
    """The nine views of a texture, and the keypoints of each."""
    texture = np.frombuffer(content, dtype=np.uint8).reshape(shape)
    poses = tuple(
        view(e, n, 45.0, tilt, heading)
        for (e, n), tilt, heading in zip(
            [(e, n) for e in (-14, 0, 14) for n in (-14, 0, 14)],
            [0, 12, 5, 15, 0, 10, 5, 12, 0],
            [0, 20, 350, 40, 0, 90, 10, 330, 60],
            strict=True,
        )
    )
    return poses, tuple(extract(render(texture, pose, seed=i), _OPTIONS) for i, pose in enumerate(poses))


_PER_KEYPOINT = ("xy", "scale", "angle", "descriptors")


def _on_ground(xy: NDArray[np.float32], cam_from_local: Rigid3) -> NDArray[np.float64]:
    """Where the rays of pixels (n, 2) meet the plane, (n, 2) east and north."""
    rays = np.column_stack([CAMERA.unproject(xy), np.ones(len(xy))]) @ cam_from_local.rotation
    center = cam_from_local.center
    return (center + rays * (-center[2] / rays[:, 2])[:, None])[:, :2]


def _tracks(
    ground: list[NDArray[np.float64]], scales: list[NDArray[np.float32]]
) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Points (p, 2) and for each view the point of each keypoint (or -1): nearest within 5 cm, like scale."""
    points = np.empty((0, 2))
    sizes = np.empty(0)
    rows = []
    for places, scale in zip(ground, scales, strict=True):
        row = np.full(len(places), -1, dtype=np.int64)
        if len(points):
            distance, nearest = cKDTree(points).query(places)
            fits = (distance < 0.05) & (np.abs(np.log(scale / sizes[nearest])) < 0.3)
            # One keypoint of a view per point: the closest.
            order = np.flatnonzero(fits)[np.argsort(distance[fits])]
            _, first = np.unique(nearest[order], return_index=True)
            row[order[first]] = nearest[order[first]]
        new = np.flatnonzero(row < 0)
        row[new] = len(points) + np.arange(len(new))
        points = np.concatenate([points, places[new]])
        sizes = np.concatenate([sizes, scale[new]])
        rows.append(row)
    return points, rows
