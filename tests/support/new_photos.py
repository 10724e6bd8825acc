"""New photos of a made-up scene, with features and a reconstruction in a frame and scale of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import GeoPrior
from ingest.colmap.bridge import Model, TwoView, verify_pair
from ingest.growth.values import GrowthPhotos
from ingest.map_builder import MapIdentity
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures
from ingest.sfm.pairs import Pair
from tests.support.scenes import CAMERA, pixels_inside, query_features

FINGERPRINT = ExtractorOptions().fingerprint
SFM_FROM_LOCAL = Sim3(
    scale=0.13, rotation=so3_exp(np.array([0.4, -1.1, 2.0])), translation=np.array([3.0, -7.0, 1.5])
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NewPhotos:
    """Photos with truth.

    Attributes:
        poses: true cam_from_local. model: what structure from motion makes of them; rows are the photos'.
        world_of: for each photo the world point (row) of each of its features.
    """

    photos: list[Photo]
    features: list[PhotoFeatures]
    poses: list[Rigid3]
    model: Model
    world_of: list[NDArray[np.int64]]

    @property
    def given(self) -> GrowthPhotos:
        """As growth takes them."""
        return GrowthPhotos(photos=self.photos, features_of=self.features_of, geometry_of=self.geometry_of)

    def features_of(self, row: int) -> PhotoFeatures:
        return self.features[row]

    def geometry_of(self, pair: Pair) -> TwoView:
        """The verified geometry of what two photos see in common."""
        (i, j), (a, b) = pair, (self.features[row].features for row in pair)
        _, in_a, in_b = np.intersect1d(self.world_of[i], self.world_of[j], return_indices=True)
        matches, known = np.stack([in_a, in_b], axis=1).astype(np.uint32), self.model.cameras[0]
        return verify_pair(known, a.xy, known, b.xy, matches, focal_known=True, max_error_px=4.0, seed=0)

    def keypoints(self) -> dict[int, FloatArray]:
        return {r: f.features.xy.astype(np.float64) for r, f in enumerate(self.features)}


def take_photos(
    rng: np.random.Generator,
    points: FloatArray,
    descriptors: NDArray[np.uint8],
    poses: Sequence[Rigid3],
    *,
    camera: Camera = CAMERA,
    sfm_from_local: Sim3 = SFM_FROM_LOCAL,
    noise_px: float = 0.5,
    point_noise_m: float = 0.02,
    pose_noise_m: float = 0.01,
    camera_key: str = "scene|camera",
    gps: Sequence[GeoPrior | None] | None = None,
) -> NewPhotos:
    """Photos of world points (n, 3) in the local frame, and a model of them with independent noise."""
    photos, features, world_of = [], [], []
    point_of, photo_of, keypoint_of = [], [], []
    for k, pose in enumerate(poses):
        pixels, inside = pixels_inside(camera, pose, points)
        rows = np.flatnonzero(inside)
        xy = pixels[rows] + rng.normal(0, noise_px, (len(rows), 2))
        made = query_features(rng, xy, descriptors[rows], camera=camera, fingerprint=FINGERPRINT)
        features.append(PhotoFeatures(features=made, rgb=np.full((len(rows), 3), 90, np.uint8)))
        name = f"new-{k}.jpg"
        photos.append(
            Photo(
                name=name,
                path=Path(name),
                sha256=f"{k + 5000:064x}",
                width=camera.width,
                height=camera.height,
                camera_key=camera_key,
                gps=None if gps is None else gps[k],
            )
        )
        world_of.append(rows)
        point_of.append(rows)
        photo_of.append(np.full(len(rows), k))
        keypoint_of.append(np.arange(len(rows)))
    joined = np.concatenate(point_of)
    seen = np.bincount(joined, minlength=len(points)) >= 2
    keep = seen[joined]
    noisy_points = points + rng.normal(0, point_noise_m, points.shape)
    order = np.lexsort((np.concatenate(photo_of)[keep], joined[keep]))
    model = Model(
        cameras=(camera,),
        rows=np.arange(len(poses)),
        camera_of=np.zeros(len(poses), dtype=np.int64),
        cam_from_sfm=tuple(
            sfm_from_local.act_on_pose(moved(p, rng.normal(0, pose_noise_m, 3))) for p in poses
        ),
        xyz=sfm_from_local.act(noisy_points[seen]),
        point_of=(np.cumsum(seen) - 1)[joined[keep]][order].astype(np.int64),
        photo_of=np.concatenate(photo_of)[keep][order].astype(np.int64),
        keypoint_of=np.concatenate(keypoint_of)[keep][order].astype(np.int64),
    )
    return NewPhotos(photos=photos, features=features, poses=list(poses), model=model, world_of=world_of)


def moved(pose: Rigid3, offset: FloatArray) -> Rigid3:
    """The camera with its centre displaced."""
    return Rigid3(rotation=pose.rotation, translation=pose.translation - pose.rotation @ offset)


def identity(name: str = "grown") -> MapIdentity:
    return MapIdentity(map_id=name, name=name, source="test", licence="", provenance={})
