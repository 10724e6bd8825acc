"""Where in a photo each small piece of a rendering may lie: maps of agreement, one per piece.

A map is kept instead of its highest peak, for `ingest.register.frame.dense.search`.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering, RenderOptions, render
from ingest.register.frame.dense.pictures import FloatImage, PinholeView, oriented_gradients
from ingest.register.frame.views import source_image
from ingest.register.frame_registration import RenderSource

# Side of a square piece. Larger ones are more distinct and bear less change of view; 40 pixels found airborne
# intensity from far off where 28 did not.
PIECE_PX = 40
_MIN_OVERLAP = 0.6  # of a piece that lies over the photo's border
_MIN_VALID = 0.6  # share of the piece that must show the scan
# Mean squared length of its channels; below it there is no edge to hold on to. White noise has 0.1, a kerb
# through the piece 0.3.
_MIN_STRUCTURE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Templates:
    """Pieces of a rendering with the scan points at their centres.

    Attributes:
        channels: (n, k, size, size) float32.
        points_local: (n, 3) float64, metres.
    """

    channels: FloatImage
    points_local: FloatArray

    def __len__(self) -> int:
        return len(self.points_local)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreMaps:
    """Agreement of n pieces with the photo around each pixel of a window.

    Attributes:
        points_local: (n, 3) float64 metres, of the pieces' centres.
        maps: (n, h, w) float32: correlation of channels in units of its standard deviation over the map.
        origin: (n, 2) float64, photo pixel (of the view that was searched) of the centre of map cell (0, 0).
        camera: of the view that was searched.
    """

    points_local: FloatArray
    maps: FloatImage
    origin: FloatArray
    camera: Camera

    def __len__(self) -> int:
        return len(self.points_local)


def score_maps_of(
    view: PinholeView,
    cam_from_local: Rigid3,
    margin_px: int,
    cloud: PointCloud,
    source: RenderSource,
    radius_px: int | None,
    max_count: int,
) -> ScoreMaps:
    """Renders at a pose and searches the pieces in the photo, all over it if `radius_px` is None.

    Args:
        margin_px: by which the render is wider than the photo on each side. max_count: of pieces.
    """
    width, height = view.camera.width + 2 * margin_px, view.camera.height + 2 * margin_px
    wide = Camera.from_focal(width, height, view.camera.focal_px, model="SIMPLE_PINHOLE")
    rendering = render(cloud, wide, cam_from_local, RenderOptions(threads=1))
    templates = cut_templates(rendering, source, PIECE_PX, max_count)
    photo = oriented_gradients(view.image, view.valid)
    if radius_px is None:
        return search_everywhere(templates, photo, view.camera)
    return search_around(templates, photo, view.camera, cam_from_local, radius_px)


def cut_templates(rendering: Rendering, source: RenderSource, size: int, max_count: int) -> Templates:
    """Pieces of a rendering that show the scan and have structure; they overlap by half.

    Args:
        size: of a piece, pixels. max_count: the ones with most structure are kept; bounds the time.
    """
    channels = oriented_gradients(source_image(rendering, source), rendering.valid)
    starts = [np.arange(0, n - size + 1, size // 2) for n in channels.shape[1:]]
    rows, columns = (axis.ravel() for axis in np.meshgrid(*starts, indexing="ij"))
    valid = _window_means(rendering.valid.astype(np.float32), size)[rows, columns]
    structure = _window_means(np.einsum("khw,khw->hw", channels, channels), size)[rows, columns]
    keep = np.flatnonzero((valid >= _MIN_VALID) & (structure >= _MIN_STRUCTURE))
    keep = np.sort(keep[np.argsort(-structure[keep], kind="stable")[:max_count]])
    rows, columns = rows[keep], columns[keep]
    points, known = _centre_points(rendering, rows + size / 2.0, columns + size / 2.0)
    rows, columns, points = rows[known], columns[known], points[known]
    pieces = [channels[:, r : r + size, c : c + size] for r, c in zip(rows, columns, strict=True)]
    empty = np.zeros((0, len(channels), size, size), np.float32)
    return Templates(channels=np.stack(pieces) if pieces else empty, points_local=points)


def search_everywhere(templates: Templates, photo: FloatImage, camera: Camera) -> ScoreMaps:
    """Score maps over a pinhole's whole photo (k, h, w), and its border where most of a piece lies inside."""
    size = templates.channels.shape[-1]
    margin = int(size * (1.0 - _MIN_OVERLAP))
    _, h, w = photo.shape
    padded = np.pad(photo, ((0, 0), (margin, margin), (margin, margin)))
    out = (h + 2 * margin - size + 1, w + 2 * margin - size + 1)
    energy = _window_means(np.einsum("khw,khw->hw", padded, padded), size) * size**2
    shape = tuple(fft.next_fast_len(n, real=True) for n in padded.shape[1:])
    spectrum = fft.rfft2(padded, shape)
    maps = np.empty((len(templates), *out), np.float32)
    for row, piece in enumerate(templates.channels):
        product = np.einsum("kij,kij->ij", spectrum, np.conj(fft.rfft2(piece, shape)))
        correlation = fft.irfft2(product, shape)[: out[0], : out[1]]
        maps[row] = _standardised(correlation, energy, float(np.sum(piece**2)))
    origin = np.full((len(templates), 2), size / 2.0 - margin)
    return ScoreMaps(points_local=templates.points_local, maps=maps, origin=origin, camera=camera)


