"""A scan seen from above, to look at after it has been added."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ScanError
from featuredb.lidar.load import load_cloud, scan_frame
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import ScanSummary

_LONGEST_SIDE_PX = 1400
_LARGEST_POINTS = 4_000_000  # more do not show in a picture of that size
_BORDER_PX, _FOOT_PX = 12, 56
_BACKGROUND = 255
_LIGHT = np.array([-0.5, 0.5, 0.7071])  # from the north-west, 45 degrees up, as maps are shaded


def write_plan_view(database: Database, scan: ScanSummary, path: Path) -> None:
    """Write a PNG of a scan: its colours, else its intensities, else shaded heights; north up, with a scale
    bar.

    Raises:
        ScanError: the file cannot be written.
        StoreError: the points cannot be read.
    """
    cloud = load_cloud(
        database,
        scan_frame(scan),
        scan_ids=[scan.scan_id],
        largest_points=_LARGEST_POINTS,
    )
    image, pixel_m = plan_view(cloud, scan.spacing_m)
    shown = "colours" if cloud.rgb is not None else "intensity" if cloud.intensity is not None else "heights"
    picture = _framed(image, pixel_m, f"{scan.name}  EPSG:{scan.epsg}  {scan.points:,} points  {shown}")
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    if not done:
        raise ScanError(f"cannot encode the plan view {path}")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise ScanError(f"cannot write the plan view {path} ({error}); choose another place") from error


def plan_view(cloud: PointCloud, spacing_m: float) -> tuple[NDArray[np.uint8], float]:
    """The highest point of each pixel, north up; pixels without points are white.

    Args:
        cloud: at least one point.
        spacing_m: of the points, under which pixels would stay empty.

    Returns:
        (h, w, 3) uint8 RGB and the size of a pixel in metres.
    """
    xyz = cloud.xyz
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    extent = np.maximum(high[:2] - low[:2], 1e-3)
    pixel_m = float(max(extent.max() / _LONGEST_SIDE_PX, spacing_m))
    column = ((xyz[:, 0] - low[0]) / pixel_m).astype(np.int64)
    row = ((high[1] - xyz[:, 1]) / pixel_m).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    upwards = np.argsort(xyz[:, 2], kind="stable")  # the last one written into a pixel is the highest
    index = np.full(shape, -1, np.int64)
    index[row[upwards], column[upwards]] = upwards
    empty = index < 0
    if cloud.rgb is not None:
        image = cloud.rgb[index]
    elif cloud.intensity is not None:
        image = np.repeat(cloud.intensity[index][:, :, None], 3, axis=2)
    else:
        image = _shaded(xyz[:, 2][index], empty, pixel_m)
    image[empty] = _BACKGROUND
    return _small_gaps_closed(image, empty), pixel_m


def _shaded(height: NDArray[np.float32], empty: NDArray[np.bool_], pixel_m: float) -> NDArray[np.uint8]:
    """Heights as seen in slanting light."""
    height = np.where(empty, np.median(height[~empty]), height).astype(np.float32)
    smooth = cv2.GaussianBlur(height, (0, 0), 1.0)
    south, east = np.gradient(np.asarray(smooth, np.float64), pixel_m)
    normal = np.stack([-east, south, np.ones_like(east)], axis=2)
    light = (normal @ _LIGHT) / np.linalg.norm(normal, axis=2)
    grey = np.clip(255.0 * light, 0.0, 255.0).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def _small_gaps_closed(image: NDArray[np.uint8], empty: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Single empty pixels take a neighbour's colour; larger holes stay."""
    spread = cv2.erode(image, np.ones((3, 3), np.uint8))  # the background is white, so darker wins
    inside = ~np.asarray(
        cv2.morphologyEx((~empty).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), bool
    )
    fill = empty & ~inside
    image[fill] = np.asarray(spread)[fill]
    return image


def _framed(image: NDArray[np.uint8], pixel_m: float, title: str) -> NDArray[np.uint8]:
    """The image with a border, a scale bar and a line of text."""
    h, w = image.shape[:2]
    width = max(w, 480) + 2 * _BORDER_PX
    picture = np.full((h + 2 * _BORDER_PX + _FOOT_PX, width, 3), _BACKGROUND, np.uint8)
    picture[_BORDER_PX : _BORDER_PX + h, _BORDER_PX : _BORDER_PX + w] = image
    longest = 0.3 * w * pixel_m
    power = 10.0 ** np.floor(np.log10(longest))
    bar_m = power * max(f for f in (1, 2, 5) if f * power <= longest or f == 1)
    y = h + 2 * _BORDER_PX + 8
    cv2.rectangle(picture, (_BORDER_PX, y), (_BORDER_PX + round(bar_m / pixel_m), y + 6), (0, 0, 0), -1)
    font = cv2.FONT_HERSHEY_SIMPLEX
    label = (_BORDER_PX + round(bar_m / pixel_m) + 8, y + 9)
    cv2.putText(picture, f"{bar_m:g} m", label, font, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    # OpenCV's letters are ASCII.
    text = title.encode("ascii", "replace").decode()
    cv2.putText(picture, text, (_BORDER_PX, y + 36), font, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return picture
