"""Colours of a scan's points from an ortho image, for those that the image can show (paper, section 2.1).

An ortho image shows the top of everything. A plain lookup would paint lawns below trees with leaves and walls
with roof tiles; so only points that a nadir view of the scan shows take its colour.
"""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError, ScanError
from featuredb.geo.crs.utm_transform import raster_from_utm
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.ortho_image import OrthoImage, sample_ortho

# Radius of the disc that a point covers, in spacings of the points. Points of a regular pattern leave no gap
# from 0.71 on; scan lines are farther apart than points within them.
SPLAT_SPACINGS = 1.2
_STEEPEST_SLOPE = 1.2  # rise over run of a surface that does not hide itself: roofs reach 50 degrees
STEP_M = 0.15  # a point may lie deeper on top of that: noise, roughness, strips that do not fit
# A hole up to this width in what is above is taken as covered: crowns are not tight to a laser, and an image
# shows leaves there. Shallower ones (gutters, furrows) are seen into.
GAP_M, _GAP_DEPTH_M = 1.6, 1.5
# The image is averaged to about so many pixels between neighbouring points, so that one line of paint does
# not decide for half a square metre.
_PIXELS_PER_SPACING = 2.0
LAID = {  # what a scan's id says of how the image is laid on its points
    "nadir": {
        "splat_spacings": SPLAT_SPACINGS,
        "steepest_slope": _STEEPEST_SLOPE,
        "step_m": STEP_M,
        "gap_m": GAP_M,
        "gap_depth_m": _GAP_DEPTH_M,
        "spacing_m": None,
    },
    "pixels_per_spacing": _PIXELS_PER_SPACING,
}
_EMPTY_M = np.float32(-1e9)
_FINEST_M, _COARSEST_M = 0.03, 2.0
_MAX_CELLS = 200_000_000


def margin_m(spacing_m: float) -> float:
    """How far around a tile points must be known for its points to be judged as in the whole scan, metres."""
    return GAP_M + 2.0 * SPLAT_SPACINGS * spacing_m


def seen_from_above(xyz: FloatArray, spacing_m: float) -> NDArray[np.bool_]:
    """Which points (n,) a nadir view of the scan shows.

    Each point covers a disc; who lies clearly below such a disc, or in a narrow and deep hole of the surface
    that they make, is hidden. Walls and eaves are hidden by the roof's edge.

    Args:
        xyz: (n, 3) float64 in metres, z up; outliers above the scene hide what is below them.
        spacing_m: of the points.
    """
    if not len(xyz):
        return np.zeros(0, dtype=bool)
    radius = float(np.clip(SPLAT_SPACINGS * spacing_m, _FINEST_M, _COARSEST_M))
    local = (xyz - np.floor(xyz.min(axis=0))).astype(np.float32)
    cell = np.floor(local[:, :2] / radius).astype(np.int64) + 1
    columns, rows = (int(cell[:, k].max()) + 2 for k in (0, 1))
    if columns * rows > _MAX_CELLS:
        raise InvalidValueError(
            f"seen_from_above: expected a tile, found points over {columns} x {rows} cells of "
            f"{radius:.2f} m; call it by tiles with a margin"
        )
    at = cell[:, 1] * columns + cell[:, 0]
    highest = _highest(at, local[:, 2], rows * columns)
    return ~(
        _below_neighbours(local, at, highest, columns, radius)
        | _in_hole(local[:, 2], at, highest, (rows, columns), radius)
    )


def _highest(at: NDArray[np.int64], z: NDArray[np.float32], cells: int) -> NDArray[np.int64]:
    """Row of the highest point of each cell, -1 in empty ones."""
    highest = np.full(cells, -1, dtype=np.int64)
    order = np.argsort(z, kind="stable")
    highest[at[order]] = order  # the last one written wins
    return highest