def search_around(
    templates: Templates, photo: FloatImage, camera: Camera, cam_from_local: Rigid3, radius_px: int
) -> ScoreMaps:
    """Score maps within `radius_px` of where a pose puts the pieces; those outside the photo are left out."""
    size = templates.channels.shape[-1]
    reach = size // 2 + radius_px
    pixels = camera.project(cam_from_local.act(templates.points_local))
    h, w = photo.shape[1:]
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(pixels).all(axis=1))
    inside[inside] &= ((pixels[inside] > 0) & (pixels[inside] < (w, h))).all(axis=1)
    # First column and row of the window.
    corner = np.round(pixels[inside] - size / 2.0).astype(np.int64) - radius_px
    padded = np.pad(photo, ((0, 0), (reach + 1, reach + 1), (reach + 1, reach + 1)))
    energy = _window_means(np.einsum("khw,khw->hw", padded, padded), size) * size**2
    picture = np.ascontiguousarray(padded.transpose(1, 2, 0))
    pieces = np.ascontiguousarray(templates.channels[inside].transpose(0, 2, 3, 1))
    span, cells = size + 2 * radius_px, 2 * radius_px + 1
    maps = np.empty((len(pieces), cells, cells), np.float32)
    for row, (piece, (x, y)) in enumerate(zip(pieces, corner + reach + 1, strict=True)):
        correlation = cv2.matchTemplate(picture[y : y + span, x : x + span], piece, cv2.TM_CCORR)
        there = energy[y : y + cells, x : x + cells]
        maps[row] = _standardised(correlation, there, float(np.sum(piece**2)))
    return ScoreMaps(
        points_local=templates.points_local[inside], maps=maps, origin=corner + size / 2.0, camera=camera
    )


def scores_at(score_maps: ScoreMaps, pixels: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Scores (m, n) at pixels (m, n, 2), one column per map, bilinear; and where they lie inside the maps."""
    cell = np.asarray(pixels, dtype=np.float32) - score_maps.origin.astype(np.float32)
    _, height, width = score_maps.maps.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((cell >= 0) & (cell < (width - 1, height - 1))).all(axis=-1))
    cell = np.where(inside[..., None], cell, 0.0)
    whole = cell.astype(np.int32)
    fx, fy = (cell - whole).transpose(2, 0, 1)
    flat = score_maps.maps.ravel()
    base = np.arange(len(score_maps)) * (height * width) + whole[..., 1] * width + whole[..., 0]
    top = flat[base] * (1 - fx) + flat[base + 1] * fx
    bottom = flat[base + width] * (1 - fx) + flat[base + width + 1] * fx
    return np.where(inside, top * (1 - fy) + bottom * fy, np.float32(0)), inside


def _standardised(
    correlation: NDArray[np.floating[Any]], energy: FloatImage, own_energy: float
) -> FloatImage:
    """Normalised correlation over its spread: how far each place stands out of chance agreement."""
    # A window with a tenth of the piece's structure is not to win by being normalised up.
    normalised = correlation / np.sqrt(own_energy * np.maximum(energy, 0.1 * own_energy) + 1e-12)
    spread = float(np.sqrt(np.mean(normalised**2)))
    return np.asarray(normalised / max(spread, 1e-6), dtype=np.float32)


def _window_means(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Mean over each size x size window, (h - size + 1, w - size + 1)."""
    total = np.pad(np.cumsum(np.cumsum(image, axis=0, dtype=np.float64), axis=1), ((1, 0), (1, 0)))
    sums = total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]
    return np.asarray(sums / size**2, dtype=np.float32)


def _centre_points(
    rendering: Rendering, rows: FloatArray, columns: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Scan points seen at pixel positions, at the median depth around; and where there is any."""
    depth = np.full(len(rows), np.nan)
    for i, (row, column) in enumerate(zip(rows.astype(int), columns.astype(int), strict=True)):
        patch = rendering.depth[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        patch = patch[np.isfinite(patch)]
        if len(patch):
            depth[i] = np.median(patch)
    rays = rendering.camera.unproject(np.stack([columns, rows], axis=1))
    points_cam = np.column_stack([rays, np.ones(len(rays))]) * depth[:, None]
    known: NDArray[np.bool_] = np.asarray(np.isfinite(points_cam).all(axis=1))
    return rendering.cam_from_local.inverse().act(points_cam), known


def peaks(maps: FloatImage) -> tuple[FloatArray, FloatArray]:
    """Highest cells of maps (n, h, w): positions (n, 2) as (x, y) to a fraction of one, heights (n,)."""
    n, height, width = maps.shape
    best = maps.reshape(n, -1).argmax(axis=1)
    rows, columns = np.divmod(best, width)
    values = maps.reshape(n, -1)[np.arange(n), best].astype(np.float64)
    # A peak on the border has its true top outside.
    r, c = np.clip(rows, 1, height - 2), np.clip(columns, 1, width - 2)
    index = np.arange(n)
    dx = _parabola(maps[index, r, c - 1], maps[index, r, c], maps[index, r, c + 1])
    dy = _parabola(maps[index, r - 1, c], maps[index, r, c], maps[index, r + 1, c])
    return np.stack([columns + dx, rows + dy], axis=1), values


def _parabola(left: FloatImage, middle: FloatImage, right: FloatImage) -> FloatArray:
    curvature = np.maximum(2.0 * middle - left - right, 1e-6)
    return np.asarray(np.clip(0.5 * (right - left) / curvature, -0.5, 0.5), dtype=np.float64)
