"""Pictures of a scan: which is compared with the photo, and how finely, before single points show."""

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.rendering import Rendering
from featuredb.render.shading import shaded_relief
from ingest.register.frame.dense.oriented_gradients import FloatImage
from ingest.register.frame_registration import RenderSource

_CELL_M = 2.0  # holds several points of any airborne scan, and is small beside gaps between flight lines
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def source_picture(rendering: Rendering, source: RenderSource) -> FloatImage:
    """The grey picture (h, w) float32, 0..255, of a rendering.

    Raises:
        InvalidValueError: the scan has no such values.
    """
    if source == "rgb" and rendering.rgb is not None:
        return np.asarray(rendering.rgb.astype(np.float32) @ _LUMA, dtype=np.float32)
    if source == "intensity" and rendering.intensity is not None:
        return rendering.intensity.astype(np.float32)
    if source == "shaded":
        return shaded_relief(rendering).astype(np.float32)
    raise InvalidValueError(
        f"source_picture: expected a source that the scan has, found {source!r}; see available_sources()"
    )


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
