"""What photo and scan look like to the dense search: pinhole views, pictures of a scan, oriented gradients.

The channels are the Fourier series, without its constant term, of what CFOG keeps of gradients (Ye, Bruzzone,
Shan, Bovolo, Zhu, "Fast and robust matching for multimodal remote sensing image registration", IEEE TGRS
2019). Why: docs/measurements/registration.md, "Intensity-only scans".
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud

FloatImage = NDArray[np.float32]

_PRESMOOTHING_PX = 1.0  # sigma before the gradient. Laser intensity has speckle of one pixel.
_POOLING_PX = 1.2  # sigma of pooling after it: the play that small misalignments of neighbouring edges have
# Share of the median strength that is added when pixels are normalised, so that noise of empty ground does
# not count as much as a kerb. From 0.3 to 3 it makes little difference.
_SOFTENING = 1.0
# Multiples of the angle, even ones, for these do not tell dark-to-bright from bright-to-dark.
_HARMONICS = (2, 4)


def oriented_gradients(image: NDArray[np.generic], valid: NDArray[np.bool_] | None) -> FloatImage:
    """Channels (2 * harmonics, h, w) float32 of a grey picture (h, w).

    Each harmonic's pair has a length below 1, which says how strong the edge is for this picture and how
    much its surroundings agree on the direction.

    Args:
        image: (h, w), any numeric dtype, any scale.
        valid: (h, w) bool or None; gradients across the border of what is valid are no edges of the world and
            are zero in all channels.
    """
    smooth = _smooth_inside(np.ascontiguousarray(image, dtype=np.float32), valid, _PRESMOOTHING_PX)
    dx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    strength, angle = cv2.cartToPolar(dx, dy)
    if valid is not None:
        strength[~inner_part(valid, int(np.ceil(2.0 * _PRESMOOTHING_PX)))] = 0.0
    pooled = np.asarray(cv2.GaussianBlur(strength, (0, 0), _POOLING_PX))
    typical = float(np.median(pooled[pooled > 0])) if (pooled > 0).any() else 1.0
    weight = 1.0 / (pooled + _SOFTENING * typical + 1e-9)
    channels = [
        cv2.GaussianBlur(strength * wave(order * angle), (0, 0), _POOLING_PX) * weight
        for order in _HARMONICS
        for wave in (np.cos, np.sin)
    ]
    return np.asarray(channels, dtype=np.float32)


def inner_part(valid: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """What is valid and at least `margin_px` away from what is not and from the picture's border."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded > 0)


def _smooth_inside(image: FloatImage, valid: NDArray[np.bool_] | None, sigma_px: float) -> FloatImage:
    """Gaussian smoothing whose weights are those of valid pixels only."""
    if valid is None or bool(valid.all()):
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.float32)
    weight = valid.astype(np.float32)
    total = cv2.GaussianBlur(weight, (0, 0), sigma_px)
    blurred = cv2.GaussianBlur(image * weight, (0, 0), sigma_px)
    return np.asarray(blurred / np.maximum(total, 1e-6), dtype=np.float32)


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
    focal_px = camera.focal_px * width / camera.width
    view_camera = Camera.from_focal(width, height, focal_px, model="SIMPLE_PINHOLE")
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = view_camera.unproject(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels = camera.project(np.column_stack([rays, np.ones(len(rays))])).reshape(height, width, 2)
    pixels = pixels * (width / camera.width, height / camera.height) - 0.5  # OpenCV's half pixel
    pixels = np.where(np.isfinite(pixels), pixels, -1e4).astype(np.float32)
    x, y = pixels[..., 0], pixels[..., 1]
    image = cv2.remap(small, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    valid = ((pixels > -0.6) & (pixels < (width - 0.4, height - 0.4))).all(axis=-1)
    return PinholeView(image=np.asarray(image), valid=np.asarray(valid), camera=view_camera)


_CELL_M = 2.0  # holds several points of any airborne scan, and is small beside gaps between flight lines


def plan_spacing_m(cloud: PointCloud) -> float:
    """Mean distance between neighbouring points seen from above, metres: the root of area over count."""
    low = cloud.xyz[:, :2].min(axis=0)
    cells = np.floor((cloud.xyz[:, :2] - low) / _CELL_M).astype(np.int64)
    across = int(cells[:, 1].max()) + 1
    occupied = len(np.unique(cells[:, 0] * across + cells[:, 1]))
    return float(np.sqrt(occupied * _CELL_M**2 / len(cloud)))


def viewing_distance_m(cloud: PointCloud, cam_from_local: Rigid3) -> float:
    """Median distance along the optical axis to points of the scan in front of the camera, metres."""
    sample = cloud.xyz[:: max(1, len(cloud) // 2000)]
    depth = cam_from_local.act(sample)[:, 2]
    return float(np.median(depth[depth > 1.0])) if (depth > 1.0).any() else 100.0


def finest_side_px(
    camera: Camera, cam_from_local: Rigid3, cloud: PointCloud, pixel_per_spacing: float
) -> int:
    """Longer side of the largest picture whose pixels are at least that share of the scan's point spacing.

    At least 64, at most the photo's own.
    """
    longer = max(camera.width, camera.height)
    seen_m = longer / camera.focal_px * viewing_distance_m(cloud, cam_from_local)
    return int(np.clip(seen_m / (pixel_per_spacing * plan_spacing_m(cloud)), min(64, longer), longer))
