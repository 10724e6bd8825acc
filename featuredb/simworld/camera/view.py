"""A scene as one camera meets it: primitives in camera axes, culled, with their windows in the image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera, pixel_rays
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.town.scene import Ellipsoids, Faces

_NEAR_M = 0.1  # nothing closer is drawn; a camera never stands in a wall
_EDGE_SAMPLES = 9  # per side of a window, to follow the distortion
_PAD_PX = 4  # what the window's outline may bulge between two samples


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaceView:
    """m faces that may be seen, nearest first.

    For the ray r = (x, y, 1): 1/z = planes[i, 0] @ r, s = (planes[i, 1] @ r) * z, t = (planes[i, 2] @ r) * z.

    Attributes:
        index: (m,) rows of the Faces.
        planes: (m, 3, 3) float64.
        window: (m, 4) int, x0, y0, x1, y1 in pixels, end exclusive.
        distance: (m,) distance of the camera centre from each face's plane, metres.
        nearest: (m,) 1/z of the nearest corner, infinity where one is behind the camera.
    """

    index: NDArray[np.intp]
    planes: FloatArray
    window: NDArray[np.int64]
    distance: FloatArray
    nearest: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EllipsoidView:
    """m ellipsoids that may be seen; the ray r at depth z is w0 + z * unit_from_cam @ r for the unit sphere.

    Attributes:
        index: (m,), w0: (m, 3), unit_from_cam: (m, 3, 3), window: (m, 4), depth: (m,) of the centre.
    """

    index: NDArray[np.intp]
    w0: FloatArray
    unit_from_cam: FloatArray
    window: NDArray[np.int64]
    depth: FloatArray


def view_faces(faces: Faces, camera: Camera, cam_from_local: Rigid3) -> FaceView:
    """Cull faces that look away or lie outside the image, and set up the rest."""
    turn = cam_from_local.rotation.T
    origin = cam_from_local.act(faces.origin)
    edge_s, edge_t = faces.edge_s @ turn, faces.edge_t @ turn
    normal = np.cross(edge_s, edge_t)
    offset = np.einsum("ij,ij->i", normal, origin)
    front = np.flatnonzero(offset < -1e-9)
    origin, edge_s, edge_t, normal = origin[front], edge_s[front], edge_t[front], normal[front]
    offset, triangle = offset[front], faces.triangle[front]
    fourth = np.where(triangle[:, None], origin + edge_t, origin + edge_s + edge_t)
    corners = np.stack([origin, origin + edge_s, fourth, origin + edge_t], axis=1)
    seen, window = _windows(corners, camera)
    numerators = np.stack([normal, np.cross(edge_t, origin), np.cross(origin, edge_s)], axis=1)
    planes = numerators / offset[:, None, None]
    distance = -offset / np.linalg.norm(normal, axis=1)
    nearest = corners[..., 2].min(axis=1)
    order = seen[np.argsort(nearest[seen], kind="stable")]
    inverse = np.where(nearest > _NEAR_M, 1.0 / np.maximum(nearest, _NEAR_M), np.inf)
    return FaceView(
        index=front[order],
        planes=planes[order],
        window=window[order],
        distance=distance[order],
        nearest=inverse[order],
    )


def view_ellipsoids(ellipsoids: Ellipsoids, camera: Camera, cam_from_local: Rigid3) -> EllipsoidView:
    """Cull ellipsoids outside the image, or that hold the camera, and set up the rest."""
    unit_from_cam = cam_from_local.rotation.T[None] / ellipsoids.radii[:, :, None]
    w0 = (cam_from_local.center - ellipsoids.center) / ellipsoids.radii
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    boxes = ellipsoids.center[:, None] + signs[None] * ellipsoids.radii[:, None]
    corners = cam_from_local.act(boxes)
    seen, window = _windows(corners, camera, hull=True)
    depth = cam_from_local.act(ellipsoids.center)[:, 2]
    outside = np.linalg.norm(w0, axis=1) > 1.02
    order = seen[outside[seen]]
    order = order[np.argsort(depth[order], kind="stable")]
    return EllipsoidView(
        index=order,
        w0=w0[order],
        unit_from_cam=unit_from_cam[order],
        window=window[order],
        depth=depth[order],
    )


def _windows(
    corners: FloatArray, camera: Camera, *, hull: bool = False
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Which of n polygons (n, k, 3) in camera coordinates may be seen, and the windows (n, 4) that hold them.

    With `hull` the corners are a box's, in no order, and a box across the near plane takes the whole image.
    """
    x, y = pixel_rays(camera)
    margin = 0.02
    limits = np.array([x.min() - margin, y.min() - margin, x.max() + margin, y.max() + margin])
    z = corners[..., 2]
    ahead = (z > _NEAR_M).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = corners[..., :2] / z[..., None]
    bounds = np.concatenate([flat.min(axis=1), flat.max(axis=1)], axis=1)
    for i in np.flatnonzero(~ahead & (z > _NEAR_M).any(axis=1)):
        clipped = None if hull else _clip_near(corners[i])
        bounds[i] = limits if clipped is None else np.concatenate([clipped.min(axis=0), clipped.max(axis=0)])
    candidate = (z > _NEAR_M).any(axis=1)
    candidate &= (bounds[:, 0] < limits[2]) & (bounds[:, 2] > limits[0])
    candidate &= (bounds[:, 1] < limits[3]) & (bounds[:, 3] > limits[1])
    seen = np.flatnonzero(candidate)
    window = np.zeros((len(corners), 4), dtype=np.int64)
    if len(seen):
        window[seen] = _pixel_windows(
            np.clip(bounds[seen], limits[[0, 1, 0, 1]], limits[[2, 3, 2, 3]]), camera
        )
        seen = seen[(window[seen, 2] > window[seen, 0]) & (window[seen, 3] > window[seen, 1])]
    return seen, window


def _clip_near(polygon: FloatArray) -> FloatArray:
    """Normalised coordinates (k, 2) of a polygon's part ahead of the near plane."""
    points = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] > _NEAR_M:
            points.append(a[:2] / a[2])
        if (a[2] > _NEAR_M) != (b[2] > _NEAR_M):
            cut = a + (b - a) * (_NEAR_M - a[2]) / (b[2] - a[2])
            points.append(cut[:2] / _NEAR_M)
    return np.array(points)


def _pixel_windows(bounds: FloatArray, camera: Camera) -> NDArray[np.int64]:
    """Pixel windows (n, 4) of normalised rectangles (n, 4), by projecting samples of their outlines."""
    f = np.linspace(0.0, 1.0, _EDGE_SAMPLES)
    zero, one = np.zeros_like(f), np.ones_like(f)
    fx, fy = np.concatenate([f, f, zero, one]), np.concatenate([zero, one, f, f])
    x = bounds[:, [0]] + (bounds[:, [2]] - bounds[:, [0]]) * fx
    y = bounds[:, [1]] + (bounds[:, [3]] - bounds[:, [1]]) * fy
    outline = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)).reshape(*x.shape, 2)
    low = np.floor(outline.min(axis=1)).astype(np.int64) - _PAD_PX
    high = np.ceil(outline.max(axis=1)).astype(np.int64) + _PAD_PX
    size = [camera.width, camera.height]
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)], axis=1)
