"""An ortho image over a scan: where its pixels lie, how far the two disagree, what shows structure.

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
_REACH = 40  # pixels of shift searched for the offset


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


def measured_offset(place: OrthoOverScan) -> Floats:
    """Where the scan has what the ortho image shows, less where the image does: (2,) metres east, north."""
    ortho, scan = _gradients(place.gray.astype(np.float32), 1.0), _gradients(place.intensity, 1.5)
    ok = ~place.high
    h, w = ortho.shape
    halves = [(slice(0, h // 2), "north"), (slice(h // 2, h), "south")]
    sides = [(slice(0, w // 2), "west"), (slice(w // 2, w), "east")]
    parts = [(f"{a} {b}", rows, columns) for rows, a in halves for columns, b in sides]
    found = np.zeros(2)
    for name, rows, columns in [*parts, ("whole", slice(0, h), slice(0, w))]:
        found, height = _best_shift(ortho[rows, columns], scan[rows, columns], ok[rows, columns])
        print(f"offset, {name}: columns {found[0]:+.1f}, rows {found[1]:+.1f}, correlation {height:.3f}")
    offset: Floats = place.on_ground(found[None])[0] - place.on_ground(np.zeros((1, 2)))[0]
    return offset


def _best_shift(a: NDArray[Any], b: NDArray[Any], ok: NDArray[np.bool_]) -> tuple[Floats, float]:
    """The shift (columns, rows) of b against a with the highest correlation, to a fraction of a pixel."""
    inner = np.zeros(a.shape, bool)
    inner[_REACH:-_REACH, _REACH:-_REACH] = True
    rows, columns = np.nonzero(inner & ok)
    values = a[rows, columns] - a[rows, columns].mean()
    reach = 15
    grid = np.empty((2 * reach + 1, 2 * reach + 1))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            other = b[rows + i, columns + j]
            other = other - other.mean()
            grid[i + reach, j + reach] = values @ other / np.sqrt((values @ values) * (other @ other))
    i, j = (int(np.clip(k, 1, 2 * reach - 1)) for k in divmod(int(grid.argmax()), 2 * reach + 1))

    def top(low: float, middle: float, high: float) -> float:
        return 0.5 * (high - low) / max(2 * middle - low - high, 1e-9)

    x = j - reach + top(grid[i, j - 1], grid[i, j], grid[i, j + 1])
    y = i - reach + top(grid[i - 1, j], grid[i, j], grid[i + 1, j])
    return np.asarray([x, y], dtype=np.float64), float(grid.max())


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
