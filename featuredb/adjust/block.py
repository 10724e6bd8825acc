"""A photogrammetric block: cameras, poses, points and their observations as plain arrays."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Photos, points and observations in one frame, "block", of any scale and orientation.

    Attributes:
        names: of the k photos.
        cameras: intrinsics; camera_of: (k,) index into them.
        cam_from_block: k poses.
        xyz: (n, 3) points.
        point_of, photo_of: (m,) int64, what each observation sees, and in which photo.
        xy: (m, 2) full-size pixels.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera_of: NDArray[np.int64]
    cam_from_block: tuple[Rigid3, ...]
    xyz: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    xy: FloatArray

    def camera(self, photo: int) -> Camera:
        """Intrinsics of a photo."""
        return self.cameras[int(self.camera_of[photo])]

    def centers(self) -> FloatArray:
        """Camera centres (k, 3)."""
        return np.array([pose.center for pose in self.cam_from_block]).reshape(-1, 3)

    def distances(self) -> FloatArray:
        """Median distance (k,) of the points that each photo sees from its camera; 1 where it sees none."""
        away = np.linalg.norm(self.xyz[self.point_of] - self.centers()[self.photo_of], axis=1)
        seen = [away[self.photo_of == k] for k in range(len(self.names))]
        return np.array([float(np.median(distances)) if len(distances) else 1.0 for distances in seen])

    def moved(self, target_from_block: Sim3) -> "Block":
        """The same block in another frame."""
        return replace(
            self,
            cam_from_block=tuple(target_from_block.act_on_pose(pose) for pose in self.cam_from_block),
            xyz=target_from_block.act(self.xyz),
        )


def whole_lens(block: Block) -> Block:
    """The block with radial cameras as the same lenses with two focal lengths and tangential terms.

    Fisheye lenses and those that have all of it stay.
    """
    return replace(block, cameras=tuple(whole_camera(camera) for camera in block.cameras))


def whole_camera(camera: Camera) -> Camera:
    """A radial lens with two focal lengths and tangential terms; others stay."""
    lens = camera.params
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        focal, (cx, cy), radial = lens[0], lens[1:3], (*lens[3:], 0.0, 0.0)[:2]
        return replace(camera, model="OPENCV", params=(focal, focal, cx, cy, *radial, 0.0, 0.0))
    if camera.model == "PINHOLE":
        return replace(camera, model="OPENCV", params=(*lens, 0.0, 0.0, 0.0, 0.0))
    return camera