def _below_neighbours(
    local: NDArray[np.float32], at: NDArray[np.int64], highest: NDArray[np.int64], columns: int, radius: float
) -> NDArray[np.bool_]:
    """Which points lie below the disc of the highest point of a cell next to theirs."""
    hidden = np.zeros(len(local), dtype=bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            other = highest[at + down * columns + right]
            difference = local[other] - local  # row -1 is some point, and left out below
            distance = np.hypot(difference[:, 0], difference[:, 1])
            limit = STEP_M + _STEEPEST_SLOPE * distance
            hidden |= (other >= 0) & (distance <= radius) & (difference[:, 2] > limit)
    return hidden


def _in_hole(
    z: NDArray[np.float32],
    at: NDArray[np.int64],
    highest: NDArray[np.int64],
    shape: tuple[int, int],
    cell_m: float,
) -> NDArray[np.bool_]:
    """Which points lie deep in a narrow hole of the surface: below its morphological closing."""
    reach = int(np.floor(0.5 * GAP_M / cell_m))
    if reach < 1:
        return np.zeros(len(z), dtype=bool)
    surface = np.where(highest >= 0, z[highest], _EMPTY_M).reshape(shape)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    closed = np.asarray(cv2.morphologyEx(surface, cv2.MORPH_CLOSE, disc))
    return np.asarray(closed.ravel()[at] - z > _GAP_DEPTH_M, dtype=bool)


def colour_by_ortho(
    utm: FloatArray, epsg: int, own: NDArray[np.uint8], ortho: OrthoImage, spacing_m: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours of points, from the image where a nadir view shows them, their own elsewhere.

    Points hidden from above, outside the image, or where it has no data keep their own colour. Call it by
    tiles, with the points up to `margin_m` around each, and keep the tile's.

    Args:
        utm: (n, 3) float64 easting, northing, height, metres, without outliers.
        epsg: zone of `utm`.
        own: (n, 3) uint8 colours of the scan.
        spacing_m: of the points.

    Returns:
        rgb (n, 3) uint8, and (n,) bool: which points took their colour from the image.

    Raises:
        GeodesyError: the image's reference system cannot be used.
        ScanFileError: the image cannot be read.
    """
    rgb, coloured = own.copy(), np.zeros(len(utm), dtype=bool)
    if not len(utm):
        return rgb, coloured
    # Made once for 100 km around: tiles must not differ in their datum shift.
    east_km, north_km = (100 * round(place / 1e5) for place in utm[0, :2].tolist())
    xy = _converter_at(ortho.wkt, epsg, east_km, north_km)(utm[:, :2])
    a, b, c, d, e, f = ortho.pixel_from_xy
    pixel = np.stack([xy @ [a, b] + c, xy @ [d, e] + f], axis=1)
    with np.errstate(invalid="ignore"):
        inside = ((pixel >= 0) & (pixel < [ortho.width, ortho.height])).all(axis=1)
    if not inside.any():
        return rgb, coloured
    # Visibility needs all points: one outside the image may hide one inside.
    rows = np.flatnonzero(inside & seen_from_above(utm, spacing_m))
    shrink = spacing_m / _PIXELS_PER_SPACING / _pixel_size_m(utm[inside], pixel[inside])
    found, valid = sample_ortho(ortho, pixel[rows], max(1.0, shrink))
    rgb[rows[valid]] = found[valid]
    coloured[rows[valid]] = True
    return rgb, coloured


def check_overlap(ortho: OrthoImage, utm: FloatArray, epsg: int) -> None:
    """Refuse an image of another place, by boxes; what they leave open, colouring tells.

    Args:
        utm: (n, 3) corners of the boxes of the scan's files, metres. epsg: their zone.

    Raises:
        ScanError: the image lies elsewhere.
        GeodesyError: its reference system cannot be used.
    """
    xy = raster_from_utm(ortho.wkt, epsg, utm[0])(utm[:, :2])
    a, b, c, d, e, f = ortho.pixel_from_xy
    pixels = np.array([(x, y) for x in (0, ortho.width) for y in (0, ortho.height)]) - [c, f]
    corners = np.linalg.solve([[a, b], [d, e]], pixels.T).T.round(5)
    low, high = xy.min(axis=0), xy.max(axis=0)
    slack = 0.1 * (high - low)  # a box's edges are bent in another system
    if ((corners.max(axis=0) < low - slack) | (corners.min(axis=0) > high + slack)).any():
        raise ScanError(
            f"{ortho.path}: expected an image of the scan's place, in the image's reference system "
            f"{low.round(5).tolist()} to {high.round(5).tolist()}, found one of "
            f"{corners.min(axis=0).tolist()} to {corners.max(axis=0).tolist()}; check the file, or state its "
            "system by --ortho-crs"
        )


@lru_cache(maxsize=4)
def _converter_at(wkt: str, epsg: int, east_km: int, north_km: int) -> Callable[[FloatArray], FloatArray]:
    return raster_from_utm(wkt, epsg, np.array([1e3 * east_km, 1e3 * north_km]))


def _pixel_size_m(utm: FloatArray, pixel: FloatArray) -> float:
    """Size of a pixel on the ground, by how far apart points are in both; 1 m where they do not tell."""
    spread = np.ptp(utm[:, :2], axis=0).max()
    moved = np.ptp(pixel, axis=0).max()
    return float(spread / moved) if moved > 0 and spread > 0 else 1.0
