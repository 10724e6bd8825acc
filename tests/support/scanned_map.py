"""A map of rolling ground with exact truth, and a scan of the same ground: no photos, no reconstruction.

The map is built at the truth and then moved by a known similarity, as a poor placement would, so that the
move that puts it back is known exactly.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.move import move_map
from featuredb.render.cloud import CloudNodes, PointCloud
from ingest.register.block import block_of_map, map_of_block
from ingest.register.frame_registration import FrameRegistration
from ingest.register.structure.projection import StructurePlacement

EPSG = 32632
FRAME = LocalFrame(latitude_deg=48.1, longitude_deg=11.5, height_m=520.0)
CAMERA = Camera(model="RADIAL", width=1200, height=900, params=(1000.0, 600.0, 450.0, 0.02, -0.01))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannedMap:
    """What a test needs.

    Attributes:
        feature_map: at its poor place. cloud: the scan, in FRAME.
        true_points: (n, 3) of the map, in FRAME. true_poses: cam_from_local by image.
        back: similarity that moves the map from where it is to where it belongs.
    """

    feature_map: FeatureMap
    cloud: PointCloud
    true_points: FloatArray
    true_poses: tuple[Rigid3, ...]
    back: Sim3

    def registered(
        self,
        image: int,
        *,
        error: FloatArray | None = None,
        sigma_deg: float = 0.02,
        sigma_m: float = 0.02,
        correspondences: int = 0,
        lens: Camera = CAMERA,
        seed: int = 0,
    ) -> FrameRegistration:
        """The frame at its true pose, perturbed on the left by `error` (6,)."""
        pose = self.true_poses[image]
        rng = np.random.default_rng(seed)
        points = ground_points(rng, 4 * correspondences + 1)
        pixels = CAMERA.project(pose.act(points))
        inside = (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
        points, pixels = points[inside][:correspondences], pixels[inside][:correspondences]
        covariance = np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)
        return FrameRegistration(
            cam_from_local=pose if error is None else Rigid3.exp(error) @ pose,
            covariance=covariance,
            reason=None,
            message="",
            source="rgb",
            camera=lens,
            points_local=points,
            pixels=pixels + rng.normal(0, 0.5, pixels.shape),
        )


def height(x: FloatArray, y: FloatArray) -> FloatArray:
    """Rolling ground, metres; slopes up to some 30 degrees."""
    return np.asarray(3.0 * np.sin(x / 9.0) * np.cos(y / 11.0) + 0.05 * x)


def ground_points(rng: np.random.Generator, count: int, half_m: float = 45.0) -> FloatArray:
    """(count, 3) on the ground."""
    x, y = rng.uniform(-half_m, half_m, (2, count))
    return np.column_stack([x, y, height(x, y)])


def scan(rng: np.random.Generator, count: int = 40_000, noise_m: float = 0.01) -> PointCloud:
    """A scan of the ground, about four points a square metre per 30,000."""
    xyz = ground_points(rng, count, 55.0)
    xyz[:, 2] += rng.normal(0, noise_m, count)
    return plain_cloud(xyz)


def plain_cloud(xyz: FloatArray) -> PointCloud:
    """A cloud in FRAME that has one node only."""
    points = np.ascontiguousarray(xyz, dtype=np.float32)
    spacing = np.sqrt(np.prod(np.ptp(points[:, :2], axis=0)) / len(points))
    return PointCloud(
        frame=FRAME,
        height_datum="ellipsoidal",
        xyz=points,
        rgb=None,
        intensity=None,
        classification=np.ones(len(points), np.uint8),
        nodes=CloudNodes(
            start=np.array([0]),
            count=np.array([len(points)]),
            level=np.array([0], np.int16),
            spacing_m=np.array([spacing], np.float32),
            box_min=points.min(axis=0)[None],
            box_max=points.max(axis=0)[None],
        ),
    )


def scanned_map(
    *, seed: int = 0, points: int = 900, pixel_noise: float = 0.3, placed_by: Sim3 | None = None
) -> ScannedMap:
    """Nine nadir images over the ground, its points at the truth; then the whole moved by `placed_by`."""
    rng = np.random.default_rng(seed)
    true = ground_points(rng, points, 40.0)
    poses = tuple(
        _nadir(east, north, 42.0 + rng.uniform(-3, 3), rng) for east in (-22, 0, 22) for north in (-18, 0, 18)
    )
    point_of, image_of, xy = _observe(true, poses)
    xy = xy + rng.normal(0, pixel_noise, xy.shape)
    off = placed_by or Sim3.exp([0.01, 0.01, -0.008, 0.02, 1.5, -2.0, -9.0])
    placement = Placement(
        method="gps",
        local_from_sfm=off,
        covariance=np.diag([1e-5] + [1e-4] * 3 + [4.0] * 3),
        residual_rms_m=0.5,
    )
    at_truth = FeatureMap(
        map_id="scanned",
        name="scanned",
        epsg=EPSG,
        height_datum="unknown",
        frame=FRAME,
        cameras=(CAMERA,),
        images=tuple(
            MapImage(image_id=k, name=f"{k}.jpg", sha256=f"{k:064d}", camera_id=0, cam_from_local=pose)
            for k, pose in enumerate(poses)
        ),
        points=MapPoints(
            utm=FRAME.utm_from_enu(true, EPSG),
            rgb=np.zeros((points, 3), np.uint8),
            track_length=np.bincount(point_of, minlength=points).astype(np.int32),
            error_px=np.zeros(points, np.float32),
            covariance=np.zeros((points, 6), np.float32),
        ),
        observations=_observations(point_of, image_of, xy),
        placement=placement,
        extractor_fingerprint="none",
    )
    moved = map_of_block(at_truth, block_of_map(at_truth).moved(off), FRAME, placement, "unknown")
    return ScannedMap(
        feature_map=moved,
        cloud=scan(rng),
        true_points=true,
        true_poses=poses,
        back=off.inverse(),
    )


def _nadir(east: float, north: float, up: float, rng: np.random.Generator) -> Rigid3:
    """A camera that looks down, tilted by a few degrees, heading anywhere."""
    a = rng.uniform(0, 2 * np.pi)
    down = np.array([[np.cos(a), np.sin(a), 0.0], [np.sin(a), -np.cos(a), 0.0], [0.0, 0.0, -1.0]])
    rotation = Rigid3.exp([*rng.normal(0, 0.05, 3), 0, 0, 0]).rotation @ down
    return Rigid3(rotation=rotation, translation=-rotation @ np.array([east, north, up]))


def _observe(
    points: FloatArray, poses: tuple[Rigid3, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    found: list[tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]] = []
    for k, pose in enumerate(poses):
        pixels = CAMERA.project(pose.act(points))
        inside = (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
        rows = np.flatnonzero(inside)
        found.append((rows, np.full(len(rows), k), pixels[rows]))
    point_of, image_of, xy = (np.concatenate([f[i] for f in found]) for i in range(3))
    often = np.bincount(point_of, minlength=len(points))[point_of] >= 2
    return point_of[often], image_of[often], xy[often]


def _observations(
    point_of: NDArray[np.int64], image_of: NDArray[np.int64], xy: FloatArray
) -> MapObservations:
    m = len(point_of)
    return MapObservations(
        point_index=point_of,
        image_id=image_of.astype(np.int32),
        xy=xy.astype(np.float32),
        scale=np.ones(m, np.float32),
        angle=np.zeros(m, np.float32),
        has_descriptor=np.zeros(m, dtype=bool),
        descriptors=np.zeros((m, 128), np.uint8),
    )


def placed_by_similarity(
    feature_map: FeatureMap, structure: StructurePlacement, cloud: PointCloud
) -> FeatureMap:
    """The map where an accepted structure projection alone puts it."""
    assert structure.new_from_old is not None
    assert structure.covariance is not None
    map_from_cloud = Sim3.from_rigid3(feature_map.frame.enu_from(cloud.frame))
    return move_map(
        feature_map,
        map_from_cloud @ structure.new_from_old @ map_from_cloud.inverse(),
        covariance=map_from_cloud.carried(structure.covariance),
    )
