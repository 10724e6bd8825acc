"""The ray-exact camera: colour, depth and object ids of a scene, with any lens, without a GPU.

For every face the depth and the texture coordinates of a pixel's ray are linear functions of the ray
divided by one another, so a face costs a few array operations over its window in the image; a depth
buffer decides between faces. The picture is drawn in tiles that fit the processor's cache, with
`supersample` squared rays per pixel, and averaged down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.rays import pixel_rays
from featuredb.simworld.scene import SKY_ID, TEXTURES, Ellipsoids, Faces
from featuredb.simworld.texture import Image8, Texture
from featuredb.simworld.view import EllipsoidView, FaceView, view_ellipsoids, view_faces

Float32 = NDArray[np.float32]

_TILE_PX = 512  # side of a tile in rays: its buffers stay in a core's second-level cache
# Texture level = 0.5 log2(area of a ray's footprint) + 0.25 log2(its elongation): between blur and aliasing.
_DEPTH_POWER = 1.75
_SHARPNESS = 0.25  # levels; a little sharper than one texel per ray, since rays are averaged afterwards


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendered:
    """What a camera sees.

    Attributes:
        rgb: (h, w, 3) uint8, average of the pixel's rays; None where only geometry was asked for.
        depth: (h, w) float32, z in the camera's frame along the ray of the pixel's centre, metres;
            infinity where nothing is. With supersampling, that of one ray within the pixel.
        object_id: (h, w) int32, SKY_ID where nothing is.
    """

    rgb: Image8 | None
    depth: Float32
    object_id: NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """Textures in the order of TEXTURES, the fine-detail texture, and the sun."""

    textures: tuple[Texture, ...]
    detail: Texture
    to_sun: FloatArray


@dataclass(slots=True, kw_only=True, eq=False)
class _Tile:
    """One tile of the ray grid; x0, y0 in rays."""

    x0: int
    y0: int
    x: Float32
    y: Float32
    inverse_depth: Float32
    object_id: NDArray[np.int32]
    rgb: Image8 | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    """Everything about one picture that the drawing functions share."""

    faces: Faces
    face_view: FaceView
    ellipsoids: Ellipsoids
    ellipsoid_view: EllipsoidView
    look: Look | None
    rays_per_unit: float
    supersample: int


def render(
    faces: Faces,
    ellipsoids: Ellipsoids,
    camera: Camera,
    cam_from_local: Rigid3,
    *,
    look: Look | None = None,
    supersample: int = 1,
) -> Rendered:
    """Draw the primitives; colour only where a `look` is given.

    Args:
        faces, ellipsoids: in the local frame, metres.
        cam_from_local: pose of the camera.
        supersample: rays per pixel and direction.
    """
    job = _Job(
        faces=faces,
        face_view=view_faces(faces, camera, cam_from_local),
        ellipsoids=ellipsoids,
        ellipsoid_view=view_ellipsoids(ellipsoids, camera, cam_from_local),
        look=look,
        rays_per_unit=camera.focal_px * supersample,
        supersample=supersample,
    )
    x, y = pixel_rays(camera, supersample)
    h, w = camera.height, camera.width
    rgb = np.empty((h, w, 3), np.uint8) if look is not None else None
    depth, object_id = np.empty((h, w), np.float32), np.empty((h, w), np.int32)
    step = _TILE_PX - _TILE_PX % supersample
    up = cam_from_local.rotation[:, 2]
    for y0 in range(0, h * supersample, step):
        for x0 in range(0, w * supersample, step):
            tile = _draw_tile(job, x0, y0, x[y0 : y0 + step, x0 : x0 + step], y[y0 : y0 + step, x0 : x0 + step])
            _finish(job, tile, up, rgb, depth, object_id)
    return Rendered(rgb=rgb, depth=depth, object_id=object_id)


def _draw_tile(job: _Job, x0: int, y0: int, x: Float32, y: Float32) -> _Tile:
    shape = x.shape
    tile = _Tile(
        x0=x0,
        y0=y0,
        x=x,
        y=y,
        inverse_depth=np.zeros(shape, np.float32),
        object_id=np.full(shape, SKY_ID, np.int32),
        rgb=np.zeros((*shape, 3), np.uint8) if job.look is not None else None,
    )
    box = np.array([x0, y0, x0 + shape[1], y0 + shape[0]])
    for view, draw in ((job.face_view, _draw_face), (job.ellipsoid_view, _draw_ellipsoid)):
        window = view.window * job.supersample
        low, high = np.maximum(window[:, :2], box[:2]), np.minimum(window[:, 2:], box[2:])
        for i in np.flatnonzero((low < high).all(axis=1)):
            a, b = low[i] - box[:2], high[i] - box[:2]
            draw(job, tile, int(i), (slice(a[1], b[1]), slice(a[0], b[0])))
    return tile


def _draw_face(job: _Job, tile: _Tile, i: int, part: tuple[slice, slice]) -> None:
    """Draw face i of the view into its part of the tile."""
    planes = job.face_view.planes[i].astype(np.float32)
    x, y = tile.x[part], tile.y[part]
    k, s, t = (x * row[0] + (y * row[1] + row[2]) for row in planes)
    index = int(job.face_view.index[i])
    mask = k > tile.inverse_depth[part]
    mask &= s >= 0
    mask &= t >= 0
    if job.faces.triangle[index]:
        mask &= (s + t) <= k
    else:
        mask &= s <= k
        mask &= t <= k
    mask8 = mask.view(np.uint8)
    if not cv2.hasNonZero(mask8):
        return
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    tight = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    part = (
        slice(part[0].start + rows[0], part[0].start + rows[-1] + 1),
        slice(part[1].start + columns[0], part[1].start + columns[-1] + 1),
    )
    k, s, t, mask = k[tight], s[tight], t[tight], mask[tight]
    np.copyto(tile.inverse_depth[part], k, where=mask)
    np.copyto(tile.object_id[part], job.faces.object_id[index], where=mask)
    if tile.rgb is not None:
        _shade_face(job, tile.rgb[part], i, (k, s, t), mask)


def _shade_face(
    job: _Job, target: Image8, i: int, kst: tuple[Float32, Float32, Float32], mask: NDArray[np.bool_]
) -> None:
    """Fill the masked rays of `target` with the face's texture, detail and tint."""
    assert job.look is not None
    index = int(job.face_view.index[i])
    faces, (k, s, t) = job.faces, kst
    texture = job.look.textures[faces.texture[index]]
    near, far = float(k.max(where=mask, initial=0.0)), float(k.min(where=mask, initial=np.inf))
    z = np.reciprocal(k, where=mask, out=np.ones_like(k))
    s, t = s * z, t * z
    u0, v0, us, vs, ut, vt = faces.uv[index].astype(np.float32)
    u, v = s * us + (t * ut + u0), s * vs + (t * vt + v0)
    coefficient = _level_coefficient(job, i)
    colour = _sample_levels(texture, u, v, k, (near, far), coefficient)
    if not np.isnan(faces.detail_uv[index, 0]):
        du, dv = (faces.detail_uv[index] - faces.uv[index, :2]).astype(np.float32)
        detail = _sample_levels(job.look.detail, u + du, v + dv, k, (near, far), coefficient)
        colour = np.asarray(cv2.multiply(colour, detail, scale=1.0 / 128.0))
    tint = faces.tint[index]
    if np.ptp(tint) < 1e-9:
        colour = np.asarray(cv2.convertScaleAbs(colour, alpha=float(tint[0])))
    else:
        colour = np.asarray(cv2.multiply(colour, (*tint.tolist(), 1.0)))
    np.copyto(target, colour, where=mask[..., None])


