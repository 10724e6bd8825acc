"""Places of a town that a picture shows, by the truth."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import render_depth
from featuredb.simworld.town.scene import Scene, texture_index


class SeenPlaces:
    """A picture whose every pixel has a true place, in the scene's local frame.

    Attributes:
        depth: (h, w) metres, infinite in the sky. still: (h, w) what shows no car.
    """

    def __init__(self, scene: Scene, camera: Camera, cam_from_local: Rigid3) -> None:
        self._camera, self._cam_from_local = camera, cam_from_local
        rendered = render_depth(scene, camera, cam_from_local)
        self.depth = rendered.depth
        cars = np.unique(scene.faces.object_id[scene.faces.texture == texture_index("car")])
        self.still = np.isfinite(self.depth) & ~np.isin(rendered.object_id, cars)

    def pixels(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Centres (count, 2) of pixels that show what stands still."""
        rows, columns = np.nonzero(self.still)
        chosen = rng.choice(len(rows), count, replace=False)
        return np.column_stack([columns[chosen], rows[chosen]]).astype(np.float64) + 0.5

    def places(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) of pixels (n, 2)."""
        depth = self.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(np.float64)
        rays = np.column_stack([self._camera.unproject(pixels), np.ones(len(pixels))])
        return self._cam_from_local.inverse().act(rays * depth[:, None])
