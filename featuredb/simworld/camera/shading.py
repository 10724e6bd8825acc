"""Colours of faces, ellipsoids and the sky, from textures averaged to the pixel's footprint."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.camera.view import FaceView
from featuredb.simworld.town.scene import TEXTURES, Ellipsoids, Faces
from featuredb.simworld.town.texture import Image8, Texture

Float32 = NDArray[np.float32]
Rays = tuple[Float32, Float32]

# Texture level = 0.5 log2(area of a pixel's footprint) + 0.25 log2(elongation): between blur and aliasing.
_DEPTH_POWER = 1.75
_SHARPNESS = 0.1  # levels sharper than one texel per pixel; more gives moire on roof tiles
_DETAIL_LIMIT = -1.5  # log2 metres: beyond 0.35 m per pixel the fine detail has averaged out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """Textures in the order of TEXTURES, the fine-detail texture, and the unit vector to the sun."""

    textures: tuple[Texture, ...]
    detail: Texture
    to_sun: FloatArray


def face_colour(
    look: Look,
    faces: Faces,
    view: FaceView,
    i: int,
    rays: Rays,
    far_near: tuple[float, float],
    pixels_per_unit: float,
) -> Image8:
    """Colours (h, w, 3) of face i of the view along rays x, y (h, w): texture, detail, tint.

    Args:
        far_near: range of 1/z over the face's visible part, 1/metres.
        pixels_per_unit: focal length, pixels.
    """
    index = int(view.index[i])
    planes = view.planes[i].astype(np.float32)
    x, y = rays
    k, s, t = (x * row[0] + (y * row[1] + row[2]) for row in planes)
    # At an edge the centre may lie beside the face or past its horizon: the plane's nearest sensible depth.
    z = 1.0 / np.maximum(k, np.float32(far_near[0]))
    s, t = s * z, t * z
    u0, v0, us, vs, ut, vt = faces.uv[index].astype(np.float32)
    u, v = s * us + t * ut, s * vs + t * vt
    coefficient = _level_coefficient(faces, view, i, pixels_per_unit)
    texture = look.textures[faces.texture[index]]
    colour = _sample_levels(texture, (u, v, float(u0), float(v0)), k, far_near, coefficient)
    footprint = coefficient - _DEPTH_POWER * math.log2(far_near[1])
    if not np.isnan(faces.detail_uv[index, 0]) and footprint < _DETAIL_LIMIT:
        du, dv = faces.detail_uv[index].tolist()
        detail = _sample_levels(look.detail, (u, v, du, dv), k, far_near, coefficient)
        colour = np.asarray(cv2.multiply(colour, detail, scale=1.0 / 128.0), dtype=np.uint8)
    return _tinted(colour, faces.tint[index])


def ellipsoid_colour(
    look: Look, ellipsoids: Ellipsoids, index: int, on_unit: list[Float32], footprint_m: float
) -> Image8:
    """Colours (h, w, 3) of a crown at points on its unit sphere, three arrays (h, w): leaves and sunlight."""
    texture = look.textures[TEXTURES.index("leaves")]
    rx, ry, rz = ellipsoids.radii[index].astype(np.float32)
    u0, v0 = (ellipsoids.texture_uv[index] % texture.extent_m).astype(np.float32)
    wx, wy, wz = on_unit
    # The octahedral map: little stretch anywhere, no pole that a drone would look down on.
    fold = np.float32(2.0) / (np.abs(wx) + np.abs(wy) + np.abs(wz))
    u, v = wx * fold * rx + u0, wy * fold * ry + np.sign(wz) * rz + v0
    level = min(max(round(math.log2(footprint_m / texture.texel_m)), 0), len(texture.levels) - 1)
    colour = texture.sample(u, v, level)
    sun = look.to_sun.astype(np.float32)
    light = np.clip((wx * sun[0] + wy * sun[1] + wz * sun[2]) * np.float32(0.55) + np.float32(0.6), 0.2, 1.2)
    shaded = np.asarray(cv2.multiply(colour, cv2.merge([light] * 3), dtype=cv2.CV_8U), dtype=np.uint8)
    return _tinted(shaded, ellipsoids.tint[index])


def sky_colour(rays: Rays, up: FloatArray) -> Image8:
    """A clear sky (h, w, 3), darker blue with elevation; `up` (3,) is the vertical in camera axes."""
    x, y = rays
    a, b, c = up.astype(np.float32)
    elevation = np.clip((x * a + y * b + c) / np.sqrt(x * x + y * y + 1), 0, 1)[..., None]
    low, high = np.array([206, 218, 230], np.float32), np.array([96, 142, 204], np.float32)
    return np.asarray(low + (high - low) * np.sqrt(elevation), dtype=np.uint8)


def _tinted(colour: Image8, tint: FloatArray) -> Image8:
    if np.ptp(tint) < 1e-9:
        return np.asarray(cv2.convertScaleAbs(colour, alpha=float(tint[0])), dtype=np.uint8)
    return np.asarray(cv2.multiply(colour, (*tint.tolist(), 1.0)), dtype=np.uint8)


def _level_coefficient(faces: Faces, view: FaceView, i: int, pixels_per_unit: float) -> float:
    """c such that log2(footprint of a pixel in metres) = c + _DEPTH_POWER * log2(z), for face i."""
    us, vs, ut, vt = faces.uv[int(view.index[i]), 2:]
    area = abs(np.linalg.det(view.planes[i]) * (us * vt - vs * ut)) / pixels_per_unit**2
    return float(0.5 * np.log2(area) - 0.25 * np.log2(view.distance[i]))


def _sample_levels(
    texture: Texture,
    uv: tuple[Float32, Float32, float, float],
    k: Float32,
    far_near: tuple[float, float],
    coefficient: float,
) -> Image8:
    """Colours at (u + u0, v + v0), each from the level that fits its depth 1 / k."""
    # Whole repetitions are taken out: far outside its image the sampling is slow, and wrong past 2^15 texels.
    u, v = (_near_zero(c, start, e) for c, start, e in zip(uv[:2], uv[2:], texture.extent_m, strict=True))
    base = coefficient - math.log2(texture.texel_m) - _SHARPNESS
    top = len(texture.levels) - 1
    last, first = (min(max(round(base - _DEPTH_POWER * math.log2(q)), 0), top) for q in far_near)
    colour = texture.sample(u, v, first)
    for level in range(first + 1, last + 1):
        limit = np.float32(2.0 ** ((base - level + 0.5) / _DEPTH_POWER))
        further = (k < limit).view(np.uint8)
        column, row, w, h = cv2.boundingRect(further)
        if w:
            band = slice(row, row + h), slice(column, column + w)
            cv2.copyTo(texture.sample(u[band], v[band], level), further[band], colour[band])
    return colour


def _near_zero(coordinate: Float32, start: float, period: float) -> Float32:
    """coordinate + start, less the whole periods at its middle."""
    middle = float(coordinate[coordinate.shape[0] // 2, coordinate.shape[1] // 2])
    shifted: Float32 = coordinate + np.float32(start - period * math.floor((middle + start) / period))
    return shifted
