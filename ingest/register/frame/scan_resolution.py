"""How finely a picture may resolve a scan before it shows single points instead of a surface."""

import numpy as np

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud

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
