"""Colours of a scan's points from an ortho image, for those that the image can show (paper, section 2.1).

An ortho image shows the top of everything. A plain lookup would paint lawns below trees with leaves and walls
with roof tiles; so only points that a nadir view of the scan shows take its colour.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.crs.utm_transform import raster_from_utm
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.formats.ortho_image import OrthoImage as OrthoImage
from featuredb.lidar.formats.ortho_image import open_ortho as open_ortho
from featuredb.lidar.formats.ortho_image import sample_ortho
from featuredb.lidar.nadir_view import NadirOptions, point_spacing_m, seen_from_above


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourOptions:
    """How a scan is coloured from an ortho image.

    Attributes:
        nadir: what counts as seen from above; None colours everything, as a plain lookup does.
        pixels_per_spacing: the image is averaged to about so many pixels between neighbouring points, so that
            one line of paint does not decide for half a square metre.
    """

    nadir: NadirOptions | None = field(default_factory=NadirOptions)
    pixels_per_spacing: float = 2.0

    @property
    def margin_m(self) -> float:
        """How far around a tile its neighbours' points are needed, metres."""
        return 0.0 if self.nadir is None else self.nadir.margin_m


def colour_by_ortho(
    utm: FloatArray,
    epsg: int,
    own: NDArray[np.uint8] | None,
    ortho: OrthoImage,
    options: ColourOptions | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours of points, from the image where a nadir view shows them, their own elsewhere.

    Points hidden from above, outside the image, or where it has no data keep their own colour. Call it by
    tiles, with the points up to `options.margin_m` around each, and keep the tile's.

    Args:
        utm: (n, 3) float64 easting, northing, height, metres, without outliers.
        epsg: zone of `utm`.
        own: (n, 3) uint8 colours of the scan, or greys from its intensity, or None: black.

    Returns:
        rgb (n, 3) uint8, and (n,) bool: which points took their colour from the image.

    Raises:
        GeodesyError: the image's reference system cannot be used.
        ScanFileError: the image cannot be read.
    """
    options = options or ColourOptions()
    rgb = np.zeros((len(utm), 3), np.uint8) if own is None else own.copy()
    if rgb.shape != (len(utm), 3):
        raise InvalidValueError(f"colour_by_ortho: expected own colours ({len(utm)}, 3), found {rgb.shape}")
    coloured = np.zeros(len(utm), dtype=bool)
    if not len(utm):
        return rgb, coloured
    xy = _converter(ortho.wkt, epsg, utm[0])(utm[:, :2])
    a, b, c, d, e, f = ortho.pixel_from_xy
    pixel = np.stack([xy @ [a, b] + c, xy @ [d, e] + f], axis=1)
    with np.errstate(invalid="ignore"):
        inside = ((pixel >= 0) & (pixel < [ortho.width, ortho.height])).all(axis=1)
    if not inside.any():
        return rgb, coloured
    # Visibility needs all points: one outside the image may hide one inside.
    seen = inside if options.nadir is None else inside & seen_from_above(utm, options.nadir)
    rows = np.flatnonzero(seen)
    spacing = (options.nadir and options.nadir.spacing_m) or point_spacing_m(utm)
    shrink = spacing / options.pixels_per_spacing / _pixel_size_m(utm[inside], pixel[inside])
    found, valid = sample_ortho(ortho, pixel[rows], max(1.0, shrink))
    rgb[rows[valid]] = found[valid]
    coloured[rows[valid]] = True
    return rgb, coloured


@lru_cache(maxsize=4)
def _converter_at(wkt: str, epsg: int, east_km: int, north_km: int) -> Callable[[FloatArray], FloatArray]:
    return raster_from_utm(wkt, epsg, np.array([1e3 * east_km, 1e3 * north_km]))


def _converter(wkt: str, epsg: int, place: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """raster_from_utm, made once for 100 km around: tiles must not differ in their datum shift."""
    return _converter_at(wkt, epsg, 100 * round(place[0] / 1e5), 100 * round(place[1] / 1e5))


def _pixel_size_m(utm: FloatArray, pixel: FloatArray) -> float:
    """Size of a pixel on the ground, by how far apart points are in both; 1 m where they do not tell."""
    spread = np.ptp(utm[:, :2], axis=0).max()
    moved = np.ptp(pixel, axis=0).max()
    return float(spread / moved) if moved > 0 and spread > 0 else 1.0
