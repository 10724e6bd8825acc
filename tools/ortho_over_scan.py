"""An ortho image and a scan on one grid: where there is structure in both, and by how much they disagree.

The grid's pixels are no finer than the image's own, or than the scan is dense. What stands on the ground,
which an ortho image shows leaning, is told from it by the lowest points around, and does not count.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geo.crs.utm_transform import raster_from_utm
from featuredb.lidar.formats.ortho_image import open_ortho, sample_ortho
from featuredb.render.cloud import PointCloud
from ingest.register.frame.dense.pictures import oriented_gradients, plan_spacing_m
from ingest.register.frame.dense.score_maps import peaks

Floats = NDArray[np.float64]
Part = tuple[slice, slice]  # rows, columns
_PIXELS_PER_SPACING = 1.25  # of the grid, at most: between neighbouring points of the scan
_WINDOW_PX = 400  # at most
_HIGH_M = 3.0
_LEVEL_M = 100.0  # side of a building, at most
_EDGE_PX = 2.0  # sigma of the gradient
_PATCH_M, _REACH_M = 40.0, 15.0
_DRAWS = 500


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthoOverScan:
    """The ortho image over the scan: rasters (h, w) with rows southwards, pixels of `cell` metres.

    Attributes:
        corner: (2,) east, north of the outer corner of the first pixel.
        shown: where there are both. intensity: NaN where no point fell.
        edges: (2, h, w) of image and scan, the strongest quarter.
        ground: height below what stands there. high: what stands.
    """

    gray: NDArray[np.uint8]
    corner: Floats
    cell: float
    shown: NDArray[np.bool_]
    intensity: NDArray[np.float32]
    edges: NDArray[np.bool_]
    ground: NDArray[np.float32]
    high: NDArray[np.bool_]

    @property
    def window(self) -> int:
        """Side of a window, pixels: one fits in a half, too."""
        height, width = self.gray.shape
        return int(min(_WINDOW_PX, height, width // 2))

    def on_ground(self, pixels: Floats) -> Floats:
        """East and north (n, 2) of pixels (n, 2), metres."""
        return np.asarray(self.corner + self.cell * (pixels * (1.0, -1.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """East and north (2,) by which the scan shows things beside where the ortho image does, metres."""

    metres: Floats
    sigma: Floats


def place_of(path: Path, epsg: int, cloud: PointCloud) -> OrthoOverScan:
    """The ortho image at `path` and a cloud on one grid."""
    ortho, frame = open_ortho(path), cloud.frame
    low, high = (of.astype(np.float64) for of in (cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)))
    to_raster = raster_from_utm(ortho.wkt, epsg, frame.utm_from_enu(0.5 * (low + high), epsg))
    a, b, c, d, e, f = ortho.pixel_from_xy

    def in_image(east: Floats, north: Floats) -> Floats:
        level = np.full(east.size, np.median(cloud.xyz[:, 2]))
        enu = np.column_stack([east.ravel(), north.ravel(), level])
        xy = to_raster(frame.utm_from_enu(enu, epsg)[:, :2])
        return np.column_stack([xy @ (a, b) + c, xy @ (d, e) + f])

    middle = 0.5 * (low + high) + np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    own_m = 1.0 / float(np.linalg.norm(np.diff(in_image(middle[:, 0], middle[:, 1]), axis=0)))
    cell = max(own_m, plan_spacing_m(cloud) / _PIXELS_PER_SPACING)
    w, h = (int(n) for n in (high - low)[:2] / cell)
    corner = np.array([low[0], high[1]])
    pixel = np.floor((cloud.xyz[:, :2] - corner) / cell * (1.0, -1.0)).astype(int)
    inside = ((pixel >= 0) & (pixel < (w, h))).all(axis=1)
    at, z = pixel[inside] @ (1, w), cloud.xyz[inside, 2].astype(np.float32)
    count = np.bincount(at, minlength=w * h).reshape(h, w)
    total = np.bincount(at, cloud.intensity[inside].astype(float), minlength=w * h).reshape(h, w)
    lowest, top = np.full(w * h, np.inf, np.float32), np.full(w * h, -np.inf, np.float32)
    np.minimum.at(lowest, at, z)
    np.maximum.at(top, at, z)
    level = np.ones((int(_LEVEL_M / cell),) * 2, np.uint8)
    ground = cv2.morphologyEx(lowest.reshape(h, w), cv2.MORPH_OPEN, level)
    ground[ground > high[2]] = np.median(ground[ground <= high[2]])  # nothing fell anywhere near
    above = (top.reshape(h, w) > ground + _HIGH_M).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    spots = in_image(corner[0] + cell * columns, corner[1] - cell * rows)
    rgb, known = sample_ortho(ortho, spots, max(1.0, cell / own_m))
    near = cv2.GaussianBlur((count > 0).astype(np.float32), (0, 0), 3.0) > 0.1
    known &= ((spots >= 0) & (spots < (ortho.width, ortho.height))).all(axis=1)
    shown = near & known.reshape(h, w)
    gray = np.asarray(cv2.cvtColor(rgb.reshape(h, w, 3), cv2.COLOR_RGB2GRAY))
    intensity = np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
    strength = [_strength(of) for of in (gray.astype(np.float32), intensity)]
    return OrthoOverScan(
        gray=gray,
        corner=corner,
        cell=cell,
        shown=shown,
        intensity=intensity,
        edges=np.array([of > np.percentile(of[shown], 75) for of in strength]),
        ground=ground,
        high=cv2.dilate(above, np.ones((5, 5), np.uint8)) > 0,
    )


def halves_of(place: OrthoOverScan) -> dict[str, Part]:
    """The western and the eastern half of what is shown."""
    (top, bottom), (left, right) = ((int(at.min()), int(at.max()) + 1) for at in np.nonzero(place.shown))
    middle = (left + right) // 2
    return {
        "west": (slice(top, bottom), slice(left, middle)),
        "east": (slice(top, bottom), slice(middle, right)),
    }


def measured_offset(place: OrthoOverScan, part: Part) -> Offset:
    """By how much the scan's intensities lie beside the ortho image's ground in a part of the grid.

    Oriented gradients of patches of the image are correlated with the scan's, the maps are summed, and draws
    of the patches with replacement say how sure the peak is.
    """
    usable = (place.shown & ~place.high)[part]
    size, reach = int(_PATCH_M / place.cell), int(_REACH_M / place.cell)
    image, scan = (
        np.moveaxis(oriented_gradients(of, usable), 0, -1)
        for of in (place.gray[part], _filled(place.intensity[part], 1.0))
    )
    scan = np.pad(scan, ((reach, reach), (reach, reach), (0, 0)))
    maps = [
        cv2.matchTemplate(
            scan[row : row + size + 2 * reach, column : column + size + 2 * reach],
            image[row : row + size, column : column + size],
            cv2.TM_CCORR_NORMED,
        )
        for row in range(0, usable.shape[0] - size + 1, size)
        for column in range(0, usable.shape[1] - size + 1, size)
        if usable[row : row + size, column : column + size].mean() > 0.5
    ]
    each = np.nan_to_num(np.array(maps, np.float32))
    weights = np.random.default_rng(0).multinomial(len(each), np.full(len(each), 1 / len(each)), _DRAWS)
    summed = np.tensordot(np.vstack([np.ones(len(each)), weights]), each, 1).astype(np.float32)
    places = (peaks(summed)[0] - reach) * place.cell * (1.0, -1.0)
    return Offset(metres=places[0], sigma=places[1:].std(axis=0))


def _filled(picture: NDArray[Any], sigma: float) -> NDArray[np.float32]:
    """A picture smoothed over where it is known."""
    known = np.isfinite(picture).astype(np.float32)
    smooth = cv2.GaussianBlur(np.where(known > 0, picture, 0).astype(np.float32), (0, 0), sigma)
    return np.asarray(smooth / np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), 1e-3), dtype=np.float32)


def _strength(picture: NDArray[Any]) -> NDArray[np.float32]:
    dy, dx = np.gradient(_filled(picture, _EDGE_PX))
    return np.asarray(np.hypot(dx, dy), dtype=np.float32)


def has_structure(place: OrthoOverScan, column: int, row: int) -> bool:
    """Whether a window counts as having structure; the help of `tools.autzen_windows` says what that is."""
    side = place.window - place.window % 25
    window = (slice(row, row + side), slice(column, column + side))

    def by_part(of: NDArray[np.bool_]) -> Floats:
        return np.asarray(of[window].reshape(side // 25, 25, side // 25, 25).mean(axis=(1, 3)))

    low = by_part(place.high) <= 0.5
    both = np.logical_and(*(by_part(edges) > 0.05 for edges in place.edges))
    return bool(place.high[window].mean() <= 0.5 and both[low].mean() >= 0.25)