def _level_coefficient(job: _Job, i: int) -> float:
    """c such that log2(footprint in metres) = c + _DEPTH_POWER * log2(z), for face i."""
    index = int(job.face_view.index[i])
    us, vs, ut, vt = job.faces.uv[index, 2:]
    area = abs(np.linalg.det(job.face_view.planes[i]) * (us * vt - vs * ut)) / job.rays_per_unit**2
    return float(0.5 * np.log2(area) - 0.25 * np.log2(job.face_view.distance[i]))


def _sample_levels(
    texture: Texture, u: Float32, v: Float32, k: Float32, near_far: tuple[float, float], coefficient: float
) -> Image8:
    """Colours at u, v, each from the level that fits its depth 1 / k."""
    base = coefficient - np.log2(texture.texel_m) - _SHARPNESS
    top = len(texture.levels) - 1
    first, last = (int(np.clip(np.round(base - _DEPTH_POWER * np.log2(q)), 0, top)) for q in near_far)
    colour = texture.sample(u, v, first)
    for level in range(first + 1, last + 1):
        limit = np.float32(2.0 ** ((base - level + 0.5) / _DEPTH_POWER))
        further = k < limit
        rows = np.flatnonzero(further.any(axis=1))
        if len(rows) == 0:
            continue
        band = slice(rows[0], rows[-1] + 1)
        finer = texture.sample(u[band], v[band], level)
        np.copyto(colour[band], finer, where=further[band, :, None])
    return colour


