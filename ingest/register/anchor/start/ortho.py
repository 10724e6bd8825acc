"""A map's photos and a scan, both drawn from straight above as one small picture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import MapImage
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import render
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.frame.views import source_image
from ingest.register.frame_registration import RenderSource

FloatImage = NDArray[np.float32]

_SIDE_CELLS = 320  # of a map's picture
_MOST_PHOTOS = 60  # evenly over the map
_PHOTO_SIDE_PX = 960
_GROUND_CELLS, _SPARSE_CELLS = 3.0, 25.0  # sigmas of heights between points, where they are dense and sparse
_NEAR_CELLS, _LEAST_NEAR = 8.0, 2e-3  # points a cell around what is shown
_LEAST_STEEP = 0.2  # sine of the view on what is shown: flatter ones smear it
_AWAY = 20.0  # of the camera that draws the scan, over what it shows: it leans by a fortieth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrthoPicture:
    """From straight above, rows northwards: (row + 0.5, column + 0.5) lies `cell` times that from `corner`.

    Attributes:
        gray: (h, w) float32. valid: (h, w), what is shown.
        height: (h, w) of what is shown, in the unit of `cell`.
        corner: (2,) of the first cell, x and y. cell: side of a cell.
    """

    gray: FloatImage
    valid: NDArray[np.bool_]
    height: FloatArray
    corner: FloatArray
    cell: float

    def mirrored(self) -> "OrthoPicture":
        """What is nowhere on Earth."""
        return replace(
            self,
            gray=np.ascontiguousarray(self.gray[:, ::-1]),
            valid=np.ascontiguousarray(self.valid[:, ::-1]),
            height=self.height[:, ::-1],
        )

    @property
    def middle(self) -> FloatArray:
        """(2,) of the picture."""
        return np.asarray(self.corner + 0.5 * self.cell * np.array(self.gray.shape[::-1]))


def picture_of_map(
    xyz: FloatArray, images: Sequence[MapImage], cameras: Sequence[Camera], read_gray: PhotoReader
) -> OrthoPicture | None:
    """The photos laid over the ground of a map, each cell by the photo that looks at it most steeply.

    None where no photo that can be read shows it.

    Args:
        xyz: (n, 3) points in a frame whose z is up; poses of the images are in it, too.
        read_gray: grey pixels (h, w) of an image; those that cannot be read are left out.
    """
    if not len(xyz) or not images:
        return None
    low, high = np.percentile(xyz[:, :2], (2, 98), axis=0)
    cell = float((high - low).max()) / _SIDE_CELLS
    if cell <= 0.0:
        return None
    size = np.ceil((high - low) / cell).astype(np.int64) + 1
    height, near = _ground(xyz, low, cell, size)
    across, up = (low[k] + (np.arange(size[k]) + 0.5) * cell for k in (0, 1))
    cells = np.stack([*np.meshgrid(across, up), height], axis=-1)
    gray, steepest = np.zeros(near.shape, np.float32), np.full(near.shape, _LEAST_STEEP)
    for image in images[:: -(-len(images) // _MOST_PHOTOS)]:
        try:
            photo = read_gray(image)
        except ImageError:
            continue
        steep, shown = _seen(cells, image.cam_from_local, cameras[image.camera_id], photo)
        better = steep > steepest
        gray[better], steepest[better] = shown[better], steep[better]
    valid = near & (steepest > _LEAST_STEEP)
    return OrthoPicture(gray=gray, valid=valid, height=height, corner=low, cell=cell) if valid.any() else None


def _ground(
    xyz: FloatArray, low: FloatArray, cell: float, size: NDArray[np.int64]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Heights (h, w) between the points, and where points are near."""
    at = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
    inside = ((at >= 0) & (at < size)).all(axis=1)
    heights = np.clip(xyz[:, 2], *np.percentile(xyz[:, 2], (2, 98)))
    count, total = (np.zeros((size[1], size[0]), np.float32) for _ in range(2))
    rows = (at[inside, 1], at[inside, 0])
    np.add.at(count, rows, 1.0)
    np.add.at(total, rows, heights[inside])
    ground = np.full(count.shape, float(np.median(heights)))
    for sigma in (_SPARSE_CELLS, _GROUND_CELLS):
        weight, summed = (cv2.GaussianBlur(of, (0, 0), sigma) for of in (count, total))
        ground = np.where(weight > 1e-3 / sigma, summed / np.maximum(weight, 1e-9), ground)
    return ground, np.asarray(cv2.GaussianBlur(count, (0, 0), _NEAR_CELLS) > _LEAST_NEAR)


def _seen(
    cells: FloatArray, pose: Rigid3, camera: Camera, photo: NDArray[np.uint8]
) -> tuple[FloatArray, FloatImage]:
    """Sine of a photo's view on cells (h, w, 3), zero where it does not show them, and what it shows."""
    scale = min(1.0, _PHOTO_SIDE_PX / max(photo.shape))
    small = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    size = np.array(small.shape[::-1])
    local = pose.act(cells.reshape(-1, 3))
    pixels = camera.project(local) * (size / (camera.width, camera.height)) - 0.5  # OpenCV's half pixel
    with np.errstate(invalid="ignore"):
        inside = (local[:, 2] > 0) & ((pixels > 0) & (pixels < size - 1)).all(axis=1)
    way = pose.center - cells.reshape(-1, 3)
    steep = np.where(inside, way[:, 2] / np.linalg.norm(way, axis=1), 0.0).reshape(cells.shape[:2])
    mapped = np.where(inside[:, None], pixels, 0.0).astype(np.float32).reshape(*cells.shape[:2], 2)
    shown = cv2.remap(small, mapped[..., 0], mapped[..., 1], cv2.INTER_LINEAR)
    return steep, np.asarray(shown, dtype=np.float32)


def picture_of_scan(
    cloud: PointCloud, source: RenderSource, cell_m: float, box: tuple[FloatArray, FloatArray] | None = None
) -> OrthoPicture:
    """The scan by one of its properties, all of it or between the least and the largest x and y of a box."""
    if box is None:
        plan = cloud.xyz[:, :2]
        box = np.asarray(plan.min(axis=0), np.float64), np.asarray(plan.max(axis=0), np.float64)
    low, high = box
    width, height = (int(n) for n in np.ceil((high - low) / cell_m) + 1)
    away_px = _AWAY * max(width, height)
    camera = Camera.from_focal(width, height, away_px, model="SIMPLE_PINHOLE")
    level = float(np.median(cloud.xyz[:, 2]))
    center = np.array([*(low + 0.5 * cell_m * np.array([width, height])), level + away_px * cell_m])
    view = render(cloud, camera, Rigid3.from_center(np.diag([1.0, -1.0, -1.0]), center))
    return OrthoPicture(
        gray=np.ascontiguousarray(source_image(view, source)[::-1], dtype=np.float32),
        valid=view.valid[::-1],
        height=center[2] - view.depth[::-1].astype(np.float64),
        corner=low,
        cell=cell_m,
    )
