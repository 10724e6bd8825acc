"""The ray-exact camera: colour, depth and object ids of a scene, with any lens, without a GPU.

For every face the depth and the texture coordinates of a pixel's ray are linear functions of the ray
divided by one another, so a face costs a few array operations over its window in the image; a depth
buffer decides between faces. What is seen is decided by `supersample` squared rays per pixel, its colour
once per pixel and primitive from textures averaged to the pixel's footprint; the rays' colours are
averaged. The picture is drawn in tiles that fit the processor's cache.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera, pixel_rays
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.shading import Float32, Look, ellipsoid_colour, face_colour, sky_colour
from featuredb.simworld.camera.view import EllipsoidView, view_ellipsoids, view_faces
from featuredb.simworld.town.scene import SKY_ID, Ellipsoids, Faces
from featuredb.simworld.town.texture import Image8

Part = tuple[slice, slice]

_TILE_PX = 256  # side of a tile in rays: its buffers stay in a core's second-level cache


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


@dataclass(slots=True, kw_only=True, eq=False)
class _Tile:
    """One tile of the ray grid, and the pixels that it makes.

    Attributes:
        pixels: rows and columns of the picture. x, y: of the rays. center_x, center_y: of pixels' centres.
    """

    pixels: Part
    x: Float32
    y: Float32
    center_x: Float32
    center_y: Float32
    inverse_depth: Float32
    object_id: NDArray[np.int32]
    rgb: Image8 | None


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
        supersample: rays per pixel and direction.
    """
    drawing = _Drawing(faces, ellipsoids, camera, cam_from_local, look)
    h, w = camera.height, camera.width
    rgb = np.empty((h, w, 3), np.uint8) if look is not None else None
    picture = Rendered(rgb=rgb, depth=np.empty((h, w), np.float32), object_id=np.empty((h, w), np.int32))
    rays, centers = pixel_rays(camera, supersample), pixel_rays(camera)
    side = _TILE_PX // supersample
    for row in range(0, h, side):
        for column in range(0, w, side):
            pixels = (slice(row, min(row + side, h)), slice(column, min(column + side, w)))
            part = tuple(slice(s.start * supersample, s.stop * supersample) for s in pixels)
            (x, y), (center_x, center_y) = (of[part] for of in rays), (of[pixels] for of in centers)
            tile = _Tile(
                pixels=pixels,
                x=x,
                y=y,
                center_x=center_x,
                center_y=center_y,
                inverse_depth=np.zeros(x.shape, np.float32),
                object_id=np.full(x.shape, SKY_ID, np.int32),
                rgb=np.zeros((*x.shape, 3), np.uint8) if look is not None else None,
            )
            drawing.draw(tile, supersample)
            _finish(tile, cam_from_local.rotation[:, 2], supersample, picture)
    return picture


class _Drawing:
    """The primitives as the camera meets them, drawn tile by tile."""

    def __init__(
        self,
        faces: Faces,
        ellipsoids: Ellipsoids,
        camera: Camera,
        cam_from_local: Rigid3,
        look: Look | None,
    ) -> None:
        self._faces, self._face_view = faces, view_faces(faces, camera, cam_from_local)
        self._ellipsoids = ellipsoids
        self._ellipsoid_view = view_ellipsoids(ellipsoids, camera, cam_from_local)
        self._look, self._pixels_per_unit = look, camera.focal_px
        self._scratch = np.empty((4, _TILE_PX**2), np.float32)

    def draw(self, tile: _Tile, n: int) -> None:
        """Draw what the tile shows; n: rays per pixel and direction."""
        rows, columns = tile.pixels
        start, end = (np.array([columns.start, rows.start]) * n, np.array([columns.stop, rows.stop]) * n)
        for view, draw in (
            (self._face_view, self._draw_face),
            (self._ellipsoid_view, self._draw_ellipsoid),
        ):
            window = view.window * n
            low, high = np.maximum(window[:, :2], start), np.minimum(window[:, 2:], end)
            for i in np.flatnonzero((low < high).all(axis=1)):
                a, b = low[i] - start, high[i] - start
                draw(tile, int(i), (slice(a[1], b[1]), slice(a[0], b[0])))

    def _buffers(self, shape: tuple[int, ...]) -> list[Float32]:
        """Scratch arrays, cut to a shape; fresh ones would cost more than the arithmetic."""
        size = shape[0] * shape[1]
        return [row[:size].reshape(shape) for row in self._scratch]

    def _draw_face(self, tile: _Tile, i: int, part: Part) -> None:
        """Draw face i of the view into its part of the tile."""
        view = self._face_view
        if tile.inverse_depth[part].min() > view.nearest[i]:
            return  # wholly behind what is drawn already
        x, y = tile.x[part], tile.y[part]
        k, s, t, spare = self._buffers(x.shape)
        for row, out in zip(view.planes[i].astype(np.float32), (k, s, t), strict=True):
            _linear(row, x, y, out, spare)
        index = int(view.index[i])
        mask = k > tile.inverse_depth[part]
        np.minimum(s, t, out=spare)
        mask &= spare >= 0
        (np.add if self._faces.triangle[index] else np.maximum)(s, t, out=spare)
        mask &= spare <= k
        tight = _write_geometry(tile, part, k, mask.view(np.uint8), int(self._faces.object_id[index]))
        if tight is not None and self._look is not None:
            rays = tile.center_x[tight.pixels], tile.center_y[tight.pixels]
            unit = self._pixels_per_unit
            _paint(tile, tight, face_colour(self._look, self._faces, view, i, rays, tight.far_near, unit))

    def _draw_ellipsoid(self, tile: _Tile, i: int, part: Part) -> None:
        """Draw ellipsoid i of the view into its part of the tile."""
        view = self._ellipsoid_view
        x, y = tile.x[part], tile.y[part]
        k, inside = _ellipsoid_depth(view, i, x, y, self._buffers(x.shape))
        mask = inside & (k > tile.inverse_depth[part])
        index = int(view.index[i])
        object_id = int(self._ellipsoids.object_id[index])
        visible = _write_geometry(tile, part, k, mask.view(np.uint8), object_id)
        if visible is not None and self._look is not None:
            x, y = tile.center_x[visible.pixels], tile.center_y[visible.pixels]
            k, _ = _ellipsoid_depth(view, i, x, y, self._buffers(x.shape))
            z = 1.0 / np.maximum(k, np.float32(visible.far_near[0]))
            m = view.unit_from_cam[i].astype(np.float32)
            w0 = view.w0[i].astype(np.float32)
            on_unit = [(x * row[0] + (y * row[1] + row[2])) * z + w for row, w in zip(m, w0, strict=True)]
            footprint = max(float(view.depth[i]), 0.1) / self._pixels_per_unit
            _paint(tile, visible, ellipsoid_colour(self._look, self._ellipsoids, index, on_unit, footprint))


