"""Small feature maps with exact geometry and made-up descriptors: a ring of cameras around random points."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import rootsift_8bit
from featuredb.features.features import Features
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import build_area
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from reloc.localise.candidates import IndexedArea, indexed_together

EPSG = 32632
EASTING, NORTHING, HEIGHT = 456_800.0, 5_429_300.0, 120.0
CAMERA = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(900.0, 500.0, 400.0, 0.01))
FINGERPRINT = "scene-test"


def looking_at(center: FloatArray, target: FloatArray) -> Rigid3:
    """cam_from_local of an upright camera at `center` whose axis meets `target`; not straight down."""
    axis = (target - center) / np.linalg.norm(target - center)
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(axis, right), axis])
    return Rigid3(rotation=rotation, translation=-rotation @ center)


def ring(count: int, radius_m: float = 45.0, height_m: float = 35.0) -> list[Rigid3]:
    """Cameras on a circle that look at its middle."""
    turn = np.arange(count) * (2 * np.pi / count)
    centers = np.column_stack([radius_m * np.cos(turn), radius_m * np.sin(turn), np.full(count, height_m)])
    return [looking_at(center, np.array([0.0, 0.0, 3.0])) for center in centers]


def box_points(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (count, 3) in a box of 50 x 50 x 12 m."""
    points: FloatArray = rng.uniform([-25, -25, 0], [25, 25, 12], (count, 3))
    return points


def random_descriptors(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    """RootSIFT-like (count, 128) uint8; two of them are some 350 to 450 apart."""
    return rootsift_8bit(rng.gamma(0.4, size=(count, 128)).astype(np.float32))


def noisy(
    rng: np.random.Generator, descriptors: NDArray[np.uint8], deviation: float = 5.0
) -> NDArray[np.uint8]:
    """The descriptors as another photo shows them."""
    return np.clip(descriptors + rng.normal(0, deviation, descriptors.shape), 0, 255).astype(np.uint8)


def pixels_inside(camera: Camera, cam_from_local: Rigid3, points: FloatArray) -> tuple[FloatArray, NDArray]:
    """Projections (n, 2) and which of them lie in the image (n,)."""
    pixels = camera.project(cam_from_local.act(points))
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return pixels, inside


def scene_map(
    *,
    points: FloatArray,
    descriptors: NDArray[np.uint8],
    poses: Sequence[Rigid3],
    map_id: str = "scene",
    east_m: float = 0.0,
    epsg: int = EPSG,
    frame: LocalFrame | None = None,
    camera_keys: tuple[str, ...] = (),
    point_covariance: tuple[float, ...] = (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4),
    placement_covariance: FloatArray | None = None,
    fingerprint: str = FINGERPRINT,
    seed: int = 0,
) -> FeatureMap:
    """Every camera sees what projects into it; points (n, 3) and poses in the map's local frame."""
    rng = np.random.default_rng(seed)
    frame = frame or LocalFrame.from_utm(EASTING + east_m, NORTHING, HEIGHT, EPSG)
    point_index, image_id, xy = [], [], []
    for i, pose in enumerate(poses):
        pixels, inside = pixels_inside(CAMERA, pose, points)
        rows = np.flatnonzero(inside)
        point_index.append(rows)
        image_id.append(np.full(len(rows), i))
        xy.append(pixels[rows])
    index = np.concatenate(point_index)
    return FeatureMap(
        map_id=map_id,
        name=map_id,
        epsg=epsg,
        height_datum="ellipsoidal",
        frame=frame,
        cameras=(CAMERA,),
        camera_keys=camera_keys,
        images=tuple(
            MapImage(image_id=i, name=f"{i}.jpg", sha256=f"{i:064x}", camera_id=0, cam_from_local=pose)
            for i, pose in enumerate(poses)
        ),
        points=MapPoints(
            utm=frame.utm_from_enu(points, epsg),
            rgb=np.zeros((len(points), 3), np.uint8),
            track_length=np.bincount(index, minlength=len(points)).astype(np.int32),
            error_px=np.full(len(points), 0.5, np.float32),
            covariance=np.tile(np.asarray(point_covariance, np.float32), (len(points), 1)),
        ),
        observations=MapObservations(
            point_index=index,
            image_id=np.concatenate(image_id).astype(np.int32),
            xy=np.concatenate(xy).astype(np.float32),
            scale=np.full(len(index), 5.0, np.float32),
            angle=np.zeros(len(index), np.float32),
            has_descriptor=np.ones(len(index), np.bool_),
            descriptors=noisy(rng, descriptors[index]),
        ),
        placement=Placement(
            method="gps",
            local_from_sfm=Sim3.identity(),
            covariance=np.eye(7) * 1e-8 if placement_covariance is None else placement_covariance,
            residual_rms_m=0.1,
        ),
        extractor_fingerprint=fingerprint,
    )


def indexed(*maps: FeatureMap) -> IndexedArea:
    """The maps as one indexed area."""
    area = build_area(maps)
    return indexed_together([area])[0]


def query_features(
    rng: np.random.Generator,
    xy: FloatArray,
    descriptors: NDArray[np.uint8],
    *,
    camera: Camera = CAMERA,
    fingerprint: str = FINGERPRINT,
) -> Features:
    """Features of a made-up photo, strongest first as given."""
    count = len(xy)
    return Features(
        xy=xy.astype(np.float32),
        scale=np.full(count, 5.0, np.float32),
        angle=np.zeros(count, np.float32),
        response=np.linspace(1.0, 0.5, count, dtype=np.float32),
        descriptors=noisy(rng, descriptors),
        width=camera.width,
        height=camera.height,
        fingerprint=fingerprint,
    )
