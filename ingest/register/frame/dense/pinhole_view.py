"""A photo at working size, freed of its lens's distortion, and pinhole cameras with a margin around it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PinholeView:
    """The photo resampled as a pinhole camera would have taken it.

    Attributes:
        image: (h, w) uint8.
        valid: (h, w) bool, what the photo shows.
        camera: SIMPLE_PINHOLE of the view, principal point in the middle.
    """

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    camera: Camera


def pinhole_view(photo_gray: NDArray[np.uint8], camera: Camera, longer_side_px: int) -> PinholeView:
    """The photo (h, w) uint8 without distortion, its longer side about `longer_side_px`, never enlarged."""
    scale = min(1.0, longer_side_px / max(camera.width, camera.height))
    width, height = max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
    small = np.asarray(photo_gray, dtype=np.uint8)
    if small.shape != (height, width):
        small = np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA))
    view_camera = Camera(
        model="SIMPLE_PINHOLE",
        width=width,
        height=height,
        params=(camera.focal_px * width / camera.width, width / 2.0, height / 2.0),
    )
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = view_camera.unproject(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels = camera.project(np.column_stack([rays, np.ones(len(rays))])).reshape(height, width, 2)
    pixels = pixels * (width / camera.width, height / camera.height) - 0.5  # OpenCV's half pixel
    pixels = np.where(np.isfinite(pixels), pixels, -1e4).astype(np.float32)
    image = cv2.remap(
        small, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    valid = ((pixels > -0.6) & (pixels < (width - 0.4, height - 0.4))).all(axis=-1)
    return PinholeView(image=np.asarray(image), valid=np.asarray(valid), camera=view_camera)


def with_margin(camera: Camera, margin_px: int) -> Camera:
    """The same pinhole with `margin_px` more on each side."""
    focal, cx, cy = camera.params
    return Camera(
        model="SIMPLE_PINHOLE",
        width=camera.width + 2 * margin_px,
        height=camera.height + 2 * margin_px,
        params=(focal, cx + margin_px, cy + margin_px),
    )
