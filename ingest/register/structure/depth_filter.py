"""Which depths of a rendered scan can be trusted, and the surface patch behind a pixel.

Structure-projection paper, 3.1: "not all depth values are valid".
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering

# Far plane; nothing beyond it is believed. An airborne scan's own accuracy, seen at a shallow angle from
# further away, is a matter of metres along the ray.
_MAX_DEPTH_M = 1000.0
# Largest change of depth within the window, relative to the depth, over what a tilted plane explains: 1.5 %
# is 0.6 m at 40 m, above the roughness of grass and kerbs and below an eave.
_MAX_STEP_REL = 0.015
# Largest angle between ray and normal; at 75 degrees a pixel across the ray is four along the surface.
_MAX_GRAZING_DEG = 75.0
# Samples along each side (odd) of the window around a pixel. They are half a spacing of the scan's points
# apart, so that the window sees the same number of points whether the scan is denser than the picture or far
# sparser.
_WINDOW = 7
_MIN_WINDOW_POINTS = 5  # different scan points in the window; three make any plane fit
# Samples of the window that show a scan point near the pixel's own depth, relative to the share of such
# pixels in the whole picture (a scattered scan leaves gaps between splats everywhere); a window over a hole
# has fewer.
_MIN_WINDOW_SHARE = 0.6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceHits:
    """Where rays meet the scan.

    Attributes:
        rows: (n,) of the rays, ascending; others meet nothing that can be trusted.
        points: (n, 3) local frame of the cloud, metres.
        normals: (n, 3) unit, towards the camera.
        sigma_ray_m: (n,) standard deviation along the ray from the surface's roughness in the window.
        depths: (n,) along the optical axis, metres.
    """

    rows: NDArray[np.intp]
    points: FloatArray
    normals: FloatArray
    sigma_ray_m: FloatArray
    depths: FloatArray


def _reliable_at(
    rendering: Rendering, row: NDArray[np.int64], column: NDArray[np.int64], stride: int
) -> NDArray[np.bool_]:
    """Whether the depths of pixels are neither across a silhouette nor beyond the far plane.

    The step across a silhouette is told from a slope by inverse depth, which is affine over the image of a
    plane: its second differences vanish there and stand out at a discontinuity.
    """
    height, width = rendering.depth.shape
    reach = (_WINDOW // 2 + 1) * stride

    def nearness(r: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.float32]:
        # Beyond a border the picture is mirrored about its last pixel.
        r, c = height - 1 - np.abs(height - 1 - np.abs(r)), width - 1 - np.abs(width - 1 - np.abs(c))
        depth = rendering.depth[r, c]
        seen = depth <= _MAX_DEPTH_M  # not where it is NaN
        return np.where(seen, 1.0 / np.where(seen, depth, 1.0), 0.0).astype(np.float32)

    own = nearness(row, column)
    down = np.abs(0.5 * (nearness(row - reach, column) + nearness(row + reach, column)) - own)
    across = np.abs(0.5 * (nearness(row, column - reach) + nearness(row, column + reach)) - own)
    return np.asarray((own > 0.0) & (np.maximum(down, across) <= _MAX_STEP_REL * own))


def sample_stride(rendering: Rendering) -> int:
    """Pixels that are half the distance of neighbouring scan points in the rendering, at least 1."""
    index = rendering.index
    shown = np.zeros(int(index.max(initial=-1)) + 2, dtype=bool)
    shown[index] = True  # -1 is the last
    points = int(np.count_nonzero(shown[:-1]))
    pixels = np.count_nonzero(rendering.valid)
    return max(1, round(0.5 * (pixels / points) ** 0.5)) if points else 1


def surface_at(rendering: Rendering, cloud: PointCloud, pixels: FloatArray) -> SurfaceHits:
    """The points where the rays of pixels (n, 2) of the rendering meet planes through the scan's points.

    The plane is that of the scan points that the window around the pixel shows, so that the hit lies on the
    surface and not at the depth of the nearest splat's centre.
    """
    height, width = rendering.depth.shape
    column, row = np.floor(pixels).astype(np.int64).T
    stride = sample_stride(rendering)
    reach = _WINDOW // 2 * stride
    inside = (column >= reach) & (row >= reach) & (column < width - reach) & (row < height - reach)
    rows = np.flatnonzero(inside)
    rows = rows[_reliable_at(rendering, row[rows], column[rows], stride)]
    offset = np.arange(-reach, reach + 1, stride)
    down, across = np.meshgrid(offset, offset, indexing="ij")
    window = (row[rows, None] + down.ravel(), column[rows, None] + across.ravel())
    index, depth = rendering.index[window], rendering.depth[window]
    centre = rendering.depth[row[rows], column[rows]]
    near = (index >= 0) & (np.abs(depth / centre[:, None] - 1.0) <= 4 * _MAX_STEP_REL)
    ordered = np.sort(np.where(near, index, -1), axis=1)
    ordered[:, 1:][ordered[:, 1:] == ordered[:, :-1]] = -1  # each scan point once
    points = (ordered >= 0).sum(axis=1)
    shown = np.count_nonzero(rendering.index >= 0) / max(int(np.count_nonzero(rendering.valid)), 1)
    enough = (points >= _MIN_WINDOW_POINTS) & (near.mean(axis=1) >= _MIN_WINDOW_SHARE * shown)
    rows, ordered = rows[enough], np.sort(ordered[enough], axis=1)
    return _intersect(rendering, cloud, pixels, rows, ordered[:, -int(points.max(initial=0)) :])


def _intersect(
    rendering: Rendering,
    cloud: PointCloud,
    pixels: FloatArray,
    rows: NDArray[np.intp],
    index: NDArray[np.int32],
) -> SurfaceHits:
    """Planes through the scan points of each row of `index` (-1: none), met by the rays of `pixels[rows]`."""
    pose = rendering.cam_from_local
    mean, count, values, vectors = _principal_axes(cloud, index)
    normal = vectors[:, :, 0]
    rays_cam = np.column_stack([rendering.camera.unproject(pixels[rows]), np.ones(len(rows))])
    rays = rays_cam @ pose.rotation
    facing = np.einsum("ij,ij->i", normal, rays)
    depth = np.einsum("ij,ij->i", normal, mean - pose.center) / np.where(facing == 0, np.nan, facing)
    length = np.linalg.norm(rays, axis=1)
    cosine = np.abs(facing) / length
    rough = np.sqrt(np.maximum(values[:, 0], 0.0) * count / np.maximum(count - 3, 1))
    rendered = rendering.depth[tuple(np.floor(pixels[rows]).astype(np.int64).T[::-1])]
    ok = (
        np.isfinite(depth)
        & (cosine >= np.cos(np.radians(_MAX_GRAZING_DEG)))
        & (np.abs(depth / rendered - 1.0) <= 2 * _MAX_STEP_REL)
        # A line of points (one scan line in the window) makes no plane.
        & (values[:, 1] > 0.01 * values[:, 2])
    )
    return SurfaceHits(
        rows=rows[ok],
        points=pose.center + depth[ok, None] * rays[ok],
        normals=-normal[ok] * np.sign(facing[ok])[:, None],
        sigma_ray_m=rough[ok] / cosine[ok],
        depths=depth[ok],
    )


def _principal_axes(
    cloud: PointCloud, index: NDArray[np.int32]
) -> tuple[FloatArray, NDArray[np.int64], FloatArray, FloatArray]:
    """Mean (n, 3), number (n,), variances (n, 3) and axes (n, 3, 3) of each row's points; -1 is none."""
    weight = index >= 0
    count = weight.sum(axis=1)
    points = cloud.xyz[index].astype(np.float64)
    mean = (weight[:, None, :] @ points)[:, 0] / count[:, None]
    points -= mean[:, None]
    points *= weight[:, :, None]
    values, vectors = np.linalg.eigh(np.swapaxes(points, 1, 2) @ points / count[:, None, None])
    return mean, count, values, vectors
