"""What the renderer gives back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendering:
    """A point cloud seen by a camera; pixel (row, column) has its centre at (column + 0.5, row + 0.5).

    Attributes:
        camera: whose width and height the images have, distortion included.
        cam_from_local: the pose in the frame of the cloud.
        depth: (h, w) float32, metres along the optical axis; NaN where nothing is seen.
        index: (h, w) int32, row of the cloud that the pixel shows; -1 where nothing is seen, and where a
            hole was closed from its surroundings.
        rgb: (h, w, 3) uint8 or None; zero where depth is NaN.
        intensity: (h, w) uint8 or None; zero where depth is NaN.
    """

    camera: Camera
    cam_from_local: Rigid3
    depth: NDArray[np.float32]
    index: NDArray[np.int32]
    rgb: NDArray[np.uint8] | None
    intensity: NDArray[np.uint8] | None
    points_drawn: int

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(h, w) bool: pixels that show the scan, closed holes included."""
        return np.isfinite(self.depth)
