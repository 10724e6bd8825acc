"""The scan from above, with the height of each pixel: what a person picks in."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud

_LONGEST_SIDE_PX = 4000
_LIGHT = np.array([-0.5, 0.5, 0.7071])  # from the north-west, 45 degrees up, as maps are shaded
_EMPTY_RGB = 24
_REACH_PX = 4  # a pick in a gap takes the nearest point within


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundPicture:
    """A picture of a scan, north up.

    Attributes:
        rgb: (h, w, 3) uint8: colours, else intensity, else shaded heights.
        height: (h, w) float32 of the highest point of each pixel, NaN where there is none.
        west, north: outer corner of the top-left pixel in the cloud's frame. pixel_m: its size.
    """

    rgb: NDArray[np.uint8]
    height: NDArray[np.float32]
    west: float
    north: float
    pixel_m: float

    def spot(self, x: float, y: float) -> FloatArray:
        """(3,) local coordinates of a place in the picture, the corner of the top-left pixel at (0, 0).

        Raises:
            InvalidValueError: there is no scan near it.
        """
        rows, columns = self.height.shape
        row, column = int(np.floor(y)), int(np.floor(x))
        top, left = max(row - _REACH_PX, 0), max(column - _REACH_PX, 0)
        window = self.height[top : row + _REACH_PX + 1, left : column + _REACH_PX + 1]
        known = (
            np.argwhere(np.isfinite(window))
            if 0 <= row < rows and 0 <= column < columns
            else np.empty((0, 2))
        )
        if not len(known):
            raise InvalidValueError("there is no scan at this spot; pick where the picture shows points")
        nearest = known[np.argmin(np.hypot(known[:, 0] + top - row, known[:, 1] + left - column))]
        up = float(window[nearest[0], nearest[1]])
        return np.array([self.west + x * self.pixel_m, self.north - y * self.pixel_m, up])


def ground_of(cloud: PointCloud, spacing_m: float) -> GroundPicture:
    """The highest point of each pixel.

    Args:
        cloud: at least one point. spacing_m: of its points, under which pixels would stay empty.
    """
    xyz = cloud.xyz
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    pixel_m = float(max(np.max(high[:2] - low[:2]) / _LONGEST_SIDE_PX, 0.7 * spacing_m, 0.02))
    column = ((xyz[:, 0] - low[0]) / pixel_m).astype(np.int64)
    row = ((high[1] - xyz[:, 1]) / pixel_m).astype(np.int64)
    upwards = np.argsort(xyz[:, 2], kind="stable")  # the last one written into a pixel is the highest
    index = np.full((int(row.max()) + 1, int(column.max()) + 1), -1, np.int64)
    index[row[upwards], column[upwards]] = upwards
    empty = index < 0
    height = np.where(empty, np.nan, xyz[:, 2][index]).astype(np.float32)
    if cloud.rgb is not None:
        rgb = cloud.rgb[index]
    elif cloud.intensity is not None:
        rgb = np.repeat(cloud.intensity[index][:, :, None], 3, axis=2)
    else:
        rgb = _shaded(height, pixel_m)
    rgb[empty] = 0
    return GroundPicture(
        rgb=_gaps_closed(rgb, empty), height=height, west=float(low[0]), north=float(high[1]), pixel_m=pixel_m
    )


def _shaded(height: NDArray[np.float32], pixel_m: float) -> NDArray[np.uint8]:
    """Heights as seen in slanting light."""
    filled = np.where(np.isnan(height), np.nanmedian(height), height).astype(np.float32)
    south, east = np.gradient(np.asarray(cv2.GaussianBlur(filled, (0, 0), 1.0), np.float64), pixel_m)
    normal = np.stack([-east, south, np.ones_like(east)], axis=2)
    light = (normal @ _LIGHT) / np.linalg.norm(normal, axis=2)
    return np.repeat(np.clip(255.0 * light, 0.0, 255.0).astype(np.uint8)[:, :, None], 3, axis=2)


def _gaps_closed(rgb: NDArray[np.uint8], empty: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pixels between points take a neighbour's colour; larger holes are dark."""
    spread = np.asarray(cv2.dilate(rgb, np.ones((5, 5), np.uint8)), dtype=np.uint8)
    covered = cv2.morphologyEx((~empty).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
    out = np.where((empty & covered)[:, :, None], spread, rgb)
    out[empty & ~covered] = _EMPTY_RGB
    return out