def _linear(row: Float32, x: Float32, y: Float32, out: Float32, spare: Float32) -> None:
    """out = row @ (x, y, 1)."""
    np.multiply(x, row[0], out=out)
    np.multiply(y, row[1], out=spare)
    out += spare
    out += row[2]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Visible:
    """Where a primitive is seen: rays of the tile, the pixels they belong to, which rays, range of 1/z."""

    rays: Part
    pixels: Part
    mask: NDArray[np.uint8]
    far_near: tuple[float, float]


def _write_geometry(
    tile: _Tile, part: Part, k: Float32, mask: NDArray[np.uint8], object_id: int
) -> _Visible | None:
    """Write 1/z and the id where the mask is set; None where it is set nowhere."""
    column, row, width, height = cv2.boundingRect(mask)
    if width == 0:
        return None
    n = tile.x.shape[0] // tile.center_x.shape[0]
    # A window starts and ends at whole pixels; so must its visible part.
    y0, x0 = row - row % n, column - column % n
    y1, x1 = -(-(row + height) // n) * n, -(-(column + width) // n) * n
    inner = slice(y0, y1), slice(x0, x1)
    rays = (slice(part[0].start + y0, part[0].start + y1), slice(part[1].start + x0, part[1].start + x1))
    k, mask = k[inner], mask[inner]
    cv2.copyTo(k, mask, tile.inverse_depth[rays])
    cv2.copyTo(np.full(k.shape, object_id, np.int32), mask, tile.object_id[rays])
    low, high, _, _ = cv2.minMaxLoc(k, mask)
    pixels = tuple(slice(r.start // n, r.stop // n) for r in rays)
    return _Visible(rays=rays, pixels=(pixels[0], pixels[1]), mask=mask, far_near=(low, high))


def _paint(tile: _Tile, visible: _Visible, colour: Image8) -> None:
    """Give each visible ray its pixel's colour."""
    assert tile.rgb is not None
    size = visible.mask.shape[::-1]
    spread = (
        colour if size == colour.shape[1::-1] else cv2.resize(colour, size, interpolation=cv2.INTER_NEAREST)
    )
    cv2.copyTo(spread, visible.mask, tile.rgb[visible.rays])


def _ellipsoid_depth(
    view: EllipsoidView, i: int, x: Float32, y: Float32, buffers: list[Float32]
) -> tuple[Float32, NDArray[np.bool_]]:
    """1/z of the nearer point of an ellipsoid, and where there is one.

    With c k^2 + 2 b k + q = 0 for k = 1/z, where b is linear and q quadratic in the ray, the discriminant
    b^2 - c q is a quadratic form of the ray.
    """
    m, w0 = view.unit_from_cam[i], view.w0[i]
    c = float(w0 @ w0 - 1.0)
    linear = m.T @ w0
    form = (np.outer(linear, linear) - c * m.T @ m) / c**2
    linear32, f = (-linear / c).astype(np.float32), form.astype(np.float32)
    d, k, spare, _ = buffers
    np.multiply(x, f[0, 0], out=d)
    np.multiply(y, 2 * f[0, 1], out=spare)
    d += spare
    d += 2 * f[0, 2]
    d *= x
    np.multiply(y, f[1, 1], out=spare)
    spare += 2 * f[1, 2]
    spare *= y
    d += spare
    d += f[2, 2]
    inside = d >= 0
    np.maximum(d, 0, out=d)
    np.sqrt(d, out=d)
    _linear(linear32, x, y, k, spare)
    k += d
    return k, inside


def _finish(tile: _Tile, up: FloatArray, n: int, picture: Rendered) -> None:
    """Put the sky behind everything and average the tile, of n x n rays a pixel, into the picture."""
    with np.errstate(divide="ignore"):
        picture.depth[tile.pixels] = 1.0 / tile.inverse_depth[n // 2 :: n, n // 2 :: n]
    picture.object_id[tile.pixels] = tile.object_id[n // 2 :: n, n // 2 :: n]
    if picture.rgb is None or tile.rgb is None:
        return
    empty = tile.inverse_depth == 0
    if empty.any():
        cv2.copyTo(sky_colour((tile.x, tile.y), up), empty.view(np.uint8), tile.rgb)
    size = tile.center_x.shape[::-1]
    averaged = cv2.resize(tile.rgb, size, interpolation=cv2.INTER_AREA) if n > 1 else tile.rgb
    picture.rgb[tile.pixels] = averaged