def _draw_ellipsoid(job: _Job, tile: _Tile, i: int, part: tuple[slice, slice]) -> None:
    """Draw ellipsoid i of the view into its part of the tile."""
    view = job.ellipsoid_view
    m, w0 = view.unit_from_cam[i].astype(np.float32), view.w0[i].astype(np.float32)
    x, y = tile.x[part], tile.y[part]
    direction = [x * row[0] + (y * row[1] + row[2]) for row in m]
    q = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    b = direction[0] * w0[0] + direction[1] * w0[1] + direction[2] * w0[2]
    c = np.float32(view.w0[i] @ view.w0[i] - 1.0)
    # c k^2 + 2 b k + q = 0 for k = 1 / z; the larger root is the nearer point.
    k = (np.sqrt(np.maximum(b * b - c * q, 0)) - b) / c
    mask = (b * b >= c * q) & (k > tile.inverse_depth[part])
    if not cv2.hasNonZero(mask.view(np.uint8)):
        return
    index = int(view.index[i])
    np.copyto(tile.inverse_depth[part], k, where=mask)
    np.copyto(tile.object_id[part], job.ellipsoids.object_id[index], where=mask)
    if tile.rgb is not None:
        z = np.reciprocal(k, where=mask, out=np.ones_like(k))
        on_unit = [d * z + w for d, w in zip(direction, w0, strict=True)]
        colour = _ellipsoid_colour(job, index, on_unit, float(view.depth[i]))
        np.copyto(tile.rgb[part], colour, where=mask[..., None])


def _ellipsoid_colour(job: _Job, index: int, on_unit: list[Float32], depth: float) -> Image8:
    assert job.look is not None
    ellipsoids = job.ellipsoids
    texture = job.look.textures[TEXTURES.index("leaves")]
    rx, ry, rz = ellipsoids.radii[index].astype(np.float32)
    u0, v0 = ellipsoids.texture_uv[index].astype(np.float32)
    wx, wy, wz = on_unit
    # The octahedral map: little stretch anywhere, no pole that a drone would look down on.
    fold = np.float32(2.0) / (np.abs(wx) + np.abs(wy) + np.abs(wz))
    u, v = wx * fold * rx + u0, wy * fold * ry + np.sign(wz) * rz + v0
    footprint = max(depth, 0.1) / job.rays_per_unit
    level = int(np.clip(np.round(np.log2(footprint / texture.texel_m)), 0, len(texture.levels) - 1))
    colour = texture.sample(u, v, level)
    sun = job.look.to_sun.astype(np.float32)
    light = np.clip((wx * sun[0] + wy * sun[1] + wz * sun[2]) * np.float32(0.55) + np.float32(0.6), 0.2, 1.2)
    shaded = cv2.multiply(colour, cv2.merge([light] * 3), dtype=cv2.CV_8U)
    return np.asarray(cv2.multiply(shaded, (*ellipsoids.tint[index].tolist(), 1.0)), dtype=np.uint8)


def _finish(
    job: _Job, tile: _Tile, up: FloatArray, rgb: Image8 | None, depth: Float32, object_id: NDArray[np.int32]
) -> None:
    """Put the sky behind everything and average the tile into the picture."""
    n = job.supersample
    rows = slice(tile.y0 // n, (tile.y0 + tile.x.shape[0]) // n)
    columns = slice(tile.x0 // n, (tile.x0 + tile.x.shape[1]) // n)
    with np.errstate(divide="ignore"):
        depth[rows, columns] = 1.0 / tile.inverse_depth[n // 2 :: n, n // 2 :: n]
    object_id[rows, columns] = tile.object_id[n // 2 :: n, n // 2 :: n]
    if rgb is None or tile.rgb is None:
        return
    empty = tile.inverse_depth == 0
    if empty.any():
        np.copyto(tile.rgb, _sky(tile, up), where=empty[..., None])
    size = (tile.x.shape[1] // n, tile.x.shape[0] // n)
    rgb[rows, columns] = cv2.resize(tile.rgb, size, interpolation=cv2.INTER_AREA) if n > 1 else tile.rgb


def _sky(tile: _Tile, up: FloatArray) -> Image8:
    """A clear sky: darker blue with elevation."""
    x, y = tile.x, tile.y
    a, b, c = up.astype(np.float32)
    elevation = np.clip((x * a + y * b + c) / np.sqrt(x * x + y * y + 1), 0, 1)[..., None]
    low, high = np.array([206, 218, 230], np.float32), np.array([96, 142, 204], np.float32)
    return np.asarray(low + (high - low) * np.sqrt(elevation), dtype=np.uint8)
