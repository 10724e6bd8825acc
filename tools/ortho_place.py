"""An ortho image over a scan: where its pixels lie, and what shows structure.

Nothing here is shared with the registration that `tools/autzen_windows.py` measures.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from featuredb.geo.crs.scan import scan_crs
from featuredb.geo.crs.utm_transform import utm_transform
from featuredb.geo.local_frame import LocalFrame
from featuredb.render.cloud import PointCloud

Floats = NDArray[np.float64]
WINDOW_PX = 400
_HIGH_M = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthoOverScan:
    """The ortho image over the scan: grey values, the pixel grid on the ground, rasters of the scan."""

    gray: NDArray[np.uint8]
    east: Floats  # (h + 1, w + 1) would be exact; a plane fitted to the corners is, to a millimetre
    north: Floats
    ground_m: float
    intensity: NDArray[np.float32]  # (h, w), NaN where no point fell
    high: NDArray[np.bool_]

    def on_ground(self, pixels: Floats) -> Floats:
        """East and north (n, 2) of ortho pixels (n, 2), metres."""
        full = np.column_stack([pixels, np.ones(len(pixels))])
        found: Floats = np.column_stack([full @ self.east, full @ self.north])
        return found


def place_of(path: Path, frame: LocalFrame, epsg: int, cloud: PointCloud) -> OrthoOverScan:
    """The ortho image at `path` in the frame of a cloud; prints how its pixels lie."""
    with rasterio.open(path) as image:
        bands, affine, wkt = image.read(), image.transform, image.crs.to_wkt()
    gray = np.asarray(cv2.cvtColor(np.moveaxis(bands, 0, -1), cv2.COLOR_RGB2GRAY))
    h, w = gray.shape
    corners = np.array([(x, y) for x in (0.0, w / 2, w) for y in (0.0, h / 2, h)])
    a, b, c, d, e, f = tuple(affine)[:6]
    xy = corners @ np.array([[a, d], [b, e]]) + (c, f)
    xyz = np.column_stack([xy, np.full(len(xy), 0.0)])
    utm = utm_transform(scan_crs(wkt=wkt), xyz.min(0), xyz.max(0), epsg).apply(xyz)
    ground = float(np.percentile(cloud.xyz[:, 2], 20))
    utm[:, 2] = frame.utm_from_enu(np.array([0.0, 0.0, ground]), epsg)[2]
    enu = frame.enu_from_utm(utm, epsg)
    full = np.column_stack([corners, np.ones(len(corners))])
    (east, left), (north, right) = (np.linalg.lstsq(full, enu[:, i], rcond=None)[:2] for i in (0, 1))
    worst = float(np.sqrt(max(left.max(initial=0), right.max(initial=0)) / len(corners)))
    print(f"ortho: {w} x {h} pixels of {np.hypot(east[0], north[0]):.4f} m; flat to {1000 * worst:.1f} mm")
    turn = np.array([[east[0], north[0]], [east[1], north[1]]])
    pixel = np.floor((cloud.xyz[:, :2] - (east[2], north[2])) @ np.linalg.inv(turn)).astype(int)
    inside = ((pixel >= 0) & (pixel < (w, h))).all(axis=1)
    cell = pixel[inside] @ (1, w)
    count = np.bincount(cell, minlength=w * h)
    assert cloud.intensity is not None
    total = np.bincount(cell, cloud.intensity[inside].astype(float), minlength=w * h)
    top = np.full(w * h, -np.inf)
    np.maximum.at(top, cell, cloud.xyz[inside, 2].astype(np.float64))
    intensity = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(h, w)
    high = cv2.dilate((top.reshape(h, w) > ground + _HIGH_M).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return OrthoOverScan(
        gray=gray, east=east, north=north, ground_m=ground, intensity=intensity.astype(np.float32), high=high
    )


def _gradients(picture: NDArray[Any], sigma: float) -> NDArray[np.float32]:
    known = np.isfinite(picture).astype(np.float32)
    filled = np.where(known > 0, picture, 0).astype(np.float32)
    smooth = cv2.GaussianBlur(filled, (0, 0), sigma) / np.maximum(
        cv2.GaussianBlur(known, (0, 0), sigma), 1e-3
    )
    dy, dx = np.gradient(smooth)
    return np.asarray(np.hypot(dx, dy), dtype=np.float32)


def has_structure(place: OrthoOverScan, column: int, row: int) -> bool:
    """Whether a window counts as having structure; the program's help says what that is."""
    window = (slice(row, row + WINDOW_PX), slice(column, column + WINDOW_PX))
    if place.high[window].mean() > 0.5:
        return False
    part, good, parts = 25, 0, 0
    pictures = [_gradients(p.astype(np.float32), 2.0) for p in (place.gray, place.intensity)]
    limits = [float(np.percentile(p, 75)) for p in pictures]
    for r in range(row, row + WINDOW_PX, part):
        for c in range(column, column + WINDOW_PX, part):
            here = (slice(r, r + part), slice(c, c + part))
            if place.high[here].mean() > 0.5:
                continue
            parts += 1
            good += all(np.percentile(p[here], 95) > limit for p, limit in zip(pictures, limits, strict=True))
    return good >= 0.25 * parts
