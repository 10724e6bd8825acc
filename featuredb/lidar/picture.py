"""A scan seen from above, to look at after it has been added."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError, ScanError
from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import ScanSummary

_LONGEST_SIDE_PX = 1400
_LARGEST_POINTS = 4_000_000  # more do not show in a picture of that size
_DPI, _AXES_PX = 100, 120
_GAP_PX, _BACKGROUND = 3, 255
_LIGHT = np.array([-0.5, 0.5, 0.7071])  # from the north-west, 45 degrees up, as maps are shaded
_REACH_PX = 4  # a spot in a gap takes the nearest point within


def write_plan_view(database: Database, scan: ScanSummary, path: Path) -> None:
    """Write a PNG of a scan: its colours, else its intensities, else shaded heights; north up, axes in
    metres.

    Raises:
        ScanError: the file cannot be written.
        StoreError: the points cannot be read.
    """
    from matplotlib.figure import Figure  # takes a second to load

    cloud = load_cloud(
        database,
        scan_frame(scan),
        scan_ids=[scan.scan_id],
        largest_points=_LARGEST_POINTS,
    )
    ground = ground_of(cloud, scan.spacing_m, _LONGEST_SIDE_PX, _GAP_PX, _BACKGROUND)
    shown = "colours" if cloud.rgb is not None else "intensity" if cloud.intensity is not None else "heights"
    height, width = ground.height.shape
    inches = (width + _AXES_PX) / _DPI, (height + _AXES_PX) / _DPI
    figure = Figure(figsize=inches, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(ground.rgb, extent=(0.0, width * ground.pixel_m, 0.0, height * ground.pixel_m))
    axes.set(xlabel="east, m", ylabel="north, m")
    axes.set_title(f"{scan.name}  EPSG:{scan.epsg}  {scan.points:,} points  {shown}", fontsize=9, loc="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        figure.savefig(path, format="png")
    except OSError as error:
        raise ScanError(f"cannot write the plan view {path} ({error}); choose another place") from error


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


def ground_of(
    cloud: PointCloud, finest_m: float, longest_px: int, gap_px: int, background: int
) -> GroundPicture:
    """The highest point of each pixel; gaps between points take a neighbour's colour, larger ones stay empty.

    Args:
        cloud: at least one point.
        finest_m: pixels are not smaller than that. longest_px: the picture is not larger.
        gap_px: side of the gaps that are closed. background: grey of what stays empty.
    """
    xyz = cloud.xyz
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    pixel_m = float(max(np.max(high[:2] - low[:2]) / longest_px, finest_m))
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
    square = np.ones((gap_px, gap_px), np.uint8)
    spread = np.asarray(cv2.dilate(rgb, square), dtype=np.uint8)
    covered = cv2.morphologyEx((~empty).astype(np.uint8), cv2.MORPH_CLOSE, square) > 0
    rgb = np.where((empty & covered)[:, :, None], spread, rgb)
    rgb[~covered] = background
    return GroundPicture(rgb=rgb, height=height, west=float(low[0]), north=float(high[1]), pixel_m=pixel_m)


def _shaded(height: NDArray[np.float32], pixel_m: float) -> NDArray[np.uint8]:
    """Heights as seen in slanting light."""
    filled = np.where(np.isnan(height), np.nanmedian(height), height).astype(np.float32)
    south, east = np.gradient(np.asarray(cv2.GaussianBlur(filled, (0, 0), 1.0), np.float64), pixel_m)
    normal = np.stack([-east, south, np.ones_like(east)], axis=2)
    light = (normal @ _LIGHT) / np.linalg.norm(normal, axis=2)
    return np.repeat(np.clip(255.0 * light, 0.0, 255.0).astype(np.uint8)[:, :, None], 3, axis=2)
